"""Estimate the motion of a camera between two images from matched pixels: the rotation and the
direction of the translation, without its length."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from topoloc.geometry.camera import Camera
from topoloc.geometry.pose_sampling import sample_relative_pose
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
    on_planes = rays[0][kept], rays[1][kept]
    if (found := sample_relative_pose(*on_planes, focal, _MAX_EPIPOLAR_ERROR_PX)) is None:
        return None
    second_from_first, inliers = found[0], np.zeros(len(first_img), bool)
    inliers[kept] = found[1]
    rotation, translation = second_from_first.rotation, second_from_first.translation
    distance = float(np.linalg.norm(translation))
    if distance == 0.0:
        return None
    firsts, seconds = (np.insert(rays_of[inliers], 2, 1.0, axis=1) for rays_of in rays)
    rotated = firsts @ rotation.T
    lengths = np.linalg.norm(rotated, axis=1) * np.linalg.norm(seconds, axis=1)
    cosines = np.sum(rotated * seconds, axis=1) / lengths
    if np.median(np.arccos(np.clip(cosines, -1.0, 1.0))) < _MIN_PARALLAX:
        return None
    return RelativePose(Rigid3(rotation, translation / distance), inliers)
