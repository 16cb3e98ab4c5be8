"""Estimate the motion of a camera between two images from matched pixels: the rotation and the
direction of the translation, without its length.

The method is PoseLib's five-point method in LO-RANSAC (https://github.com/PoseLib/PoseLib).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import poselib
from jaxtyping import Bool, Float

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

_MAX_EPIPOLAR_ERROR_PX = 1.5
_MIN_PARALLAX = math.radians(1.0)


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Hold a relative pose. `second_from_first` has a translation of length 1. `inliers` are the
    points that agree with it."""

    second_from_first: Rigid3
    inliers: Bool[np.ndarray, " n"]


def estimate_relative_pose(
    first_img: Float[np.ndarray, "n 2"],
    first: Camera,
    second_img: Float[np.ndarray, "n 2"],
    second: Camera,
) -> RelativePose | None:
    """Return the relative pose from pixels of the same points in two images. Return None if none is
    found or the camera moved too little.

    The translation must be visible: the median displacement of the inliers beyond the rotation must
    be at least one degree.
    """
    if len(first_img) < 8:
        return None
    rays = [first.normalized_from_img(first_img), second.normalized_from_img(second_img)]
    kept = np.flatnonzero(np.isfinite(np.column_stack(rays)).all(axis=1))
    if len(kept) < 8:
        return None
    focal = 0.5 * (first.fx + second.fx)
    size = {"width": first.width, "height": first.height}
    pinhole = {"model": "SIMPLE_PINHOLE", **size, "params": [focal, 0.0, 0.0]}
    ransac = {"max_epipolar_error": _MAX_EPIPOLAR_ERROR_PX, "seed": 0}
    pose, ransac_info = poselib.estimate_relative_pose(
        focal * rays[0][kept], focal * rays[1][kept], pinhole, pinhole, ransac, {}
    )
    matrix, inliers = np.asarray(pose.Rt, dtype=np.float64), np.zeros(len(first_img), bool)
    inliers[kept] = ransac_info["inliers"]
    distance = float(np.linalg.norm(matrix[:, 3]))
    if not np.isfinite(matrix).all() or distance == 0.0 or not inliers.any():
        return None
    firsts, seconds = (np.insert(rays_of[inliers], 2, 1.0, axis=1) for rays_of in rays)
    rotated = firsts @ matrix[:, :3].T
    lengths = np.linalg.norm(rotated, axis=1) * np.linalg.norm(seconds, axis=1)
    cosines = np.sum(rotated * seconds, axis=1) / lengths
    if np.median(np.arccos(np.clip(cosines, -1.0, 1.0))) < _MIN_PARALLAX:
        return None
    return RelativePose(Rigid3(matrix[:, :3].copy(), matrix[:, 3] / distance), inliers)
