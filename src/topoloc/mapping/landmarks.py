"""Refine a node's points with observations in other mapping images.

One stereo pair or depth image measures a point once, over a short baseline. Near mapping images see
it from other known poses. Each point is triangulated from all of them, with the first measurement
as the prior. This shortens the long axis of its covariance and reveals mismatched or moving points.
Each session's contribution is kept as sums (`landmark_statistics.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.compiled import kernel
from topoloc.features.features import Features, MatchingConfig
from topoloc.features.matching import match_features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.landmark_statistics import LandmarkStatistics
from topoloc.points.metric_points import keypoint_sigmas

_CAUCHY_SCALE = 2.385  # in standard deviations of a residual
NODES_PER_IMAGE = 3  # nodes whose points a mapping image observes, the nearest ones


@dataclass(frozen=True, eq=False)
class Observations:
    """Hold one mapping image's observations of a node's points.

    Point `rows[k]` is observed at `normalized[k]` (plane z = 1) with standard deviation
    `sigmas[k]`. `cam_from_node` is the transform into the image's camera. `in_view` lists the
    points inside the image, observed or not. The image belongs to the session `session_id`.
    """

    rows: Int[np.ndarray, " m"]
    normalized: Float[np.ndarray, "m 2"]
    sigmas: Float[np.ndarray, " m"]
    cam_from_node: Rigid3
    in_view: Int[np.ndarray, " v"] = field(default_factory=lambda: np.zeros(0, np.int64))
    session_id: int = 0


@dataclass(frozen=True, eq=False)
class RefinedPoints:
    """Hold refined points. `is_consistent` is False for points that contradict their observations.
    `num_observations` counts images other than the node's own."""

    points_cam: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    num_observations: Int[np.ndarray, " n"]
    is_consistent: Bool[np.ndarray, " n"]


def observe_points(
    node_features: Features,
    points_cam: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
    features: Features,
    camera: Camera,
    cam_from_node: Rigid3,
    session_id: int = 0,
) -> Observations:
    """Find a node's points among the features of another mapping image, by descriptor and by
    expected projection."""
    # Sigma in pixels added to a key point's own sigma, for errors of mapping poses and
    # rectification.
    pose_sigma_px = 0.7
    # Maximum distance of an observation from the point's projection, in standard deviations
    # of both.
    gate = 4.0
    matches = match_features(
        node_features.descriptors, features.descriptors, MatchingConfig(ratio=0.85)
    )
    rows, columns = matches.query_idx.astype(np.int64), matches.train_idx
    normalized = camera.normalized_from_img(features.points_img[columns].astype(np.float64))
    sigmas = np.hypot(keypoint_sigmas(features)[columns], pose_sigma_px) / camera.fx
    residuals, jacobians, in_front = _project(points_cam[rows], normalized, cam_from_node)
    expected = jacobians @ covariances[rows] @ jacobians.transpose(0, 2, 1) + sigmas[
        :, None, None
    ] ** 2 * np.eye(2)
    squares = np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(expected), residuals)
    seen = in_front & (squares < gate**2)
    with np.errstate(invalid="ignore"):
        pixels = camera.img_from_cam(cam_from_node.apply(points_cam))
    in_view = np.flatnonzero(camera.is_in_image(pixels))  # hidden points, too
    return Observations(
        rows[seen], normalized[seen], sigmas[seen], cam_from_node, in_view, session_id
    )


def refine_points(
    points_cam: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
    observations: list[Observations],
    num_iterations: int = 6,
) -> RefinedPoints:
    """Triangulate a node's points (node's camera frame, metres) from all observations with fixed
    poses, by `num_iterations` Gauss-Newton steps per point with Cauchy loss on each observation.
    The first measurement and its covariance are the prior."""
    # Points are dropped if the root mean square of their refined residuals exceeds this, in
    # standard deviations.
    max_disagreement, prior = 3.0, np.linalg.inv(covariances)
    points, information = points_cam.copy(), prior
    for _ in range(num_iterations):
        information, gradient, _ = _normal_equations(points, points_cam, prior, observations)
        points = points - np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
    information, _, squares = _normal_equations(points, points_cam, prior, observations)
    num_observations = _count_observations(len(points), observations)[1]
    rms = np.sqrt(squares / np.maximum(2 * num_observations, 1))
    is_consistent = (rms < max_disagreement) & np.isfinite(points).all(axis=1) & (points[:, 2] > 0)
    return RefinedPoints(points, np.linalg.inv(information), num_observations, is_consistent)


