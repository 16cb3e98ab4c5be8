"""Check a camera's calibration in one image: estimate pose, focal length and principal point
together from pixels of map points.

A pose found with a wrong focal length or principal point absorbs part of the error, but the
residuals stay systematic. So Gauss-Newton starts from this pose and estimates three more unknowns
on the plane z = 1. Observations are `scale` times the projection plus `offset`. `scale` is the
focal length relative to the calibrated one. `offset` is the shift of the principal point in
calibrated focal lengths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from topoloc.geometry.calibration_check_kernels import calibration_equations
from topoloc.geometry.calibration_mismatch import IntrinsicsDeviation
from topoloc.geometry.camera import MODELS, Camera
from topoloc.geometry.rigid import Rigid3

_NUM_ITERATIONS = 3
_MAX_POINTS = 256  # evenly chosen among all: their noise is the smallest error
_CAUCHY_SCALE = 2.3849
# Standard deviation of the prior. Without it, a frontal view of a wall does not separate the focal
# length from the distance.
_PRIOR_SIGMA = 0.3
_MIN_POINTS = 20


@dataclass(frozen=True, eq=False)
class ImageCalibration:
    """Hold the calibration estimated from one image.

    Args:
        scale: focal length relative to the calibrated one.
        offset: principal point relative to the calibrated one, in focal lengths (x, y).
        covariance: covariance of the logarithm of the scale and of the offset.
        cam_from_world: pose estimated together with them.
    """

    scale: float
    offset: Float[np.ndarray, " 2"]
    covariance: Float[np.ndarray, "3 3"]
    cam_from_world: Rigid3


def estimate_image_calibration(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    point_covariances: Float[np.ndarray, "n 3 3"],
    camera: Camera,
    cam_from_world: Rigid3,
    sigma_px: float,
) -> ImageCalibration | None:
    """Estimate the calibration from n pixels of points (metres), starting from a pose found with
    the given calibration. Return None if there are fewer than 20 points or the estimate fails."""
    if len(points_img) < _MIN_POINTS:
        return None
    rows = np.unique(np.linspace(0, len(points_img) - 1, _MAX_POINTS).astype(int))
    points_img, points_world, point_covariances = (
        points_img[rows],
        points_world[rows],
        point_covariances[rows],
    )
    observed = camera.normalized_from_img(points_img)
    pose, free = cam_from_world, np.zeros(3)  # logarithm of the scale, offset
    information, squares = np.eye(9), np.zeros(len(rows))
    for _ in range(_NUM_ITERATIONS):
        rotation, translation = (
            np.ascontiguousarray(pose.rotation),
            np.ascontiguousarray(pose.translation),
        )
        point_args = (
            observed,
            points_world,
            point_covariances,
            sigma_px / camera.fx,
            _CAUCHY_SCALE,
        )
        information, gradient, squares = calibration_equations(
            rotation, translation, free, *point_args
        )
        information[6:, 6:] += np.eye(3) / _PRIOR_SIGMA**2
        gradient[6:] += free / _PRIOR_SIGMA**2
        try:
            step = -np.linalg.solve(information, gradient)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all() or abs(step[6]) > 1.0:
            return None
        pose, free = Rigid3.exp(step[:6]) @ pose, free + step[6:]
    noise = max(
        float(np.median(squares)) / (2.0 * math.log(2.0)), 0.05
    )  # a chi-square of two has its median at 2 ln 2
    covariance = np.linalg.inv(information)[6:, 6:] * noise
    return ImageCalibration(math.exp(free[0]), free[1:], covariance, pose)


def corrected_camera(camera: Camera, found: ImageCalibration) -> Camera:
    """Return the camera with the estimated focal length and principal point. Its distortion is
    unchanged."""
    focal = np.array([camera.fx, camera.fy])
    (fx, fy), (cx, cy) = (
        found.scale * focal,
        np.array([camera.cx, camera.cy]) + focal * found.offset,
    )
    moved = {"f": fx, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return replace(
        camera,
        params=tuple(
            float(moved.get(name, value))
            for name, value in zip(MODELS[camera.model], camera.params, strict=True)
        ),
    )


def compute_intrinsics_deviation(
    calibrated: Camera, camera: Camera, found: ImageCalibration, place: int
) -> IntrinsicsDeviation:
    """Return the deviation of the estimate, found with `camera`, from the image's original
    calibration. Both cameras must have one image size."""
    estimated = corrected_camera(camera, found)
    principal_point_shift = (
        np.array([estimated.cx - calibrated.cx, estimated.cy - calibrated.cy]) / calibrated.fx
    )
    return IntrinsicsDeviation(
        np.array([math.log(estimated.fx / calibrated.fx), *principal_point_shift]),
        found.covariance,
        place,
    )
