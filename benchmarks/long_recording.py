"""A long walk mapped in one piece: how do the memory and the time of `build` and of `slam` grow with its length?

    python benchmarks/long_recording.py [--metres 500 2000] [--slam] [--features surf|both]

The walk leads along a corridor that has no end, whose walls never repeat; its stereo pairs are ray-cast when they are asked for, and their
time is taken off. Each length is mapped in a process of its own.
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

from topoloc.features.kinds import learned_kind
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.map_facts.building import build_map
from topoloc.map.build import BuildConfig
from topoloc.sequences.frame import StereoFrame
from topoloc.slam.slam import run_slam

CAMERA, BASELINE = Camera.pinhole(640, 400, 320.0, 320.0, 319.5, 199.5), 0.12
STEP, HALF_WIDTH, HEIGHT = 0.3, 1.6, 1.5  # metres: from frame to frame, to either wall, to floor and ceiling
TEXELS, PART_M, AHEAD_M = 60.0, 16, 40.0  # a metre; length of a part of a wall; how far is seen
SHARP_M = 5.0  # as far as a pixel is no larger than a texel
LEVEL_FROM_CAM = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # a camera that looks along the world's +y


@lru_cache(maxsize=24)
def part_of_wall(wall: int, number: int) -> Float32[np.ndarray, "h w"]:
    """Grey levels of one part of a wall (0 and 1), the floor (2) or the ceiling (3), along the corridor."""
    rng = np.random.default_rng([wall, number])
    half = HEIGHT if wall < 2 else HALF_WIDTH
    size = (round(2 * half * TEXELS), round(PART_M * TEXELS))
    total = np.zeros(size, np.float32)
    for sigma in (0.8, 1.6, 3.2, 6.4, 13.0):
        noise = cv2.GaussianBlur(rng.standard_normal(size).astype(np.float32), (0, 0), sigma)
        total += noise / noise.std()
    return np.clip(127.5 + (18.0 if wall < 2 else 8.0) * total, 10.0, 245.0)


def picture(world_from_cam: Rigid3, seed: int) -> UInt8[np.ndarray, "400 640"]:
    """What a camera in the corridor sees."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width, dtype=np.float32), np.arange(CAMERA.height, dtype=np.float32))
    fx, fy, cx, cy = CAMERA.params
    rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], -1) @ world_from_cam.rotation.T.astype(np.float32)
    x, y, z = (float(value) for value in world_from_cam.translation)
    with np.errstate(divide="ignore"):
        to_side = (np.copysign(HALF_WIDTH, rays[..., 0]) - x) / rays[..., 0]
        to_flat = (np.copysign(HEIGHT, rays[..., 2]) - z) / rays[..., 2]
    is_side = to_side < to_flat
    distance = np.minimum(np.where(is_side, to_side, to_flat), 1e4)
    along = y + distance * rays[..., 1]
    first = int(y // PART_M)
    across = np.where(is_side, z + distance * rays[..., 2] + HEIGHT, x + distance * rays[..., 0] + HALF_WIDTH) * TEXELS - 0.5
    column = (along - first * PART_M) * TEXELS - 0.5
    grey = np.full(distance.shape, 60.0, np.float32)
    parts = range(first, first + int(AHEAD_M // PART_M) + 1)
    for wall, seen in enumerate((is_side & (rays[..., 0] < 0), is_side & (rays[..., 0] >= 0), ~is_side & (rays[..., 2] < 0), ~is_side)):
        texture = np.hstack([part_of_wall(wall, number) for number in parts])
        near, far = (
            cv2.remap(one, column.astype(np.float32), across.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for one in (texture, cv2.GaussianBlur(texture, (0, 0), 4.0))
        )
        share = np.clip((distance - SHARP_M) / SHARP_M, 0.0, 1.0)  # one pixel takes in ever more texels
        grey = np.where(seen & (along - y < AHEAD_M), (1.0 - share) * near + share * far, grey)
    noise = np.random.default_rng(seed).standard_normal(grey.shape, np.float32)
    return np.clip(np.rint(grey + noise), 0, 255).astype(np.uint8)


@dataclass(eq=False)
class Walk:
    """Stereo pairs along so many metres of the corridor."""

    metres: float
    with_poses: bool = True
    name: str = "walk"
    rendering_s: float = 0.0
    names: list[str] = field(init=False)
    t_ns: list[int] = field(init=False)
    poses: list[Rigid3 | None] = field(init=False)

    def __post_init__(self) -> None:
        count = round(self.metres / STEP)
        self.names = [f"{number:06d}" for number in range(count)]
        self.t_ns = [number * 100_000_000 for number in range(count)]
        self.poses = [pose_at(number) if self.with_poses else None for number in range(count)]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> StereoFrame:
        start = time.thread_time()
        left = pose_at(index)
        right = left @ Rigid3(np.eye(3), np.array([BASELINE, 0.0, 0.0]))
        pair = [picture(pose, 2 * index + k) for k, pose in enumerate((left, right))]
        self.rendering_s += time.thread_time() - start
        rig = StereoRig.rectified(CAMERA, BASELINE)
        return StereoFrame(self.names[index], self.t_ns[index], pair[0], CAMERA, right=pair[1], rig=rig, world_from_cam=self.poses[index])


def pose_at(number: int) -> Rigid3:
    """world_from_cam of a frame: a walk that sways a little."""
    yaw = 0.03 * np.sin(0.2 * number)
    return Rigid3(exp_so3(np.array([0.0, 0.0, yaw])) @ LEVEL_FROM_CAM, np.array([0.2 * np.sin(0.13 * number), STEP * number, 0.0]))


def measured(metres: float, features: str, with_slam: bool) -> dict[str, Any]:
    """Mapped in this process: seconds of its processor without the rendering, and the most memory that it took."""
    cv2.setNumThreads(1)  # a thread's time is all of the rendering's then
    walk = Walk(metres, with_poses=not with_slam)
    start = time.process_time()
    if with_slam:
        found = run_slam(walk)
        row = {"posed": sum(pose is not None for pose in found.poses[0])}
    else:
        topomap = build_map(walk, BuildConfig(other_kinds=(learned_kind(),) if features == "both" else ()))
        with TemporaryDirectory() as folder:
            topomap.save(path := Path(folder) / "walk.topo")
            row = {"nodes": len(topomap.summaries), "map_mb": path.stat().st_size / 1e6}
    seconds = time.process_time() - start - walk.rendering_s
    return row | {"frames": len(walk), "seconds": seconds, "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--metres", type=float, nargs="+", default=[500.0, 2000.0])
    parser.add_argument("--features", choices=["surf", "both"], default="both")
    parser.add_argument("--slam", action="store_true", help="find the poses, instead of building a map with those that are known")
    args = parser.parse_args()
    for metres in args.metres:
        with get_context("spawn").Pool(1) as pool:
            row = pool.apply(measured, (metres, args.features, args.slam))
        made = f"{row['posed']} with a pose" if args.slam else f"{row['nodes']} nodes, {row['map_mb']:.0f} MB"
        print(
            f"{metres:.0f} m, {row['frames']} frames: {made}; {row['seconds']:.0f} s of the processor "
            f"({row['frames'] / row['seconds']:.1f} frames/s), at most {row['peak_mb']:.0f} MB",
            flush=True,
        )


if __name__ == "__main__":
    main()
