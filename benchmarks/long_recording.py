"""Measure memory and time of `build` and `slam` over the length of a recording.

    python benchmarks/long_recording.py [--metres 500 2000] [--lap METRES] [--step METRES] [--slam]
    [--features surf|both]

The walk follows a corridor in the shape of a ring, once around, or in laps of `--lap` metres. Its
stereo pairs are ray-cast on access, and their time is subtracted. Each length is mapped in a
process of its own. With `--slam` the trajectory is compared with ground truth, too.
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import dataclass, field
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from topoloc.features.feature_types import default_learned_type
from topoloc.geometry.alignment import absolute_trajectory_errors
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.recordings.frame import StereoFrame
from topoloc.slam.slam import run_slam

CAMERA, BASELINE = Camera.pinhole(640, 400, 320.0, 320.0, 319.5, 199.5), 0.12
HALF_WIDTH, HEIGHT = 1.6, 1.5  # metres: to either wall, to floor and ceiling
TEXELS, PART_M, AHEAD_M = 60.0, 16, 40.0  # a metre; length of a part of a wall; how far is seen
SHARP_M = 5.0  # as far as a pixel is no larger than a texel
NUM_NOISE = 8  # pictures of the sensor's noise
LEVEL_FROM_CAM = np.array(
    [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
)  # a camera that looks along the world's +y
FIRST_ROWS = np.cumsum([0, *(round(2 * half * TEXELS) for half in (HEIGHT, HEIGHT, HALF_WIDTH))])
"""Of the inner wall, the outer one, the floor and the ceiling in a picture of all four, one below
the other."""


@lru_cache(maxsize=6)
def part_of_corridor(number: int) -> Float32[np.ndarray, "h w 2"]:
    """Grey levels of one part of walls, floor and ceiling: as they are, and as a far pixel takes in
    many of them."""
    walls = []
    for wall in range(4):
        rng = np.random.default_rng([wall, number])
        size = (round(2 * (HEIGHT if wall < 2 else HALF_WIDTH) * TEXELS), round(PART_M * TEXELS))
        total = np.zeros(size, np.float32)
        for sigma in (0.8, 1.6, 3.2, 6.4, 13.0):
            noise = cv2.GaussianBlur(rng.standard_normal(size, np.float32), (0, 0), sigma)
            total += noise / noise.std()
        sharp = np.clip(127.5 + (18.0 if wall < 2 else 8.0) * total, 10.0, 245.0)
        walls.append(np.stack([sharp, cv2.GaussianBlur(sharp, (0, 0), 4.0)], -1))
    return np.concatenate(walls)


@lru_cache(maxsize=1)
def corridor_from(first: int, num_parts: int) -> Float32[np.ndarray, "h w 2"]:
    """Return the part `first` and the visible parts after it, in a ring of `num_parts` parts."""
    return np.hstack(
        [
            part_of_corridor(number % num_parts)
            for number in range(first, first + int(AHEAD_M // PART_M) + 2)
        ]
    )


@lru_cache(maxsize=NUM_NOISE)
def sensor_noise(seed: int) -> Float32[np.ndarray, "400 640"]:
    return np.random.default_rng(seed).standard_normal((CAMERA.height, CAMERA.width), np.float32)


@lru_cache(maxsize=1)
def rays_cam() -> Float32[np.ndarray, "400 640 3"]:
    columns, rows = np.meshgrid(
        np.arange(CAMERA.width, dtype=np.float32), np.arange(CAMERA.height, dtype=np.float32)
    )
    fx, fy, cx, cy = (np.float32(value) for value in CAMERA.params)
    return np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], -1)


def picture(world_from_cam: Rigid3, num_parts: int, seed: int) -> UInt8[np.ndarray, "400 640"]:
    """Render the view of a camera in the corridor, whose centre line is a ring of `num_parts` parts
    around the world's z axis."""
    radius = num_parts * PART_M / (2 * np.pi)
    x, y, z = world_from_cam.translation
    angle, at = np.arctan2(y, x), float(np.hypot(x, y))
    outwards_from_cam = (
        exp_so3(np.array([0.0, 0.0, -angle])) @ world_from_cam.rotation
    )  # axes: outwards, along, up
    out, along, up = np.moveaxis(rays_cam() @ outwards_from_cam.T.astype(np.float32), -1, 0)
    squared, inwards = out * out + along * along, np.float32(at) * out
    with np.errstate(divide="ignore", invalid="ignore"):
        inner, outer = (
            (at - wall) * (at + wall) for wall in (radius - HALF_WIDTH, radius + HALF_WIDTH)
        )
        to_outer = np.sqrt(inwards * inwards - squared * np.float32(outer)) - inwards
        to_outer = np.where(
            inwards > 0, np.float32(-outer) / (to_outer + 2 * inwards), to_outer / squared
        )
        to_inner = np.float32(inner) / (
            np.sqrt(inwards * inwards - squared * np.float32(inner)) - inwards
        )
        to_inner = np.where((inwards < 0) & np.isfinite(to_inner), to_inner, np.float32(np.inf))
        to_flat = (np.copysign(np.float32(HEIGHT), up) - np.float32(z)) / up
    to_side = np.minimum(to_inner, to_outer)
    is_side, distance = to_side < to_flat, np.minimum(to_side, to_flat)
    wall = np.where(is_side, to_outer <= to_inner, np.where(up < 0, 2, 3))
    out_there, along_there = np.float32(at) + distance * out, distance * along
    beside = np.sqrt(out_there * out_there + along_there * along_there) - np.float32(radius)
    across = np.where(
        is_side, np.float32(z) + distance * up + np.float32(HEIGHT), beside + np.float32(HALF_WIDTH)
    )
    turned = angle % (2 * np.pi) * radius
    first = int(turned // PART_M)
    ahead = np.float32(radius) * np.arctan2(along_there, out_there)
    column = (np.float32(turned - first * PART_M) + ahead) * np.float32(TEXELS)
    row = across * np.float32(TEXELS) - np.float32(0.5) + FIRST_ROWS.astype(np.float32)[wall]
    texture = corridor_from(first, num_parts)
    both = cv2.remap(texture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    share = np.clip(
        (distance - np.float32(SHARP_M)) / np.float32(SHARP_M), 0.0, 1.0
    )  # one pixel takes in ever more texels
    grey = np.where(
        distance < AHEAD_M, both[..., 0] + share * (both[..., 1] - both[..., 0]), np.float32(60.0)
    )
    return np.clip(np.rint(grey + sensor_noise(seed % NUM_NOISE)), 0, 255).astype(np.uint8)


@dataclass(eq=False)
class Walk:
    """Hold stereo pairs along the corridor, which returns to its start after `lap` metres, with a
    frame each `step` metres."""

    metres: float
    lap: float
    step: float = 0.3
    with_poses: bool = True
    name: str = "walk"
    rendering_s: float = 0.0
    names: list[str] = field(init=False)
    t_ns: list[int] = field(init=False)
    poses: list[Rigid3 | None] = field(init=False)

    def __post_init__(self) -> None:
        count = round(self.metres / self.step)
        self.num_parts = round(self.lap / PART_M)
        self.names = [f"{number:06d}" for number in range(count)]
        self.t_ns = [number * 100_000_000 for number in range(count)]
        self.poses = [
            self.true_pose(number) if self.with_poses else None for number in range(count)
        ]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> StereoFrame:
        start = time.thread_time()
        left = self.true_pose(index)
        right = left @ Rigid3(np.eye(3), np.array([BASELINE, 0.0, 0.0]))
        pair = [
            picture(pose, self.num_parts, 2 * index + k) for k, pose in enumerate((left, right))
        ]
        self.rendering_s += time.thread_time() - start
        rig = StereoRig.rectified(CAMERA, BASELINE)
        return StereoFrame(
            self.names[index],
            self.t_ns[index],
            pair[0],
            CAMERA,
            right=pair[1],
            rig=rig,
            world_from_cam=self.poses[index],
        )

    def true_pose(self, number: int) -> Rigid3:
        """world_from_cam of a frame: a walk that sways a little."""
        radius = self.num_parts * PART_M / (2 * np.pi)
        angle, aside = number * self.step / radius, radius + 0.2 * np.sin(0.43 * number * self.step)
        turned = exp_so3(np.array([0.0, 0.0, angle + 0.03 * np.sin(0.67 * number * self.step)]))
        return Rigid3(
            turned @ LEVEL_FROM_CAM, np.array([aside * np.cos(angle), aside * np.sin(angle), 0.0])
        )


def measured(walk: Walk, features: str, with_slam: bool) -> dict[str, Any]:
    """Mapped in this process: seconds of its processor without the rendering, and the most memory
    that it took."""
    cv2.setNumThreads(1)  # a thread's time is all of the rendering's then
    start = time.process_time()
    if with_slam:
        found = run_slam(walk)
        both = [
            (walk.true_pose(i), pose) for i, pose in enumerate(found.poses[0]) if pose is not None
        ]
        off = absolute_trajectory_errors([true for true, _ in both], [pose for _, pose in both])
        counts = f"{found.num_keyframes} key frames, {found.num_loops} loops"
        made = (
            f"{len(both)} with a pose, {counts}, {100 * np.sqrt(np.mean(off**2)):.2f} cm off (root"
            " mean square)"
        )
    else:
        topomap = build_map(
            walk, BuildConfig(other_kinds=(default_learned_type(),) if features == "both" else ())
        )
        with TemporaryDirectory() as folder:
            topomap.save(path := Path(folder) / "walk.topo")
            made = f"{len(topomap.summaries)} nodes, {path.stat().st_size / 1e6:.0f} MB"
    seconds = time.process_time() - start - walk.rendering_s
    return {
        "made": made,
        "frames": len(walk),
        "seconds": seconds,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--metres", type=float, nargs="+", default=[500.0, 2000.0])
    parser.add_argument(
        "--lap",
        type=float,
        help=(
            "metres after which the corridor is back at its beginning; all of it, where this is not"
            " said"
        ),
    )
    parser.add_argument("--step", type=float, default=0.3, help="metres from frame to frame")
    parser.add_argument("--features", choices=["surf", "both"], default="both")
    parser.add_argument(
        "--slam",
        action="store_true",
        help="find the poses, instead of building a map with those that are known",
    )
    args = parser.parse_args()
    for metres in args.metres:
        walk = Walk(metres, args.lap or metres + 2 * AHEAD_M, args.step, with_poses=not args.slam)
        with get_context("spawn").Pool(1) as pool:
            row = pool.apply(measured, (walk, args.features, args.slam))
        print(
            f"{metres:.0f} m, {row['frames']} frames: {row['made']}; {row['seconds']:.0f} s of the"
            f" processor ({row['frames'] / row['seconds']:.1f} frames/s), at most"
            f" {row['peak_mb']:.0f} MB",
            flush=True,
        )


if __name__ == "__main__":
    main()