def compute_session_statistics(
    refined: Float[np.ndarray, "n 3"],
    points_cam: Float[np.ndarray, "n 3"],
    covariances: Float[np.ndarray, "n 3 3"],
    observations: list[Observations],
    kept: Int[np.ndarray, " k"],
    node_session_id: int,
) -> list[LandmarkStatistics]:
    """Return each session's contribution to the `refined` positions. Rows count within the points
    `kept`. The first measurement (`points_cam`, `covariances`) belongs to the session
    `node_session_id`, whose image saw every point."""
    prior, statistics = np.linalg.inv(covariances), []
    for session_id in sorted({node_session_id, *(seen.session_id for seen in observations)}):
        is_own = session_id == node_session_id
        of_session = [seen for seen in observations if seen.session_id == session_id]
        own_prior = prior if is_own else np.zeros_like(prior)
        information, pulls, _ = _normal_equations(refined, points_cam, own_prior, of_session)
        expected, num_seen = int(is_own) + _count_observations(len(refined), of_session)
        rows = np.flatnonzero(expected[kept] > 0)
        if len(rows):
            of_rows = (sums[kept[rows]] for sums in (information, pulls, expected, num_seen))
            statistics.append(LandmarkStatistics.from_equations(session_id, rows, *of_rows))
    return statistics


def count_session_observations(
    num_points: int, observations: list[Observations], session_id: int
) -> LandmarkStatistics | None:
    """Count how often a later session's images should have shown a node's points, and how often
    they did. Return None if no point was expected.

    The positions stay, so the information is 0 and only the counts take space in the file.
    """
    expected, num_seen = _count_observations(num_points, observations)
    return LandmarkStatistics.of_counts(session_id, expected, num_seen) if expected.any() else None


def _count_observations(
    num_points: int, observations: list[Observations]
) -> Int[np.ndarray, "2 n"]:
    """Return how often each point should have been seen, and how often it was."""
    counts = np.zeros((2, num_points), np.int64)
    for seen in observations:
        counts[0, np.union1d(seen.in_view, seen.rows)] += 1
        counts[1, seen.rows] += 1
    return counts


def _normal_equations(
    points: Float[np.ndarray, "n 3"],
    first: Float[np.ndarray, "n 3"],
    prior: Float[np.ndarray, "n 3 3"],
    observations: list[Observations],
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Return the information, the gradient and the sum of squared residuals (in standard
    deviations) of each point."""
    offset = points - first
    information, gradient = prior.copy(), np.einsum("nij,nj->ni", prior, offset)
    squares = np.einsum("ni,ni->n", gradient, offset)
    for seen in observations:
        pose = seen.cam_from_node.rotation, seen.cam_from_node.translation
        seen_at = seen.rows, seen.normalized, seen.sigmas
        _add_observations(points, *seen_at, *pose, information, gradient, squares)
    return information, gradient, squares


@kernel(error_model="numpy")
def _add_observations(
    points, rows, normalized, sigmas, rotation, translation, information, gradient, squares
):
    """Add observations of one image to `information`, `gradient` and `squares`, which have one row
    per point.

    Point `rows[m]` is observed at `normalized[m]` (plane z = 1) with standard deviation
    `sigmas[m]`. The pose of the camera is `rotation` and `translation`. A point behind the camera
    adds only to its squared residual.
    """
    jacobian = np.empty((2, 3))
    residual = np.empty(2)
    for m in range(len(rows)):
        n, sigma = rows[m], sigmas[m]
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
        if not depth > 1e-3:
            squares[n] += 1e6
            continue
        square = 0.0
        for k in range(2):
            projected = (
                rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z + translation[k]
            ) / depth
            residual[k] = projected - normalized[m, k]
            square += (residual[k] / sigma) ** 2
            for i in range(3):
                jacobian[k, i] = rotation[k, i] / depth - projected / depth * rotation[2, i]
        squares[n] += square
        weight = 1.0 / (1.0 + square / _CAUCHY_SCALE**2) / sigma**2
        for i in range(3):
            a, b = weight * jacobian[0, i], weight * jacobian[1, i]
            gradient[n, i] += a * residual[0] + b * residual[1]
            for j in range(3):
                information[n, i, j] += a * jacobian[0, j] + b * jacobian[1, j]


def _project(
    points_node: Float[np.ndarray, "m 3"],
    normalized: Float[np.ndarray, "m 2"],
    cam_from_node: Rigid3,
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2 3"], Bool[np.ndarray, " m"]]:
    """Return residuals on the plane z = 1, their derivatives by the points, and which points are in
    front of the camera."""
    points = cam_from_node.apply(points_node)
    in_front = points[:, 2] > 1e-3
    z = np.where(in_front, points[:, 2], 1.0)
    projected, by_cam = points[:, :2] / z[:, None], np.zeros((len(points), 2, 3))
    by_cam[:, 0, 0] = by_cam[:, 1, 1] = 1.0 / z
    by_cam[:, :, 2] = -projected / z[:, None]
    return projected - normalized, by_cam @ cam_from_node.rotation, in_front
