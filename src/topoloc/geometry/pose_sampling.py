"""Find poses of cameras among wrong matches by random samples (RANSAC).

PoseLib's LO-RANSAC does it (https://github.com/PoseLib/PoseLib): P3P for absolute poses (Persson
and Nordberg, 2018), five points for relative ones, PROSAC's order of the samples (Chum and Matas,
2005) if the matches are sorted. PoseLib has no package for Linux on ARM. There OpenCV's USAC does
the same with the same thresholds, seeds and numbers of samples (Raguram et al., *USAC: a universal
framework for random sample consensus*, 2013).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

try:
    import poselib
except ImportError:
    poselib = None

_SUCCESS = 0.999  # the probability that no better pose is left
_MIN_REFINED = 6  # points of a pose that is refined


@dataclass(frozen=True)
class Sampling:
    """Hold how samples are drawn: the inlier threshold (pixels), the least and the most samples,
    the seed, and whether the matches are sorted, most likely right first. USAC knows no least."""

    max_error_px: float
    min_iterations: int
    max_iterations: int
    seed: int
    is_sorted: bool = False


def sample_absolute_pose(
    undistorted: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    camera: Camera,
    sampling: Sampling,
) -> tuple[Rigid3, int, float] | None:
    """Return cam_from_world by n finite matches of undistorted pixels, the number of inliers, and
    the sum of squared errors (px^2), each limited to the squared threshold. Points count as exact.

    None: the samples give no pose.
    """
    if poselib is None:
        return _absolute_by_opencv(undistorted, points_world, camera, sampling)
    size = {"width": camera.width, "height": camera.height}
    pinhole = {"model": "PINHOLE", **size, "params": list(camera.intrinsics)}
    ransac = {
        "max_reproj_error": sampling.max_error_px,
        "max_iterations": sampling.max_iterations,
        "min_iterations": sampling.min_iterations,
        "success_prob": _SUCCESS,
        # PoseLib's default of 3 triples the time without more poses, thanks to local optimisation
        "dyn_num_trials_mult": 1.0,
        "progressive_sampling": sampling.is_sorted,
        "seed": sampling.seed,
    }
    no_bundle = {"max_iterations": 0}  # the refinement on the inliers replaces it
    pose, info = poselib.estimate_absolute_pose(
        undistorted, points_world, pinhole, ransac, no_bundle
    )
    matrix = np.asarray(pose.Rt, dtype=np.float64)
    if not np.isfinite(matrix).all():
        return None
    # PoseLib's score is on the plane z = 1.
    loss = float(info["model_score"]) * ((camera.fx + camera.fy) / 2) ** 2
    return Rigid3(matrix[:, :3].copy(), matrix[:, 3].copy()), int(info["num_inliers"]), loss


def sample_relative_pose(
    first: Float[np.ndarray, "n 2"],
    second: Float[np.ndarray, "n 2"],
    focal: float,
    max_error_px: float,
) -> tuple[Rigid3, Bool[np.ndarray, " n"]] | None:
    """Return second_from_first by n >= 5 finite points of two images, whose translation has some
    length, and the inliers. Points are on the planes z = 1, and `focal` turns their errors to
    pixels.

    None: the samples give no pose.
    """
    if poselib is None:
        return _relative_by_opencv(first, second, focal, max_error_px)
    pinhole = {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [focal, 0.0, 0.0]}
    ransac = {"max_epipolar_error": max_error_px, "seed": 0}
    pose, info = poselib.estimate_relative_pose(
        focal * first, focal * second, pinhole, pinhole, ransac, {}
    )
    matrix, inliers = np.asarray(pose.Rt, dtype=np.float64), np.asarray(info["inliers"], bool)
    if not np.isfinite(matrix).all() or not inliers.any():
        return None
    return Rigid3(matrix[:, :3].copy(), matrix[:, 3].copy()), inliers


def _usac(max_error_px: float, max_iterations: int, seed: int) -> cv2.UsacParams:
    params = cv2.UsacParams()
    params.threshold, params.confidence = max_error_px, _SUCCESS
    params.maxIterations, params.randomGeneratorState = max_iterations, seed
    params.sampler, params.score = cv2.SAMPLING_UNIFORM, cv2.SCORE_METHOD_MSAC
    return params


def _absolute_by_opencv(
    undistorted: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    camera: Camera,
    sampling: Sampling,
) -> tuple[Rigid3, int, float] | None:
    """Do the same by USAC. Its local optimisation takes five times the time and sees no points
    beyond the threshold, so the best sample is refined instead, under falling thresholds."""
    params = _usac(sampling.max_error_px, sampling.max_iterations, sampling.seed)
    params.loMethod, params.confidence = cv2.LOCAL_OPTIM_NULL, 1.0 - 1e-5
    if sampling.is_sorted:
        params.sampler = cv2.SAMPLING_PROSAC
    points_world, undistorted = map(np.ascontiguousarray, (points_world, undistorted))
    matrix, worst = camera.matrix(), sampling.max_error_px**2
    best: tuple[Rigid3, int, float] | None = None
    try:
        found, _, *pose, _ = cv2.solvePnPRansac(
            points_world, undistorted, matrix, None, params=params
        )
        for factor in (5.0, 2.0, 1.0, 0.0):
            if not found or not np.isfinite(pose).all():
                break
            cam_from_world = Rigid3(cv2.Rodrigues(pose[0])[0], pose[1][:, 0].copy())
            squares = _squared_errors(undistorted, points_world, camera, cam_from_world)
            loss = float(np.fmin(squares, worst).sum())
            if best is None or loss < best[2]:
                best = cam_from_world, int(np.count_nonzero(squares < worst)), loss
            near = squares < factor**2 * worst
            if np.count_nonzero(near) < _MIN_REFINED:
                break
            some = points_world[near], undistorted[near]
            pose = cv2.solvePnPRefineLM(*some, matrix, None, pose[0].copy(), pose[1].copy())
    except cv2.error:  # thrown for some degenerate samples
        return best
    return best


def _squared_errors(
    undistorted: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    camera: Camera,
    cam_from_world: Rigid3,
) -> Float[np.ndarray, " n"]:
    """Return squared reprojection errors (px^2), NaN behind the camera."""
    points_cam = cam_from_world.apply(points_world)
    depths = np.where(points_cam[:, 2] > 0.0, points_cam[:, 2], np.nan)
    pixels = points_cam[:, :2] / depths[:, None] * [camera.fx, camera.fy]
    return np.sum((pixels + np.array([camera.cx, camera.cy]) - undistorted) ** 2, axis=1)


def _relative_by_opencv(
    first: Float[np.ndarray, "n 2"],
    second: Float[np.ndarray, "n 2"],
    focal: float,
    max_error_px: float,
) -> tuple[Rigid3, Bool[np.ndarray, " n"]] | None:
    matrix, params = np.diag([focal, focal, 1.0]), _usac(max_error_px, 10_000, 0)
    params.loMethod, params.final_polisher = cv2.LOCAL_OPTIM_INNER_LO, cv2.COV_POLISHER
    points = np.ascontiguousarray(focal * first), np.ascontiguousarray(focal * second)
    no_distortion = np.zeros(4)
    try:
        essential, mask = cv2.findEssentialMat(
            points[0], points[1], matrix, matrix, no_distortion, no_distortion, params
        )
        if essential is None or essential.shape != (3, 3) or not mask.any():
            return None
        *rotations, direction = cv2.decomposeEssentialMat(essential)
    except cv2.error:  # thrown for some degenerate samples
        return None
    inliers = mask[:, 0] > 0
    firsts, seconds = (np.insert(one[inliers], 2, 1.0, axis=1) for one in (first, second))
    # the other one is turned by 180 degrees about the translation
    rotation = max(rotations, key=lambda one: float(np.sum(firsts @ one.T * seconds)))
    turned = firsts @ rotation.T
    normals = np.cross(turned, seconds)
    depths = -np.sum(np.cross(direction[:, 0], seconds) * normals, axis=1)  # but for their scale
    translation = direction[:, 0] if np.sum(np.sign(depths)) >= 0.0 else -direction[:, 0]
    return Rigid3(rotation, translation), inliers
