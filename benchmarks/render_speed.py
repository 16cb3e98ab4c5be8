"""Seconds a picture, and the noise that is left in it, for every world: python benchmarks/render_speed.py [--worlds lab] [--reference 512]

Noise is against a picture of many samples that is not filtered, in grey levels of 8 bits after exposure and gamma. That picture has
noise of its own, given in the last column: what is left between two halves of it, halved.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from dataclasses import replace

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.simulation.conditions import find_condition
from topoloc.simulation.rendering.light_filter import LightFilterConfig
from topoloc.simulation.rendering.renderer import RenderConfig, Renderer
from topoloc.simulation.rendering.variant import LLVM, SCALAR, use_best_variant
from topoloc.simulation.worlds import WORLDS, World


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", nargs="*", default=list(WORLDS))
    parser.add_argument("--conditions", nargs="*", default=["day", "night"])
    parser.add_argument("--size", type=int, nargs=2, default=(640, 400))
    parser.add_argument("--variants", nargs="*", default=[LLVM, SCALAR])
    parser.add_argument("--reference", type=int, default=512, help="samples of the reference; 0 leaves the noise out")
    parser.add_argument("--frames", type=int, default=5)
    args = parser.parse_args()
    width, height = args.size
    camera = Camera.pinhole(width, height, 0.53 * width, 0.53 * width, (width - 1) / 2, (height - 1) / 2)
    print(f"{width}x{height}, {os.cpu_count()} cores, median of {args.frames} pictures")
    for variant in args.variants:
        use_best_variant(variant)
        for world in (WORLDS[name] for name in args.worlds):
            for condition in args.conditions:
                measure(world, condition, camera, variant, args.frames, args.reference if variant == args.variants[0] else 0)


def measure(world: World, condition: str, camera: Camera, variant: str, frames: int, reference_samples: int) -> None:
    scene, world_from_cam = world.build(1, find_condition(condition)), on_the_way(world)
    reference, halves = None, []
    if reference_samples:
        raw = LightFilterConfig(levels=0, firefly=1e9)
        renderer = Renderer(scene, RenderConfig(samples=reference_samples // 2, albedo_samples=16, light_filter=raw))
        halves = [renderer.render(camera, world_from_cam, seed).radiance for seed in (1001, 1002)]
        reference = 0.5 * (halves[0] + halves[1])
    for name, config in (("default", RenderConfig()), ("draft", RenderConfig.draft()), ("default, no filter", unfiltered())):
        started = time.perf_counter()
        renderer = Renderer(scene, config)
        loaded = time.perf_counter() - started
        seconds, seen = [], None
        for seed in range(frames + 1):  # the first compiles
            started = time.perf_counter()
            seen = renderer.render(camera, world_from_cam, seed).radiance
            seconds.append(time.perf_counter() - started)
        line = f"{variant:12s} {world.name:9s} {condition:6s} {name:19s} {statistics.median(seconds[1:]):7.2f} s  load {loaded:5.2f} s"
        if reference is not None and seen is not None:
            own = rms(grey(halves[0], reference) - grey(halves[1], reference)) / 2
            line += f"  noise {rms(grey(seen, reference) - grey(reference, reference)):5.2f}  (reference {own:.2f})"
        print(line, flush=True)


def unfiltered() -> RenderConfig:
    return replace(RenderConfig(), light_filter=LightFilterConfig(levels=0, firefly=1e9))


def on_the_way(world: World) -> Rigid3:
    """A fifth along the first side of the loop, looking along it."""
    start, end = np.array(world.loop[0]), np.array(world.loop[1])
    x, y = (end - start) / np.linalg.norm(end - start)
    rotation = np.array([[y, 0.0, x], [-x, 0.0, y], [0.0, -1.0, 0.0]])
    return Rigid3(rotation, np.array([*(start + 0.2 * (end - start)), world.camera_height]))


def grey(radiance: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Grey levels at the exposure that shows the median of `like` at half the range."""
    lit = like[like.max(axis=2) > 0]
    return 255.0 * np.clip(radiance * 0.22 / max(float(np.median(lit)), 1e-9), 0.0, 1.0) ** (1 / 2.2)


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(difference**2)))


if __name__ == "__main__":
    main()
