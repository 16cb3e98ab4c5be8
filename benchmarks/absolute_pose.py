"""Compare robust PnP of topoloc and plain OpenCV: time and success over the number of matches and
the share of outliers.

    python benchmarks/absolute_pose.py [--num-scenes 20] [--json FILE]

Scenes are simulated: 752x480 pinhole, points 2 to 12 m away, 1 px of key point noise, stereo points
with an uncertain depth. A scene is solved if the position is within 0.25 m and the rotation within
2 degrees. Times are medians over the scenes of the fastest of three calls, on one thread, from the
matches to the pose (of topoloc also to its covariance).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from topoloc.geometry.absolute_pose import AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

CAMERA = Camera.pinhole(752, 480, 458.0, 457.0, 367.0, 248.0)


@dataclass
class Scene:
    points_img: np.ndarray
    points_world: np.ndarray
    covariances: np.ndarray
    priorities: np.ndarray
    cam_from_world: Rigid3


def make_scene(rng: np.random.Generator, n: int, outliers: float) -> Scene:
    cam_from_world = Rigid3.exp(np.concatenate([rng.normal(size=3) * 2, rng.normal(size=3)]))
    pixels = rng.uniform([0, 0], [CAMERA.width - 1, CAMERA.height - 1], (n, 2))
    points_cam = CAMERA.rays_from_img(pixels) * rng.uniform(2.0, 12.0, (n, 1))
    points_world = cam_from_world.inverse().apply(points_cam)
    # The mapping camera stood half a metre beside and a metre behind; its depth error is that of a
    # 12 cm baseline.
    rays = points_world - cam_from_world.inverse().apply(np.array([0.5, 0.0, -1.0]))
    distances = np.linalg.norm(rays, axis=1, keepdims=True)
    rays /= distances
    sigmas = 0.5 / (458.0 * 0.12) * distances**2
    points_world = points_world + rays * sigmas * rng.normal(size=(n, 1))
    covariances = sigmas[:, :, None] ** 2 * rays[:, :, None] * rays[:, None, :] + 1e-6 * np.eye(3)
    pixels = pixels + rng.normal(size=(n, 2))
    is_outlier = rng.permutation(n) < round(outliers * n)
    pixels[is_outlier] = rng.uniform(
        [0, 0], [CAMERA.width - 1, CAMERA.height - 1], (np.count_nonzero(is_outlier), 2)
    )
    # As a ratio test would tell: right matches mostly, not always, before wrong ones.
    priorities = rng.normal(size=n) + np.where(is_outlier, 0.0, 1.5)
    return Scene(pixels, points_world, covariances, priorities, cam_from_world)


def with_topoloc(
    scene: Scene, config: AbsolutePoseConfig, covariances: bool, priorities: bool
) -> Rigid3 | None:
    pose = estimate_absolute_pose(
        scene.points_img,
        scene.points_world,
        CAMERA,
        config,
        point_covariances=scene.covariances if covariances else None,
        priorities=scene.priorities if priorities else None,
    )
    return None if pose is None else pose.cam_from_world


def with_opencv(scene: Scene, **settings: Any) -> Rigid3 | None:
    found, rotation, translation, _ = cv2.solvePnPRansac(
        scene.points_world, scene.points_img, CAMERA.matrix(), None, **settings
    )
    return Rigid3(cv2.Rodrigues(rotation)[0], translation[:, 0]) if found else None


SOLVERS: dict[str, Callable[[Scene], Rigid3 | None]] = {
    "topoloc": lambda scene: with_topoloc(scene, AbsolutePoseConfig(), True, False),
    "topoloc, priorities": lambda scene: with_topoloc(scene, AbsolutePoseConfig(), True, True),
    "topoloc, points taken as exact": lambda scene: with_topoloc(
        scene, AbsolutePoseConfig(), False, False
    ),
    "topoloc, method opencv": lambda scene: with_topoloc(
        scene, AbsolutePoseConfig(method="opencv"), True, False
    ),
    "OpenCV, its defaults": with_opencv,
    "OpenCV, USAC_MAGSAC": lambda scene: with_opencv(
        scene, flags=cv2.USAC_MAGSAC, reprojectionError=4.0, iterationsCount=5000, confidence=0.9999
    ),
}


def run_timed(solve: Callable[[Scene], Rigid3 | None], scene: Scene) -> tuple[Rigid3 | None, float]:
    start = time.perf_counter()
    found = solve(scene)
    return found, 1e3 * (time.perf_counter() - start)


def measure(solve: Callable[[Scene], Rigid3 | None], scenes: list[Scene]) -> dict[str, float]:
    times_ms, errors = [], []
    for scene in scenes:
        runs = [run_timed(solve, scene) for _ in range(3)]
        times_ms.append(min(time_ms for _, time_ms in runs))
        found = runs[0][0]
        if found is not None:
            position = translation_error(found.inverse(), scene.cam_from_world.inverse())
            errors.append((position, np.rad2deg(rotation_error(found, scene.cam_from_world))))
    good = [error for error in errors if error[0] < 0.25 and error[1] < 2.0]
    translation_m, rotation_deg = np.median(good, axis=0) if good else (np.nan, np.nan)
    return {
        "median_ms": float(np.median(times_ms)),
        "max_ms": float(np.max(times_ms)),
        "solved": len(good) / len(scenes),
        "wrong": (len(errors) - len(good)) / len(scenes),
        "median_translation_m": float(translation_m),
        "median_rotation_deg": float(rotation_deg),
    }


def main(num_scenes: int = 20, json_file: Path | None = None) -> None:
    """Print the table; write it to `json_file`, if given."""
    cv2.setNumThreads(1)
    for solve in SOLVERS.values():
        solve(make_scene(np.random.default_rng(0), 100, 0.1))  # compiled once
    rows = []
    for n in (100, 200, 500, 1000):
        for outliers in (0.1, 0.5, 0.7, 0.9):
            rng = np.random.default_rng(n)
            scenes = [make_scene(rng, n, outliers) for _ in range(num_scenes)]
            rows += [
                {"num_matches": n, "outliers": outliers, "solver": name} | measure(solve, scenes)
                for name, solve in SOLVERS.items()
            ]
    table = Table(
        "matches", "outliers", "solver", "median ms", "max ms", "solved", "wrong", "cm", "deg"
    )
    for row in rows:
        times = [f"{row[key]:.2f}" for key in ("median_ms", "max_ms")]
        shares = [f"{row[key]:.0%}" for key in ("solved", "wrong")]
        errors = [f"{100 * row['median_translation_m']:.2f}", f"{row['median_rotation_deg']:.3f}"]
        table.add_row(
            str(row["num_matches"]),
            f"{row['outliers']:.0%}",
            row["solver"],
            *times,
            *shares,
            *errors,
        )
    Console().print(table)
    if json_file is not None:
        json_file.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    tyro.cli(main)
