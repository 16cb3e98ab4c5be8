"""Triangulate points from the rays of several key frames of a single camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.slam.keyframes import KeyFrame


@dataclass(frozen=True, eq=False)
class TriangulatedPoints:
    """Hold triangulated points.

    `points` are nearest to all rays (world). `num_rays` is their number. `parallax` is the largest
    angle between the first ray and another (radians). `max_reprojection_px` is the largest
    reprojection error, infinite behind a camera. `points` and `max_reprojection_px` are NaN if the
    point cannot be triangulated.
    """

    points: Float[np.ndarray, "n 3"]
    num_rays: Int[np.ndarray, " n"]
    parallax: Float[np.ndarray, " n"]
    max_reprojection_px: Float[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class _RayObservations:
    """Hold all observations of the points.

    They are the point row, key frame, pixel, and the centre and unit direction of the ray (world).
    """

    rows: Int[np.ndarray, " m"]
    frames: Int[np.ndarray, " m"]
    points_img: Float[np.ndarray, "m 2"]
    centres: Float[np.ndarray, "m 3"]
    directions: Float[np.ndarray, "m 3"]


def triangulate_points(
    keyframes: Sequence[KeyFrame], ids: Int[np.ndarray, " n"]
) -> TriangulatedPoints:
    """Triangulate the points with these ids (ascending) from all observations, active or not."""
    ray_observations, num = _collect_observations(keyframes, ids), len(ids)
    across = (
        np.eye(3)
        - ray_observations.directions[:, :, None] * ray_observations.directions[:, None, :]
    )
    normal, right = np.zeros((num, 3, 3)), np.zeros((num, 3))
    np.add.at(normal, ray_observations.rows, across)
    np.add.at(
        right, ray_observations.rows, np.einsum("mij,mj->mi", across, ray_observations.centres)
    )
    num_rays = np.bincount(ray_observations.rows, minlength=num)
    solvable = (num_rays > 1) & (np.abs(np.linalg.det(normal)) > 1e-12)
    points = np.full((num, 3), np.nan)
    points[solvable] = np.linalg.solve(normal[solvable], right[solvable, :, None])[:, :, 0]
    first = np.zeros((num, 3))
    first[ray_observations.rows[::-1]] = ray_observations.directions[::-1]
    parallax, worst = np.zeros(num), np.where(solvable, 0.0, np.nan)
    cosines = np.clip(
        np.sum(first[ray_observations.rows] * ray_observations.directions, axis=1), -1.0, 1.0
    )
    np.maximum.at(parallax, ray_observations.rows, np.arccos(cosines))
    np.maximum.at(
        worst,
        ray_observations.rows,
        _compute_reprojection_errors(keyframes, ray_observations, points),
    )
    return TriangulatedPoints(points, num_rays, parallax, worst)


def _collect_observations(
    keyframes: Sequence[KeyFrame], ids: Int[np.ndarray, " n"]
) -> _RayObservations:
    parts: list[tuple[np.ndarray, ...]] = []
    for number, keyframe in enumerate(keyframes):
        observed = keyframe.observations
        chosen = np.flatnonzero(np.isin(observed.landmark_ids, ids))
        points_img = observed.measured[chosen, :2].astype(np.float64)
        world_from_cam = keyframe.cam_from_world.inverse()
        directions = keyframe.stereo.camera.rays_from_img(points_img) @ world_from_cam.rotation.T
        centres = np.tile(world_from_cam.translation, (len(chosen), 1))
        rows = np.searchsorted(ids, observed.landmark_ids[chosen])
        parts.append((rows, np.full(len(chosen), number), points_img, centres, directions))
    return _RayObservations(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _compute_reprojection_errors(
    keyframes: Sequence[KeyFrame],
    ray_observations: _RayObservations,
    points: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, " m"]:
    distances = np.full(len(ray_observations.rows), np.inf)
    for number, keyframe in enumerate(keyframes):
        of_it = np.flatnonzero(ray_observations.frames == number)
        projected = keyframe.stereo.project(
            keyframe.cam_from_world.apply(points[ray_observations.rows[of_it]])
        )[:, :2]
        distances[of_it] = np.nan_to_num(
            np.linalg.norm(projected - ray_observations.points_img[of_it], axis=1), nan=np.inf
        )
    return distances


def is_well_triangulated(
    found: TriangulatedPoints, min_rays: int, min_parallax: float, max_px: float
) -> Bool[np.ndarray, " n"]:
    """Return a mask of the points that are triangulated accurately enough."""
    with np.errstate(invalid="ignore"):
        return (
            (found.num_rays >= min_rays)
            & (found.parallax >= min_parallax)
            & (found.max_reprojection_px <= max_px)
        )
