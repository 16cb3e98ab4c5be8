"""Pose and focal length together, for cameras that nobody has calibrated.

PnP is tried with a handful of focal lengths a quarter apart: at an inlier threshold of some pixels the nearest of them is near
enough to find the inliers. From the best one, Gauss-Newton refines the pose's six numbers and the logarithm of the focal length
together. What is not known of the focal length and of the principal point, which is taken to be in the middle, is added to the pose's
covariance.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.rough_camera import RoughCamera

_STEP = 1.25
_MAX_ITERATIONS = 500  # of RANSAC for each focal length: enough for one match in four to be right
_ROUNDS = 4
_CAUCHY_SCALE = 2.3849
# How far the principal point lies from the middle (standard deviation, of the longer side); it trades places with a rotation.
_CENTRE_SHARE = 0.01
# Weak prior on the logarithm of the focal length (standard deviation): without it, what is seen of a wall alone fixes none.
_PRIOR = 0.7


def estimate_pose_and_focal(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    rough: RoughCamera,
    config: AbsolutePoseConfig,
    *,
    point_covariances: Float[np.ndarray, "n 3 3"],
    start: tuple[Rigid3, Camera] | None = None,
) -> tuple[AbsolutePose, Camera] | None:
    """cam_from_world and the camera, from n matches of pixels with world points (metres); None where none follows from them.

    Args:
        start: a pose and a camera that are nearly right already: they are refined, and no others are sought.

    The focal length found lies in `rough`'s range. The covariance is that of the pose whatever the focal length.
    """
    best = start or _search(points_img, points_world, rough, config, point_covariances)
    if best is None:
        return None
    cam_from_world, camera = best
    pose = estimate_absolute_pose(points_img, points_world, camera, config, point_covariances=point_covariances, start=cam_from_world)
    for _ in range(_ROUNDS):
        if pose is None:
            return None
        pixels, points = points_img[pose.inliers], points_world[pose.inliers]
        information, gradient = _normal_equations(pixels, points, point_covariances[pose.inliers], pose, camera, rough, config)
        step = -np.linalg.solve(information, gradient)
        focal = float(np.clip(camera.fx * math.exp(np.clip(step[6], -0.2, 0.2)), rough.min_focal, rough.max_focal))
        has_converged = abs(math.log(focal / camera.fx)) < 1e-4
        camera = rough.with_focal(focal)
        moved = Rigid3.exp(step[:6]) @ pose.cam_from_world if not has_converged else pose.cam_from_world
        pose = estimate_absolute_pose(points_img, points_world, camera, config, point_covariances=point_covariances, start=moved)
        if has_converged:
            break
    if pose is None:
        return None
    inliers = pose.inliers
    information, _ = _normal_equations(points_img[inliers], points_world[inliers], point_covariances[inliers], pose, camera, rough, config)
    covariance = _whatever_the_focal(pose.covariance, information)
    return replace(pose, covariance=covariance + _whatever_the_centre(points_world[inliers], pose, camera)), camera


def _search(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    rough: RoughCamera,
    config: AbsolutePoseConfig,
    point_covariances: Float[np.ndarray, "n 3 3"],
) -> tuple[Rigid3, Camera] | None:
    """The pose with most inliers of a handful of focal lengths."""
    quick = replace(config, max_iterations=min(config.max_iterations, _MAX_ITERATIONS))
    num_steps = max(1, math.ceil(math.log(rough.max_focal / rough.min_focal) / math.log(_STEP)))
    exponents = (np.arange(num_steps) + 0.5) / num_steps
    best: tuple[Rigid3, Camera] | None = None
    most = 0
    for focal in rough.min_focal * (rough.max_focal / rough.min_focal) ** exponents:
        camera = rough.with_focal(float(focal))
        pose = estimate_absolute_pose(points_img, points_world, camera, quick, point_covariances=point_covariances)
        if pose is not None and np.count_nonzero(pose.inliers) > most:
            best, most = (pose.cam_from_world, camera), int(np.count_nonzero(pose.inliers))
    return best


def _normal_equations(
    pixels: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    point_covariances: Float[np.ndarray, "n 3 3"],
    pose: AbsolutePose,
    camera: Camera,
    rough: RoughCamera,
    config: AbsolutePoseConfig,
) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, " 7"]]:
    """Gauss-Newton's, by the left perturbation of the pose and the logarithm of the focal length, on the plane z = 1.

    As in `absolute_pose_kernels.normal_equations`. Noise is of pixels, so that it is the projection f (x / z) that moves with log f, by
    itself; were the observations taken to move, their noise would make the focal length too long.
    """
    rotation = pose.cam_from_world.rotation
    x, y, z = pose.cam_from_world.apply(points_world).T
    u, v, w = x / z, y / z, 1.0 / z
    zero = np.zeros_like(u)
    projected = np.column_stack([u, v])
    residuals = projected - camera.normalized_from_img(pixels)
    by_point = np.stack([np.column_stack([w, zero, -u * w]), np.column_stack([zero, w, -v * w])], axis=1)
    by_world = by_point @ rotation
    spread = by_world @ point_covariances @ by_world.transpose(0, 2, 1) + (config.key_point_sigma_px / camera.fx) ** 2 * np.eye(2)
    inverse = np.linalg.inv(spread)
    by_rotation = np.stack([np.column_stack([-u * v, 1.0 + u * u, -v]), np.column_stack([-(1.0 + v * v), u * v, u])], axis=1)
    jacobians = np.concatenate([by_point, by_rotation, projected[:, :, None]], axis=2)
    squares = np.einsum("ni,nij,nj->n", residuals, inverse, residuals)
    weighted = np.einsum("nia,nij->naj", jacobians, inverse) / (1.0 + squares / _CAUCHY_SCALE**2)[:, None, None]
    information = np.einsum("naj,njb->ab", weighted, jacobians)
    gradient = np.einsum("naj,nj->a", weighted, residuals)
    middle = math.sqrt(rough.min_focal * rough.max_focal)
    information[6, 6] += 1.0 / _PRIOR**2
    gradient[6] += math.log(camera.fx / middle) / _PRIOR**2
    return information, gradient


def _whatever_the_focal(covariance: Float[np.ndarray, "6 6"], information: Float[np.ndarray, "7 7"]) -> Float[np.ndarray, "6 6"]:
    """The pose's covariance at a fixed focal length, and what the focal length's own uncertainty adds to it."""
    by_focal = -np.linalg.solve(information[:6, :6], information[:6, 6])
    scale = float(np.trace(covariance @ information[:6, :6])) / 6.0
    variance = scale / max(information[6, 6] + float(information[:6, 6] @ by_focal), 1e-12)
    return covariance + variance * np.outer(by_focal, by_focal)


def _whatever_the_centre(points_world: Float[np.ndarray, "n 3"], pose: AbsolutePose, camera: Camera) -> Float[np.ndarray, "6 6"]:
    """What a principal point away from the middle adds to the pose's covariance: the pose moves so as to shift all pixels alike."""
    x, y, z = pose.cam_from_world.apply(points_world).T
    u, v, w = x / z, y / z, 1.0 / z
    zero = np.zeros_like(u)
    by_x = np.column_stack([w, zero, -u * w, -u * v, 1.0 + u * u, -v])
    by_y = np.column_stack([zero, w, -v * w, -(1.0 + v * v), u * v, u])
    jacobian = np.concatenate([by_x, by_y])
    shifts = np.zeros((2 * len(u), 2))
    shifts[: len(u), 0] = shifts[len(u) :, 1] = 1.0 / camera.fx
    by_centre = np.linalg.lstsq(jacobian, shifts, rcond=None)[0]
    return (_CENTRE_SHARE * max(camera.width, camera.height)) ** 2 * by_centre @ by_centre.T
