"""Check a camera's calibration in one image and in many: estimate pose, focal length and principal
point together from pixels of map points.

A pose found with a wrong focal length or principal point absorbs part of the error, but the
residuals stay systematic. So Gauss-Newton starts from this pose and estimates three more unknowns
on the plane z = 1. Observations are `scale` times the projection plus `offset`. `scale` is the
focal length relative to the calibrated one. `offset` is the shift of the principal point in
calibrated focal lengths.

Many images together are more precise than one. Each image is weighted by its information. Images
that disagree by more than their noise get smaller weights (Cauchy). Their scatter beyond the noise
is added to each variance (random effects: DerSimonian and Laird, *Controlled Clinical Trials* 7,
1986). Images of one place share the errors of its points, so the covariance is scaled to the number
of places.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.compiled import kernel
from topoloc.geometry.calibration_mismatch import IntrinsicsDeviation
from topoloc.geometry.camera import MODELS, Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import encode_json


@kernel()
def calibration_equations(
    rotation, translation, free, observed, points_world, point_covariances, sigma, cauchy_scale
):
    """Return Gauss-Newton's normal equations for the pose's left perturbation (translation,
    rotation) and for `free`: the logarithm of the scale, and the offset.

    `observed` (n, 2) are coordinates on the plane z = 1, with standard deviation `sigma`. Each
    point has Cauchy's weight 1 / (1 + s / c^2) of its squared Mahalanobis length s. Returns the
    information (9, 9), the gradient (9) and the squared lengths (n).
    """
    information, gradient, squares = np.zeros((9, 9)), np.zeros(9), np.empty(len(observed))
    jacobian, by_world, spread = np.zeros((2, 9)), np.zeros((2, 3)), np.zeros((2, 2))
    scale = np.exp(free[0])
    for i in range(len(observed)):
        p = points_world[i]
        x = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + translation[0]
        y = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + translation[1]
        z = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + translation[2]
        u, v, w = x / z, y / z, 1.0 / z
        jacobian[0, 0], jacobian[0, 2] = scale * w, -scale * u * w
        jacobian[1, 1], jacobian[1, 2] = scale * w, -scale * v * w
        jacobian[0, 3] = -scale * u * v
        jacobian[0, 4] = scale * (1.0 + u * u)
        jacobian[0, 5] = -scale * v
        jacobian[1, 3] = -scale * (1.0 + v * v)
        jacobian[1, 4] = scale * u * v
        jacobian[1, 5] = scale * u
        jacobian[0, 6], jacobian[0, 7] = scale * u, 1.0
        jacobian[1, 6], jacobian[1, 8] = scale * v, 1.0
        for a in range(2):
            for k in range(3):
                by_world[a, k] = (
                    jacobian[a, 0] * rotation[0, k]
                    + jacobian[a, 1] * rotation[1, k]
                    + jacobian[a, 2] * rotation[2, k]
                )
        for a in range(2):
            for b in range(2):
                spread[a, b] = sigma**2 if a == b else 0.0
                for j in range(3):
                    for k in range(3):
                        spread[a, b] += by_world[a, j] * point_covariances[i, j, k] * by_world[b, k]
        determinant = spread[0, 0] * spread[1, 1] - spread[0, 1] * spread[1, 0]
        i00 = spread[1, 1] / determinant
        i01 = -spread[0, 1] / determinant
        i11 = spread[0, 0] / determinant
        e0, e1 = scale * u + free[1] - observed[i, 0], scale * v + free[2] - observed[i, 1]
        squares[i] = e0 * e0 * i00 + 2.0 * e0 * e1 * i01 + e1 * e1 * i11
        weight = 1.0 / (1.0 + squares[i] / cauchy_scale**2)
        for a in range(9):
            p0 = weight * (jacobian[0, a] * i00 + jacobian[1, a] * i01)
            p1 = weight * (jacobian[0, a] * i01 + jacobian[1, a] * i11)
            gradient[a] += p0 * e0 + p1 * e1
            for b in range(9):
                information[a, b] += p0 * jacobian[0, b] + p1 * jacobian[1, b]
    return information, gradient, squares


_NUM_ITERATIONS = 3
_MAX_POINTS = 256  # evenly chosen among all: their noise is the smallest error
_CAUCHY_SCALE = 2.3849
# Standard deviation of the prior. Without it, a frontal view of a wall does not separate the focal
# length from the distance.
_PRIOR_SIGMA = 0.3
_MIN_POINTS = 20
MIN_IMAGES, MIN_PLACES = 5, 4  # images of one place share their errors, however many there are
_NUM_SIGMAS, _MIN_RELATIVE_DEVIATION = 3.0, 0.02  # of the focal length, or of the image's width
_NUM_MEAN_ITERATIONS = 10
_MAD_TO_SIGMA = 1.4826


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
    observed = camera.normalized_from_img(points_img[rows])
    of_points = points_world[rows], point_covariances[rows], sigma_px / camera.fx, _CAUCHY_SCALE
    pose, free = cam_from_world, np.zeros(3)  # logarithm of the scale, offset
    information, squares = np.eye(9), np.zeros(len(rows))
    for _ in range(_NUM_ITERATIONS):
        rotation, translation = map(np.ascontiguousarray, (pose.rotation, pose.translation))
        information, gradient, squares = calibration_equations(
            rotation, translation, free, observed, *of_points
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
    # A chi-square of two has its median at 2 ln 2.
    noise = max(float(np.median(squares)) / (2.0 * math.log(2.0)), 0.05)
    covariance = np.linalg.inv(information)[6:, 6:] * noise
    return ImageCalibration(math.exp(free[0]), free[1:], covariance, pose)


def corrected_camera(camera: Camera, found: ImageCalibration) -> Camera:
    """Return the camera with the estimated focal length and principal point. Its distortion is
    unchanged."""
    fx, fy = found.scale * camera.fx, found.scale * camera.fy
    cx, cy = camera.cx + camera.fx * found.offset[0], camera.cy + camera.fy * found.offset[1]
    moved = {"f": fx, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    named = zip(MODELS[camera.model], camera.params, strict=True)
    return replace(camera, params=tuple(float(moved.get(name, value)) for name, value in named))


def compute_intrinsics_deviation(
    calibrated: Camera, camera: Camera, found: ImageCalibration, place: int
) -> IntrinsicsDeviation:
    """Return the deviation of the estimate, found with `camera`, from the image's original
    calibration. Both cameras must have one image size."""
    estimated = corrected_camera(camera, found)
    x = (estimated.cx - calibrated.cx) / calibrated.fx
    y = (estimated.cy - calibrated.cy) / calibrated.fx
    deviation = np.array([math.log(estimated.fx / calibrated.fx), x, y])
    return IntrinsicsDeviation(deviation, found.covariance, place)


@dataclass(frozen=True, eq=False)
class CalibrationConsistency:
    """Hold the intrinsics estimated from many images, in pixels of the original images. Each sigma
    is the standard deviation of the field before it. `num_images` is the number of images used."""

    num_images: int
    focal_length_px: float
    focal_sigma_px: float
    calibrated_focal_length_px: float
    principal_point_px: Float[np.ndarray, " 2"]
    principal_point_sigma_px: Float[np.ndarray, " 2"]
    calibrated_principal_point_px: Float[np.ndarray, " 2"]
    has_focal_mismatch: bool
    has_principal_point_mismatch: bool
    has_distortion_mismatch: bool = False

    @property
    def is_contradicted(self) -> bool:
        """Return whether the images contradict the calibration."""
        is_moved = self.has_focal_mismatch or self.has_principal_point_mismatch
        return is_moved or self.has_distortion_mismatch

    def __str__(self) -> str:
        (x, y), (x_sigma, y_sigma) = self.principal_point_px, self.principal_point_sigma_px
        cx, cy = self.calibrated_principal_point_px
        focal = (
            f"f = {self.focal_length_px:.1f} +- {self.focal_sigma_px:.1f} px, the calibration"
            f" {self.calibrated_focal_length_px:.1f}"
        )
        centre = (
            f"the principal point at ({x:.1f} +- {x_sigma:.1f}, {y:.1f} +- {y_sigma:.1f}), the"
            f" calibration ({cx:.1f}, {cy:.1f})"
        )
        lens = "that their lens distorts more than the calibration states"
        parts = [focal] * self.has_focal_mismatch + [centre] * self.has_principal_point_mismatch
        parts += [lens] * self.has_distortion_mismatch
        found = f"say {'; '.join(parts)}" if parts else f"agree with it: {focal}"
        return f"the pictures {found} ({self.num_images} pictures)"

    def to_json(self) -> dict[str, Any]:
        """Return the result as JSON, with a text for the user as `detail`."""
        values = encode_json(self)
        return {
            "num_pictures": values.pop("num_images"),
            **{name: value for name, value in values.items() if not name.startswith("has_")},
            "contradicted": self.is_contradicted,
            "detail": str(self),
        }


def check_calibration_consistency(
    observations: Sequence[IntrinsicsDeviation], calibrated: Camera
) -> CalibrationConsistency | None:
    """Return the intrinsics estimated from images of one camera. Return None if there are fewer
    than five images or fewer than four places."""
    if len(observations) < MIN_IMAGES or len({image.place for image in observations}) < MIN_PLACES:
        return None
    deviation, covariance = _robust_mean(observations)
    sigmas = np.sqrt(np.diag(covariance))
    shares = np.abs(deviation) * np.array([1.0, *np.repeat(calibrated.fx / calibrated.width, 2)])
    is_off = (np.abs(deviation) > _NUM_SIGMAS * sigmas) & (shares > _MIN_RELATIVE_DEVIATION)
    min_distorted_share = 0.3  # of 202 images through their own lens none showed another
    distorted_share = np.mean([image.is_distorted for image in observations])
    focal = calibrated.fx * float(np.exp(deviation[0]))
    centre = np.array([calibrated.cx, calibrated.cy])
    return CalibrationConsistency(
        len(observations),
        focal,
        focal * float(sigmas[0]),
        calibrated.fx,
        centre + calibrated.fx * deviation[1:],
        calibrated.fx * sigmas[1:],
        centre,
        bool(is_off[0]),
        bool(is_off[1:].any()),
        bool(distorted_share > min_distorted_share),
    )


def _robust_mean(
    observations: Sequence[IntrinsicsDeviation],
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Return the robust mean of the deviations and its covariance."""
    deviations = np.stack([image.deviation for image in observations])
    covariances = np.stack([image.covariance for image in observations])
    variances = np.einsum("nii->ni", covariances)
    mean = np.median(deviations, axis=0)
    information = np.eye(3)
    for _ in range(_NUM_MEAN_ITERATIONS):
        residuals = deviations - mean
        spread = (_MAD_TO_SIGMA * np.median(np.abs(residuals), axis=0)) ** 2
        excess = np.maximum(spread - np.median(variances, axis=0), 0.0)
        inverse = np.linalg.inv(covariances + np.diag(excess))
        squares = np.einsum("ni,nij,nj->n", residuals, inverse, residuals)
        inverse /= (1.0 + squares / _CAUCHY_SCALE**2)[:, None, None]
        information = inverse.sum(axis=0)
        mean = np.linalg.solve(information, np.einsum("nij,nj->i", inverse, deviations))
    num_places = len({image.place for image in observations})
    return mean, np.linalg.inv(information) * len(observations) / num_places
