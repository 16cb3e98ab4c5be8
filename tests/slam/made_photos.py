"""Make the features of photos of a room: known points, poses and noise, without images."""

from __future__ import annotations

import numpy as np

from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.slam.image_tracks import TrackedImage

CAMERA = Camera.pinhole(640, 480, 500.0, 500.0, 319.5, 239.5)
SIGMA_PX = 0.5


def made_photos(num: int = 16, seed: int = 0) -> tuple[list[TrackedImage], list[Rigid3]]:
    """Return photos taken along a wall, half a metre apart and turned a little, and their poses
    (world_from_cam)."""
    rng, side = np.random.default_rng(seed), 0.25 * num
    points = rng.uniform([-side - 1.0, -1.2, 2.0], [side + 1.0, 1.2, 4.5], (50 * num, 3))
    descriptors = rng.normal(size=(len(points), 64))
    images, poses = list[TrackedImage](), list[Rigid3]()
    for k in range(num):
        away = np.array([0.5 * k - side, 0.3 * np.sin(2.0 * k), 0.3 * np.cos(1.3 * k)])
        poses.append(
            Rigid3(exp_so3(np.array([0.05 * np.sin(k), 0.2 * np.sin(1.7 * k), 0.0])), away)
        )
        points_img = CAMERA.img_from_cam(poses[-1].inverse().apply(points))
        rows = np.flatnonzero(CAMERA.is_in_image(points_img))
        points_img = points_img[rows] + SIGMA_PX * rng.normal(size=(len(rows), 2))
        seen = descriptors[rows] + 0.1 * rng.normal(size=(len(rows), 64))
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        ones = np.ones(len(rows), np.float32)
        features = Features(points_img.astype(np.float32), ones, ones, ones, seen.astype("f4"))
        images.append(TrackedImage(CAMERA, points_img, np.full(len(rows), SIGMA_PX), features))
    return images, poses


def with_noise(poses: list[Rigid3], metres: float, degrees: float) -> list[Rigid3]:
    """Return poses with noise of so many metres and degrees an axis."""
    rng = np.random.default_rng(5)
    return [
        Rigid3(
            pose.rotation @ exp_so3(np.radians(degrees) * rng.normal(size=3)),
            pose.translation + metres * rng.normal(size=3),
        )
        for pose in poses
    ]
