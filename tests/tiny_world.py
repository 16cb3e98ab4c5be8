"""Render a small textured room exactly: stereo pairs and depth images along a path, so that tests
need no real recording.

The world has z up. Images are ray-cast plane by plane. The textures are smooth enough to avoid
aliasing at the distances used.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3

CAMERA = Camera.pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
BASELINE = 0.12
DEPTH_FACTOR = 5000.0
NUM_FRAMES = 14
RATE_HZ = 10
# Camera axes (x right, y down, z forward) of a camera that looks along the world's +y.
LEVEL_FROM_CAM = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_TEXELS_PER_METRE = 90.0


@dataclass(frozen=True, eq=False)
class Panel:
    """Hold a textured rectangle: its centre, two unit axes (the texture's right and down), and half
    sides in metres."""

    centre: np.ndarray
    right: np.ndarray
    down: np.ndarray
    half: tuple[float, float]
    texture: np.ndarray


def room(seed: int = 0) -> list[Panel]:
    """Return a back wall, a side wall, a floor, and two boards in front. Another seed is
    another place."""
    up_down = np.array([0.0, 0.0, -1.0])
    shapes = [
        (np.array([0.8, 4.0, 0.0]), np.array([1.0, 0.0, 0.0]), up_down, (3.5, 2.0)),
        (np.array([-1.6, 2.2, 0.0]), np.array([0.3, 0.954, 0.0]), up_down, (2.2, 2.0)),
        (
            np.array([0.8, 2.2, -1.3]),
            np.array([1.0, 0.0, 0.0]),
            np.array([0.0, -1.0, 0.0]),
            (4.0, 2.2),
        ),
        (np.array([0.1, 2.6, -0.4]), np.array([0.95, 0.312, 0.0]), up_down, (0.45, 0.9)),
        (np.array([1.7, 3.0, -0.2]), np.array([0.9, -0.436, 0.0]), up_down, (0.5, 0.7)),
    ]
    return [
        Panel(
            centre,
            right / np.linalg.norm(right),
            down,
            half,
            smooth_texture(100 * seed + number, half),
        )
        for number, (centre, right, down, half) in enumerate(shapes)
    ]


def smooth_texture(seed: int, half: tuple[float, float]) -> np.ndarray:
    """Return noise of several sizes, float32 in [20, 235], without repetition."""
    rng = np.random.default_rng(seed)
    width, height = (round(2 * side * _TEXELS_PER_METRE) for side in half)
    total = np.zeros((height, width), np.float32)
    for sigma in (1.2, 2.5, 5.0, 10.0, 20.0):
        noise = rng.standard_normal((height, width)).astype(np.float32)
        smooth = cv2.GaussianBlur(noise, (0, 0), sigma)
        total += smooth / smooth.std()
    return np.clip(127.5 + 18.0 * total, 20.0, 235.0)


def path_pose(index: float) -> Rigid3:
    """Return world_from_cam of the left camera along the path: 0.13 m per step to the side,
    with a small sway."""
    yaw, pitch = 0.06 * np.sin(0.5 * index), 0.03 * np.cos(0.7 * index)
    sway = exp_so3(np.array([0.0, 0.0, yaw])) @ exp_so3(np.array([pitch, 0.0, 0.0]))
    return Rigid3(
        sway @ LEVEL_FROM_CAM, np.array([0.13 * index, 0.05 * np.sin(index), 0.02 * np.cos(index)])
    )


@cache
def _rays(camera: Camera) -> np.ndarray:
    """Return the directions of the pixels in the camera frame, row by row: 3 x N,
    the third is 1."""
    columns, rows = np.meshgrid(
        np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64)
    )
    normalized = camera.normalized_from_img(np.column_stack([columns.ravel(), rows.ravel()]))
    return np.vstack([normalized.T, np.ones(len(normalized))])


def render(
    panels: list[Panel], world_from_cam: Rigid3, camera: Camera = CAMERA, noise_seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the grey image (uint8, with one grey level of noise) and its exact depth (float64,
    metres, NaN without a surface)."""
    rays = _rays(camera)
    depth = np.full(rays.shape[1], np.inf)
    grey = np.full(rays.shape[1], 127.5, np.float32)
    for panel in panels:
        axes_world = np.stack([np.cross(panel.right, panel.down), panel.right, panel.down])
        towards, to_right, to_down = (
            axes_world @ world_from_cam.rotation
        ) @ rays  # steps along each axis per metre of depth
        begin = axes_world @ (world_from_cam.translation - panel.centre)
        with np.errstate(divide="ignore"):
            z = -begin[0] / towards
        z[~((z > 0) & (z < depth))] = 0.0
        across, along = begin[1] + z * to_right, begin[2] + z * to_down
        seen = (z > 0) & (np.abs(across) < panel.half[0]) & (np.abs(along) < panel.half[1])
        if not seen.any():
            continue
        texel_x, texel_y = (
            np.clip((place + half) * _TEXELS_PER_METRE - 0.5, -1e3, 1e4)
            .astype(np.float32)
            .reshape(camera.height, camera.width)
            for place, half in zip((across, along), panel.half, strict=True)
        )
        shade = cv2.remap(
            panel.texture, texel_x, texel_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        grey[seen], depth[seen] = shade.ravel()[seen], z[seen]
    noisy = grey + np.random.default_rng(noise_seed).normal(0.0, 1.0, len(grey))
    shape = (camera.height, camera.width)
    depth[~np.isfinite(depth)] = np.nan
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8).reshape(shape), depth.reshape(shape)


def right_pose(world_from_left: Rigid3) -> Rigid3:
    """Return world_from_right of the rectified rig."""
    return world_from_left @ Rigid3(np.eye(3), np.array([BASELINE, 0.0, 0.0]))


def tum_line(index: float, world_from_cam: Rigid3) -> str:
    w, x, y, z = world_from_cam.quat_wxyz()
    return " ".join(
        f"{value:.9f}" for value in (index / RATE_HZ, *world_from_cam.translation, x, y, z, w)
    )


def write_stereo_recording(
    folder: Path,
    seed: int = 0,
    indices: list[float] | None = None,
    panels: list[Panel] | None = None,
) -> Path:
    """Write a KITTI-like recording with truth.tum and a camera.json for queries, and
    return `folder`."""
    indices = indices if indices is not None else [float(index) for index in range(NUM_FRAMES)]
    panels = panels or room(seed)
    for side in ("image_0", "image_1"):
        (folder / side).mkdir(parents=True)
    for number, index in enumerate(indices):
        world_from_left = path_pose(index)
        for side, pose in (("image_0", world_from_left), ("image_1", right_pose(world_from_left))):
            picture, _ = render(panels, pose, noise_seed=2 * number + (side == "image_1"))
            assert cv2.imwrite(str(folder / side / f"{number:06d}.png"), picture)
    fx, fy, cx, cy = CAMERA.params
    rows = [
        f"P{number}: {fx} 0 {cx} {-fx * BASELINE * number} 0 {fy} {cy} 0 0 0 1 0"
        for number in (0, 1)
    ]
    (folder / "calib.txt").write_text("\n".join(rows) + "\n")
    _write_times_and_truth(folder, indices)
    (folder / "camera.json").write_text(json.dumps(CAMERA.to_json() | {"baseline": BASELINE}))
    return folder


def write_depth_recording(folder: Path, seed: int = 0, indices: list[float] | None = None) -> Path:
    """Write the same path as images with registered depth, camera.json and truth.tum, and
    return `folder`."""
    indices = indices if indices is not None else [float(index) for index in range(NUM_FRAMES)]
    panels = room(seed)
    for side in ("rgb", "depth"):
        (folder / side).mkdir(parents=True)
    for number, index in enumerate(indices):
        picture, depth = render(panels, path_pose(index), noise_seed=number)
        units = np.nan_to_num(np.rint(depth * DEPTH_FACTOR)).astype(np.uint16)
        assert cv2.imwrite(str(folder / "rgb" / f"{number:06d}.png"), picture)
        assert cv2.imwrite(str(folder / "depth" / f"{number:06d}.png"), units)
    _write_times_and_truth(folder, indices)
    (folder / "camera.json").write_text(
        json.dumps(CAMERA.to_json() | {"depth_factor": DEPTH_FACTOR})
    )
    return folder


def _write_times_and_truth(folder: Path, indices: list[float]) -> None:
    (folder / "times.txt").write_text("".join(f"{index / RATE_HZ:.9f}\n" for index in indices))
    (folder / "truth.tum").write_text(
        "".join(tum_line(index, path_pose(index)) + "\n" for index in indices)
    )
