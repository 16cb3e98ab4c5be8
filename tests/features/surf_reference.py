"""Compute orientation and descriptor of OpenCV's SURF slowly in NumPy, as a reference for tests."""

from __future__ import annotations

import cv2
import numpy as np


def _gaussian(length: int, sigma: float) -> np.ndarray:
    return cv2.getGaussianKernel(length, sigma, cv2.CV_32F).ravel()


def _orientation_deg(integral: np.ndarray, x: float, y: float, s: float) -> float:
    radius = 6
    dx, dy = (grid.ravel() for grid in np.mgrid[-radius : radius + 1, -radius : radius + 1])
    inside = dx**2 + dy**2 <= radius**2
    weights = np.outer(_gaussian(13, 2.5), _gaussian(13, 2.5)).ravel()[inside]
    side = 2 * round(2 * s)
    left = np.rint(x + dx[inside] * s - (side - 1) / 2).astype(int)
    top = np.rint(y + dy[inside] * s - (side - 1) / 2).astype(int)
    valid = (
        (left >= 0)
        & (top >= 0)
        & (left < integral.shape[1] - side)
        & (top < integral.shape[0] - side)
    )
    left, top, weights = left[valid], top[valid], weights[valid]

    def box(x0: int, y0: int, x1: int, y1: int) -> np.ndarray:
        at = lambda x, y: integral[top + y, left + x].astype(np.int64)  # noqa: E731
        return at(x1, y1) + at(x0, y0) - at(x0, y1) - at(x1, y0)

    half = side // 2
    across = ((box(half, 0, side, side) - box(0, 0, half, side)) * weights).astype(np.float32)
    down = ((box(0, half, side, side) - box(0, 0, side, half)) * weights).astype(np.float32)
    directions = np.rint(cv2.phase(across, -down, angleInDegrees=True).ravel())
    apart = abs(directions[None] - np.arange(0, 360, 5)[:, None])
    window = (apart < 30) | (apart > 330)
    sums = np.stack([window @ across, window @ down], axis=1)
    best_x, best_y = sums[np.argmax(np.sum(sums**2, axis=1))]
    return cv2.fastAtan2(float(best_y), float(best_x))


def _descriptor(image: np.ndarray, x: float, y: float, s: float, angle_deg: float) -> np.ndarray:
    side = int(21 * s)
    cosine, sine = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    along, across = np.meshgrid(np.arange(side) - (side - 1) / 2, np.arange(side) - (side - 1) / 2)
    map_x, map_y = x + along * cosine - across * sine, y + along * sine + across * cosine
    map_x, map_y = (
        np.clip(map_x, 0, image.shape[1] - 1.001),
        np.clip(map_y, 0, image.shape[0] - 1.001),
    )
    left, top = map_x.astype(int), map_y.astype(int)
    fx, fy = map_x - left, map_y - top
    grey = image.astype(np.float64)
    upper = grey[top, left] * (1 - fx) + grey[top, left + 1] * fx
    lower = grey[top + 1, left] * (1 - fx) + grey[top + 1, left + 1] * fx
    window = np.rint(upper * (1 - fy) + lower * fy).astype(np.uint8)
    patch = cv2.resize(window, (21, 21), interpolation=cv2.INTER_AREA).astype(np.float32)
    weights = np.outer(_gaussian(20, 3.3), _gaussian(20, 3.3))
    dx = (patch[:-1, 1:] - patch[:-1, :-1] + patch[1:, 1:] - patch[1:, :-1]) * weights
    dy = (patch[1:, :-1] - patch[:-1, :-1] + patch[1:, 1:] - patch[:-1, 1:]) * weights
    cells = (
        np.stack([dx, dy, abs(dx), abs(dy)], axis=-1)
        .reshape(4, 5, 4, 5, 4)
        .sum(axis=(1, 3))
        .ravel()
    )
    return cells / (np.linalg.norm(cells) + np.finfo(np.float32).eps)


def describe_as_opencv(image: np.ndarray, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return angles in degrees (n,) and descriptors (n, 64) of key points (n, 3) = x, y, size."""
    integral = cv2.integral(image)
    angles_deg, descriptors = [], []
    for x, y, size in keypoints.tolist():
        s = float(np.float32(size) * np.float32(1.2 / 9))
        angles_deg.append(_orientation_deg(integral, x, y, s))
        descriptors.append(_descriptor(image, x, y, s, angles_deg[-1]))
    return np.array(angles_deg), np.array(descriptors, np.float32)
