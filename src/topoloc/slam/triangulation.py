"""Triangulate points from the rays of several key frames of a single camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from topoloc.slam.keyframes import KeyFrame


def triangulate_points(
    keyframes: Sequence[KeyFrame], ids: Int[np.ndarray, " n"]
) -> tuple[
    Float[np.ndarray, "n 3"],
    Int[np.ndarray, " n"],
    Float[np.ndarray, " n"],
    Float[np.ndarray, " n"],
]:
    """Triangulate the points with these ids (ascending) from all observations, active or not.

    Return the points nearest to all rays (world), the number of rays, the largest angle between the
    first ray and another (radians), and the largest reprojection error (pixels), infinite behind a
    camera. Point and error are NaN if the point cannot be triangulated.
    """
    num = len(ids)
    rows_of_each, rays, pixels_of_each = [], [], []
    for keyframe in keyframes:
        observed = keyframe.observations
        chosen = np.flatnonzero(np.isin(observed.landmark_ids, ids))
        points_img = observed.measured[chosen, :2].astype(np.float64)
        world_from_cam = keyframe.cam_from_world.inverse()
        directions = keyframe.stereo.camera.rays_from_img(points_img) @ world_from_cam.rotation.T
        rays.append((np.tile(world_from_cam.translation, (len(chosen), 1)), directions))
        rows_of_each.append(np.searchsorted(ids, observed.landmark_ids[chosen]))
        pixels_of_each.append(points_img)
    rows = np.concatenate(rows_of_each)
    centres, directions = map(np.concatenate, zip(*rays, strict=True))
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    normal, right = np.zeros((num, 3, 3)), np.zeros((num, 3))
    np.add.at(normal, rows, across)
    np.add.at(right, rows, np.einsum("mij,mj->mi", across, centres))
    num_rays = np.bincount(rows, minlength=num)
    solvable = (num_rays > 1) & (np.abs(np.linalg.det(normal)) > 1e-12)
    points = np.full((num, 3), np.nan)
    points[solvable] = np.linalg.solve(normal[solvable], right[solvable, :, None])[:, :, 0]
    first = np.zeros((num, 3))
    first[rows[::-1]] = directions[::-1]
    parallax, worst = np.zeros(num), np.where(solvable, 0.0, np.nan)
    cosines = np.clip(np.sum(first[rows] * directions, axis=1), -1.0, 1.0)
    np.maximum.at(parallax, rows, np.arccos(cosines))
    for keyframe, of_it, points_img in zip(keyframes, rows_of_each, pixels_of_each, strict=True):
        projected = keyframe.stereo.project(keyframe.cam_from_world.apply(points[of_it]))[:, :2]
        distances = np.linalg.norm(projected - points_img, axis=1)
        np.maximum.at(worst, of_it, np.nan_to_num(distances, nan=np.inf))
    return points, num_rays, parallax, worst
