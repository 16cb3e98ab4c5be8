"""Estimate pose and focal length together, for uncalibrated cameras.

RANSAC runs with a few focal lengths in steps of 1.25. Each run is no longer than needed to beat the
best one so far. At an inlier threshold of several pixels, the nearest focal length is near enough
to find the inliers. From the best results, Gauss-Newton refines the pose and the logarithm of the
focal length together. The uncertainty of the focal length and of the principal point, assumed in
the image centre, is added to the pose's covariance.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from topoloc.geometry.absolute_pose import (
    AbsolutePose,
    AbsolutePoseConfig,
    estimate_absolute_pose,
    estimate_pose_ransac,
    select_inliers,
)
from topoloc.geometry.absolute_pose_kernels import normal_equations, solve_cholesky
from topoloc.geometry.camera import Camera
from topoloc.geometry.pose_matches import CAUCHY_SCALE, Matches, is_non_collinear, refine_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera

_FiniteMatches = tuple[
    Float[np.ndarray, "n 2"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]
]
"""Pixels, world points (metres) and their covariances (m^2)."""

_FOCAL_STEP = 1.25
_MIN_INLIERS = 4  # the three matches of a sample always agree
# RANSAC iterations for each focal length. If one match in four is right, all samples are wrong once
# in a hundred times. The neighbouring focal lengths find most of the inliers too, with samples of
# their own.
_MAX_ITERATIONS = 300
# The best start is not always next to the right focal length if few matches are right. A third
# start does not help.
_MAX_STARTS = 2
# A wrong focal length has few inliers, and more are added over some rounds, mostly five. Some
# images need more rounds and would be wrong by metres without them.
_MAX_ROUNDS = 20
# Standard deviation of the principal point from the image centre, as a fraction of the longer
# side. Its shift is nearly equivalent to a rotation.
_PRINCIPAL_POINT_SIGMA = 0.01
# Weak prior on the logarithm of the focal length (standard deviation). Without it, points of a
# single wall do not fix the focal length.
_LOG_FOCAL_SIGMA = 0.7


def estimate_pose_and_focal(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    uncalibrated: UncalibratedCamera,
    config: AbsolutePoseConfig,
    *,
    point_covariances: Float[np.ndarray, "n 3 3"],
    start: tuple[Rigid3, Camera] | None = None,
) -> tuple[AbsolutePose, Camera] | None:
    """Return cam_from_world and the camera, from n matches of pixels with world points (metres).
    Return None if no pose is found.

    Args:
        start: an approximate pose and camera. They are refined, and no others are searched.

    The focal length lies in the range of `uncalibrated`. The covariance of the pose includes the
    uncertainty of the focal length.
    """
    usable = (
        np.isfinite(points_img).all(axis=1)
        & np.isfinite(points_world).all(axis=1)
        & np.isfinite(point_covariances).all(axis=(1, 2))
    )
    finite = points_img[usable], points_world[usable], point_covariances[usable]
    starts = [start] if start else _search_focal_lengths(finite, uncalibrated, config)
    refined = [_refine_pose_and_focal(each, finite, uncalibrated, config) for each in starts]
    best = max(filter(None, refined), key=lambda one: one[0], default=None)
    if best is None:
        return None
    _, cam_from_world, camera = best
    pose = estimate_absolute_pose(
        points_img,
        points_world,
        camera,
        config,
        point_covariances=point_covariances,
        start=cam_from_world,
    )
    if pose is None:
        return None
    matches = Matches.from_pixels(*finite, camera, config.key_point_sigma_px)
    information, _ = _normal_equations(
        pose.cam_from_world, matches, pose.inliers[usable], camera, uncalibrated
    )
    of_focal = _add_focal_uncertainty(pose.covariance, information)
    of_centre = _principal_point_covariance(points_world[pose.inliers], pose, camera)
    return replace(pose, covariance=of_focal + of_centre), camera


def _search_focal_lengths(
    finite: _FiniteMatches, uncalibrated: UncalibratedCamera, config: AbsolutePoseConfig
) -> list[tuple[Rigid3, Camera]]:
    """Return the poses and focal lengths with the smallest errors. Focal lengths in the middle are
    tried first, because a right one shortens the remaining runs."""
    points_img, points_world, _ = finite
    if len(points_img) < _MIN_INLIERS:
        return []
    ratio = uncalibrated.max_focal / uncalibrated.min_focal
    num_steps = max(1, math.ceil(math.log(ratio) / math.log(_FOCAL_STEP)))
    exponents = sorted((np.arange(num_steps) + 0.5) / num_steps, key=lambda one: abs(one - 0.5))
    found: list[tuple[float, Rigid3, Camera]] = []
    most = _MIN_INLIERS - 1
    for k, exponent in enumerate(exponents):
        camera = uncalibrated.with_focal(uncalibrated.min_focal * ratio ** float(exponent))
        # After this many samples of three, one contains only right matches with a confidence of
        # 99.9 %.
        share = min(most / len(points_img), 0.99)
        enough = max(1, math.ceil(math.log(1.0 - 0.999) / math.log1p(-(share**3))))
        iterations = min(config.max_iterations, _MAX_ITERATIONS, enough)
        quick = replace(config, max_iterations=iterations, seed=config.seed + k)
        cam_from_world, num_inliers, loss = estimate_pose_ransac(
            points_img, points_world, camera, quick
        ) or (None, 0, math.inf)
        if cam_from_world is not None and num_inliers >= _MIN_INLIERS:
            found.append((loss, cam_from_world, camera))
            most = max(most, num_inliers)
    # Distant and flat scenes give similar inlier counts at all focal lengths, but not errors.
    found.sort(key=lambda one: one[0])
    return [(cam_from_world, camera) for _, cam_from_world, camera in found[:_MAX_STARTS]]


def _refine_pose_and_focal(
    start: tuple[Rigid3, Camera],
    finite: _FiniteMatches,
    uncalibrated: UncalibratedCamera,
    config: AbsolutePoseConfig,
) -> tuple[int, Rigid3, Camera] | None:
    """Return the number of inliers, and the pose and camera that fit them best. Each round selects
    the inliers again."""
    cam_from_world, camera = start
    num_inliers = 0
    for _ in range(_MAX_ROUNDS):
        matches = Matches.from_pixels(*finite, camera, config.key_point_sigma_px)
        inliers = select_inliers(cam_from_world, matches, camera, config)
        num_inliers = int(np.count_nonzero(inliers))
        if not is_non_collinear(matches.points_world[inliers]):
            return None
        cam_from_world = refine_pose(cam_from_world, matches, inliers)
        information, gradient = _normal_equations(
            cam_from_world, matches, inliers, camera, uncalibrated
        )
        is_definite, step = solve_cholesky(information, -gradient)
        if not is_definite:
            return None
        focal = camera.fx * math.exp(np.clip(step[6], -0.2, 0.2))
        focal = float(np.clip(focal, uncalibrated.min_focal, uncalibrated.max_focal))
        if abs(math.log(focal / camera.fx)) < 1e-4:
            break
        camera = uncalibrated.with_focal(focal)
        cam_from_world = Rigid3.exp(step[:6]) @ cam_from_world
    return num_inliers, cam_from_world, camera


def _normal_equations(
    cam_from_world: Rigid3,
    matches: Matches,
    active: Bool[np.ndarray, " n"],
    camera: Camera,
    uncalibrated: UncalibratedCamera,
) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, " 7"]]:
    """Return Gauss-Newton's information and gradient for the left perturbation of the pose and the
    logarithm of the focal length. They include the prior on the focal length."""
    information, gradient, *_ = normal_equations(
        *matches.kernel_args(cam_from_world), active, CAUCHY_SCALE, 7
    )
    middle = math.sqrt(uncalibrated.min_focal * uncalibrated.max_focal)
    information[6, 6] += 1.0 / _LOG_FOCAL_SIGMA**2
    gradient[6] += math.log(camera.fx / middle) / _LOG_FOCAL_SIGMA**2
    return information, gradient


def _add_focal_uncertainty(
    covariance: Float[np.ndarray, "6 6"], information: Float[np.ndarray, "7 7"]
) -> Float[np.ndarray, "6 6"]:
    """Return the pose's covariance, increased from that at a fixed focal length by the uncertainty
    of the focal length."""
    by_focal = -np.linalg.solve(information[:6, :6], information[:6, 6])
    scale = float(np.trace(covariance @ information[:6, :6])) / 6.0
    variance = scale / max(information[6, 6] + float(information[:6, 6] @ by_focal), 1e-12)
    return covariance + variance * np.outer(by_focal, by_focal)


def _principal_point_covariance(
    points_world: Float[np.ndarray, "n 3"], pose: AbsolutePose, camera: Camera
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance that an uncertain principal point adds to the pose. A shift of all
    pixels moves the pose."""
    x, y, z = pose.cam_from_world.apply(points_world).T
    u, v, w = x / z, y / z, 1.0 / z
    zero = np.zeros_like(u)
    by_x = np.column_stack([w, zero, -u * w, -u * v, 1.0 + u * u, -v])
    by_y = np.column_stack([zero, w, -v * w, -(1.0 + v * v), u * v, u])
    jacobian, shifts = np.concatenate([by_x, by_y]), np.zeros((2 * len(u), 2))
    shifts[: len(u), 0] = shifts[len(u) :, 1] = 1.0 / camera.fx
    by_centre = np.linalg.lstsq(jacobian, shifts, rcond=None)[0]
    return (
        (_PRINCIPAL_POINT_SIGMA * max(camera.width, camera.height)) ** 2 * by_centre @ by_centre.T
    )
