"""Seconds a picture of every world, and seconds until its light is known:

    python benchmarks/render_speed.py [--worlds lab] [--fresh]

Light is traced once for a world, a condition and a quality, and kept in the cache; with --fresh it
is traced here, into a cache of its own. Without LLVM nothing is known beforehand, and each picture
traces its own light: --variants scalar_rgb shows what that costs.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc_worlds.conditions import find_condition
from topoloc_worlds.rendering.renderer import RenderConfig, Renderer
from topoloc_worlds.rendering.variant import LLVM, SCALAR, use_best_variant
from topoloc_worlds.worlds import WORLDS, World

QUALITIES = {"default": RenderConfig(), "draft": RenderConfig.draft()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", nargs="*", default=list(WORLDS))
    parser.add_argument("--conditions", nargs="*", default=["day"])
    parser.add_argument("--qualities", nargs="*", default=list(QUALITIES), choices=QUALITIES)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 400))
    parser.add_argument("--variants", nargs="*", default=[LLVM], choices=[LLVM, SCALAR])
    parser.add_argument("--frames", type=int, default=7)
    parser.add_argument("--fresh", action="store_true")
    args = parser.parse_args()
    width, height = args.size
    camera = Camera.pinhole(
        width, height, 0.59 * width, 0.59 * width, (width - 1) / 2, (height - 1) / 2
    )
    print(
        f"{width}x{height}, {os.cpu_count()} cores; medians of {args.frames} pictures, by the clock"
        " and by the processor"
    )
    with tempfile.TemporaryDirectory() as folder:
        if args.fresh:
            os.environ["XDG_CACHE_HOME"] = folder
        for variant in args.variants:
            use_best_variant(variant)
            for world in (WORLDS[name] for name in args.worlds):
                for condition in args.conditions:
                    for quality in args.qualities:
                        measure(world, condition, quality, camera, variant, args.frames)


def measure(
    world: World, condition: str, quality: str, camera: Camera, variant: str, num_frames: int
) -> None:
    started = time.perf_counter()
    scene = world.build(0, find_condition(condition))
    renderer = Renderer(scene, QUALITIES[quality], world.viewpoints())
    ready = time.perf_counter() - started
    wall, processor = [], []
    for number, world_from_cam in enumerate(
        along_the_way(world, num_frames + 1)
    ):  # the first compiles
        clock, cpu = time.perf_counter(), time.process_time()
        renderer.render(camera, world_from_cam, number)
        wall.append(time.perf_counter() - clock)
        processor.append(time.process_time() - cpu)
    seconds = (
        f"{statistics.median(wall[1:]):6.2f} s  {statistics.median(processor[1:]):6.2f} s of a core"
    )
    print(
        f"{variant:12s} {world.name:9s} {condition:8s} {quality:8s} {seconds}  ready after"
        f" {ready:6.1f} s",
        flush=True,
    )


def along_the_way(world: World, num: int) -> list[Rigid3]:
    """Looking along the first side of the loop, from places on its first half."""
    start, end = np.array(world.loop[0]), np.array(world.loop[1])
    x, y = (end - start) / np.linalg.norm(end - start)
    rotation = np.array([[y, 0.0, x], [-x, 0.0, y], [0.0, -1.0, 0.0]])
    places = [start + share * (end - start) for share in np.linspace(0.1, 0.5, num)]
    return [Rigid3(rotation, np.array([*place, world.camera_height])) for place in places]


if __name__ == "__main__":
    main()
