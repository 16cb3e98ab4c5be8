"""Estimate pose and focal length together, for uncalibrated cameras.

RANSAC runs with a few focal lengths in steps of 1.25. Each run is no longer than needed to beat the
best one so far. At an inlier threshold of several pixels, the nearest focal length is near enough
to find the inliers. From the best results, Gauss-Newton refines the pose and the logarithm of the
focal length together. Principal point and distortion are estimated only if the residuals ask for
it (`joint_camera/joint_fit.py`). The uncertainty of the camera is added to the pose's covariance.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from topoloc.geometry.absolute_pose import (
    MAX_THRESHOLD_SCALE,
    AbsolutePose,
    AbsolutePoseConfig,
    estimate_absolute_pose,
)
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.joint_camera.camera_hypotheses import (
    CameraBelief,
    CameraHypothesis,
    CameraPrior,
    Vector,
    unchanged_camera,
)
from topoloc.geometry.joint_camera.joint_fit import (
    CameraObservations,
    fit_camera,
    refit_camera,
    weigh_poses,
)
from topoloc.geometry.pose_matches import (
    CAUCHY_SCALE,
    PoseMatches,
    has_spread,
    normal_equations,
    run_gauss_newton,
    solve_cholesky,
    squared_errors,
)
from topoloc.geometry.pose_sampling import sample_absolute_pose
from topoloc.geometry.rigid import Rigid3

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
    correlated_error_share: float = 0.0,
) -> tuple[AbsolutePose, Camera] | None:
    """Return cam_from_world and the camera, from n matches of pixels with world points (metres).
    Return None if no pose is found.

    Args:
        start: an approximate pose and camera. They are refined, and no others are searched.
        correlated_error_share: rho of the map (`map_facts/correlated_errors.py`).

    The focal length lies in the range of `uncalibrated`. The covariance of the pose includes the
    uncertainty of the focal length.
    """
    usable = (
        np.isfinite(points_img).all(axis=1)
        & np.isfinite(points_world).all(axis=1)
        & np.isfinite(point_covariances).all(axis=(1, 2))
    )
    finite = points_img[usable], points_world[usable], point_covariances[usable]
    stated, usual = uncalibrated, uncalibrated.unknown(uncalibrated.width, uncalibrated.height)
    if start and not stated.min_focal < start[1].fx < stated.max_focal:
        stated = usual  # the residuals contradicted the stated range
    best = None
    for focals in (stated, usual):
        starts = [start] if start else _search_focal_lengths(finite, focals, config)
        refined = [_refine_pose_and_focal(each, finite, focals, config) for each in starts]
        best = min(filter(None, [best, *refined]), key=lambda fit: fit[0], default=None)
        # The stated focal length is that of the whole image. At a bound it is contradicted.
        is_inside = best is not None and stated.min_focal < best[2].fx < stated.max_focal
        if start or is_inside or stated == usual:
            break
    if best is None:
        return None
    _, cam_from_world, camera = best
    rho = correlated_error_share
    found = _choose_camera(cam_from_world, camera, finite, uncalibrated, config, rho)
    cam_from_world, camera, belief = found or (cam_from_world, camera, None)
    pose = estimate_absolute_pose(
        points_img,
        points_world,
        camera,
        config,
        point_covariances=point_covariances,
        start=cam_from_world,
    )
    if pose is None or belief is None:  # too few points to estimate a camera
        return pose and (pose, camera)
    return replace(pose, covariance=pose.covariance + belief.covariance, camera=belief), camera


def _choose_camera(
    cam_from_world: Rigid3,
    camera: Camera,
    finite: _FiniteMatches,
    uncalibrated: UncalibratedCamera,
    config: AbsolutePoseConfig,
    correlated_error_share: float,
) -> tuple[Rigid3, Camera, CameraBelief] | None:
    """Return the pose and the camera of the likeliest hypothesis, starting from those of a first
    fit. The first fit itself is returned if its hypothesis is the likeliest."""
    first = uncalibrated.with_focal(camera.fx)
    seen = CameraObservations.from_pixels(
        *finite,
        first,
        config.key_point_sigma_px,
        max_error_px=MAX_THRESHOLD_SCALE * config.max_reprojection_error_px,
        correlated_error_share=correlated_error_share,
    )
    prior = camera_prior(uncalibrated, camera.fx)
    fit = fit_camera(seen, cam_from_world, parameters_of(camera, first), prior)
    if fit is None:
        return None
    weighed = prior.weigh(fit.likelihood)
    allowed = [hypothesis for hypothesis in weighed if hypothesis.lens != "other"]
    chosen = max(allowed, key=lambda hypothesis: weighed[hypothesis][0])
    if max(weighed, key=lambda hypothesis: weighed[hypothesis][0]).lens == "other":
        chosen = CameraHypothesis()
    refit = refit_camera(seen, fit, prior, chosen)
    if refit is None:
        return None
    belief = weigh_poses(fit, weighed, (chosen, refit.camera))
    return refit.cam_from_world, with_parameters(first, refit.camera), belief


def camera_prior(uncalibrated: UncalibratedCamera, focal: float) -> CameraPrior:
    """Return the prior of a camera relative to one with this focal length."""
    usual = UncalibratedCamera.unknown(uncalibrated.width, uncalibrated.height)
    low, high = (
        math.log(bound / focal) for bound in (uncalibrated.min_focal, uncalibrated.max_focal)
    )
    widest = math.log(math.sqrt(usual.min_focal * usual.max_focal) / focal), _LOG_FOCAL_SIGMA
    is_narrow = high - low < 0.999 * math.log(usual.max_focal / usual.min_focal)
    stated = ((low + high) / 2.0, (high - low) / 4.0) if is_narrow else widest
    sides = uncalibrated.width / focal, uncalibrated.height / focal
    return CameraPrior.of_unknown(sides, stated, widest)


def parameters_of(camera: Camera, reference: Camera) -> Vector:
    """Return the parameters of a camera relative to a pinhole."""
    parameters = unchanged_camera()
    parameters[0] = math.log(camera.fx / reference.fx)
    parameters[1] = (camera.cx - reference.cx) / reference.fx
    parameters[2] = (camera.cy - reference.cy) / reference.fx
    parameters[3:7], parameters[7] = camera.distortion()[:2]
    return parameters


def with_parameters(camera: Camera, parameters: Vector) -> Camera:
    """Return the camera that the parameters describe relative to a pinhole."""
    focal = camera.fx * math.exp(parameters[0])
    cx, cy = camera.cx + camera.fx * parameters[1], camera.cy + camera.fx * parameters[2]
    if parameters[3] == 0.0:
        return replace(camera, model="PINHOLE", params=(focal, focal, cx, cy))
    values = tuple(float(value) for value in (focal, cx, cy, parameters[3], parameters[7]))
    return replace(camera, model="RADIAL", params=values)


def _search_focal_lengths(
    finite: _FiniteMatches, uncalibrated: UncalibratedCamera, config: AbsolutePoseConfig
) -> list[tuple[Rigid3, Camera]]:
    """Return the poses and focal lengths with the smallest errors. Focal lengths in the middle are
    tried first, because a right one shortens the remaining runs."""
    points_img, points_world, _ = finite
    found: list[tuple[float, Rigid3, Camera]] = []
    most = _MIN_INLIERS - 1
    ratio = uncalibrated.max_focal / uncalibrated.min_focal
    num_steps = max(1, math.ceil(math.log(ratio) / math.log(_FOCAL_STEP)))
    exponents = sorted(
        (np.arange(num_steps) + 0.5) / num_steps, key=lambda exponent: abs(exponent - 0.5)
    )
    for k, exponent in enumerate(exponents if len(points_img) >= _MIN_INLIERS else ()):
        camera = uncalibrated.with_focal(uncalibrated.min_focal * ratio ** float(exponent))
        # After this many samples of three, one contains only right matches with a confidence of
        # 99.9 %.
        share = min(most / len(points_img), 0.99)
        enough = max(1, math.ceil(math.log(1.0 - 0.999) / math.log1p(-(share**3))))
        iterations = min(config.max_iterations, _MAX_ITERATIONS, enough)
        quick = replace(config, max_iterations=iterations, seed=config.seed + k)
        cam_from_world, num_inliers, loss = sample_absolute_pose(
            points_img, points_world, camera, quick.sampling()
        ) or (None, 0, math.inf)
        if cam_from_world is not None and num_inliers >= _MIN_INLIERS:
            found.append((loss, cam_from_world, camera))
            most = max(most, num_inliers)
    # Distant and flat scenes give similar inlier counts at all focal lengths, but not errors.
    found.sort(key=lambda pose: pose[0])
    return [(cam_from_world, camera) for _, cam_from_world, camera in found[:_MAX_STARTS]]


def _refine_pose_and_focal(
    start: tuple[Rigid3, Camera],
    finite: _FiniteMatches,
    uncalibrated: UncalibratedCamera,
    config: AbsolutePoseConfig,
) -> tuple[float, Rigid3, Camera] | None:
    """Return the robust loss of all matches, and the pose and camera that fit the inliers best.
    Each round selects the inliers again."""
    cam_from_world, camera = start
    middle = math.sqrt(uncalibrated.min_focal * uncalibrated.max_focal)
    loss, worst = math.inf, (config.max_reprojection_error_px / config.key_point_sigma_px) ** 2
    for _ in range(_MAX_ROUNDS):
        matches = PoseMatches.from_pixels(*finite, camera, config.key_point_sigma_px)
        arguments = matches.kernel_args(cam_from_world)
        inliers = matches.select_inliers(arguments, *config.inlier_limits)
        squares = np.where(inliers, squared_errors(*arguments)[1], worst)
        loss = float(np.log1p(squares / CAUCHY_SCALE**2).sum())
        if not has_spread(matches.points_world, inliers):
            return None
        cam_from_world = Rigid3(*run_gauss_newton(*arguments, inliers, CAUCHY_SCALE, 10))
        arguments = matches.kernel_args(cam_from_world)
        information, gradient, *_ = normal_equations(*arguments, inliers, CAUCHY_SCALE, 7)
        information[6, 6] += 1.0 / _LOG_FOCAL_SIGMA**2
        gradient[6] += math.log(camera.fx / middle) / _LOG_FOCAL_SIGMA**2
        is_definite, step = solve_cholesky(information, -gradient)
        if not is_definite:
            return None
        focal = camera.fx * math.exp(np.clip(step[6], -0.2, 0.2))
        focal = float(np.clip(focal, uncalibrated.min_focal, uncalibrated.max_focal))
        if abs(math.log(focal / camera.fx)) < 1e-4:
            break
        camera = camera.with_focal(focal)
        cam_from_world = Rigid3.exp(step[:6]) @ cam_from_world
    return loss, cam_from_world, camera
