"""Does a picture fit its calibration? Pose, focal length and principal point together, from pixels
of known points.

The pose that was found with a wrong focal length or principal point has given way as far as it
could; what is left of the points' errors still leans one way. So from the pose found, Gauss-Newton
frees three more numbers, all on the plane z = 1: observations there are `scale` times the
projection, plus `offset`, where the focal length is `scale` times the calibrated one, and the
principal point `offset` focal lengths beside the calibrated one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.geometry.calibration_check_kernels import calibration_equations
from topoloc.geometry.camera import MODELS, Camera
from topoloc.geometry.rigid import Rigid3

_NUM_ITERATIONS = 3
_MAX_POINTS = 256  # evenly among all: their noise is the least of what is unknown
_CAUCHY_SCALE = 2.3849
# standard deviation; without any, a wall seen straight leaves the focal length and the distance
# open together
_PRIOR_SIGMA = 0.3
_MIN_POINTS = 20
MISMATCH_FOCAL_FIELDS = ("focal_length_px", "focal_sigma_px", "calibrated_focal_length_px")
"""The first fields of a `CalibrationMismatch`, which are its JSON's keys as well."""


@dataclass(frozen=True, eq=False)
class ImageCalibration:
    """What a picture says of its camera: the focal length as `scale` times the calibrated one, the
    principal point's place beside the calibrated one (`offset`, focal lengths; x, y), `covariance`
    of the logarithm of the scale and of the offset, and the pose that goes with them."""

    scale: float
    offset: Float[np.ndarray, " 2"]
    covariance: Float[np.ndarray, "3 3"]
    cam_from_world: Rigid3


@dataclass(frozen=True, eq=False)
class IntrinsicsDeviation:
    """What a picture says of its camera beside the calibration, whatever the picture's size.

    `deviation` is the logarithm of the focal length over the calibrated one, and the principal
    point's way from the calibrated one (calibrated focal lengths; x, y); `covariance` is its noise,
    of points that are wrong independently. Pictures that show one `place` (a node) share what its
    points are wrong by.
    """

    deviation: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "3 3"]
    place: int = -1


@dataclass(frozen=True, eq=False)
class CalibrationMismatch:
    """What the picture says of its camera, against the calibration: pixels of the image as it came.

    `shift` is the left perturbation by which the pose differs that the picture's own camera leads
    to (metres, radians).
    """

    focal_length_px: float
    focal_sigma_px: float
    calibrated_focal_length_px: float
    principal_point_px: Float[np.ndarray, " 2"]
    calibrated_principal_point_px: Float[np.ndarray, " 2"]
    has_focal_mismatch: bool
    has_principal_point_mismatch: bool
    shift: Float[np.ndarray, " 6"]

    def __str__(self) -> str:
        parts = []
        if self.has_focal_mismatch:
            measured = f"f = {self.focal_length_px:.0f} +- {max(self.focal_sigma_px, 0.5):.0f} px"
            parts.append(f"{measured}, the calibration {self.calibrated_focal_length_px:.0f}")
        if self.has_principal_point_mismatch:
            (x, y), (cx, cy) = self.principal_point_px, self.calibrated_principal_point_px
            parts.append(
                f"the principal point at ({x:.0f}, {y:.0f}), the calibration ({cx:.0f}, {cy:.0f})"
            )
        return f"the picture says {'; '.join(parts)}"

    def to_json(self) -> dict[str, Any]:
        of = {
            "focal_length": self.has_focal_mismatch,
            "principal_point": self.has_principal_point_mismatch,
        }
        return {
            **{key: getattr(self, key) for key in MISMATCH_FOCAL_FIELDS},
            "of": [name for name, is_off in of.items() if is_off],
            "shift": self.shift.tolist(),
            "principal_point_px": self.principal_point_px.tolist(),
            "calibrated_principal_point_px": self.calibrated_principal_point_px.tolist(),
            "detail": str(self),
        }


def estimate_image_calibration(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    point_covariances: Float[np.ndarray, "n 3 3"],
    camera: Camera,
    cam_from_world: Rigid3,
    sigma_px: float,
) -> ImageCalibration | None:
    """From n pixels of points (metres), beginning at a pose found with the calibration; None from
    too few, or where nothing follows."""
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
        of_points = (observed, points_world, point_covariances, sigma_px / camera.fx, _CAUCHY_SCALE)
        information, gradient, squares = calibration_equations(
            rotation, translation, free, *of_points
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
    """The camera that a picture speaks of; its distortion is left as it is."""
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
    """What was found with `camera`, beside the calibration that the picture came with; both of one
    picture size."""
    own = corrected_camera(camera, found)
    way = np.array([own.cx - calibrated.cx, own.cy - calibrated.cy]) / calibrated.fx
    return IntrinsicsDeviation(
        np.array([math.log(own.fx / calibrated.fx), *way]), found.covariance, place
    )
