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

_ROUNDS = 3
_MAX_POINTS = 256  # evenly among all: their noise is the least of what is unknown
_CAUCHY_SCALE = 2.3849
# standard deviation; without any, a wall seen straight leaves the focal length and the distance
# open together
_PRIOR = 0.3
_MIN_POINTS = 20
DOUBT_LENGTHS = ("focal_length_px", "focal_sigma_px", "calibrated_focal_length_px")
"""The first fields of a `CalibrationDoubt`, which are its JSON's keys as well."""


@dataclass(frozen=True, eq=False)
class PictureCalibration:
    """What a picture says of its camera: the focal length as `scale` times the calibrated one, the
    principal point's place beside the calibrated one (`offset`, focal lengths; x, y), `covariance`
    of the logarithm of the scale and of the offset, and the pose that goes with them."""

    scale: float
    offset: Float[np.ndarray, " 2"]
    covariance: Float[np.ndarray, "3 3"]
    cam_from_world: Rigid3


@dataclass(frozen=True, eq=False)
class SeenCamera:
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
class CalibrationDoubt:
    """What the picture says of its camera, against the calibration: pixels of the image as it came.

    `shift` is the left perturbation by which the pose differs that the picture's own camera leads
    to (metres, radians).
    """

    focal_length_px: float
    focal_sigma_px: float
    calibrated_focal_length_px: float
    centre_px: Float[np.ndarray, " 2"]
    calibrated_centre_px: Float[np.ndarray, " 2"]
    is_of_focal_length: bool
    is_of_centre: bool
    shift: Float[np.ndarray, " 6"]

    def __str__(self) -> str:
        parts = []
        if self.is_of_focal_length:
            measured = f"f = {self.focal_length_px:.0f} +- {max(self.focal_sigma_px, 0.5):.0f} px"
            parts.append(f"{measured}, the calibration {self.calibrated_focal_length_px:.0f}")
        if self.is_of_centre:
            (x, y), (cx, cy) = self.centre_px, self.calibrated_centre_px
            parts.append(
                f"the principal point at ({x:.0f}, {y:.0f}), the calibration ({cx:.0f}, {cy:.0f})"
            )
        return f"the picture says {'; '.join(parts)}"

    def to_json(self) -> dict[str, Any]:
        of = {"focal_length": self.is_of_focal_length, "principal_point": self.is_of_centre}
        return {
            **{key: getattr(self, key) for key in DOUBT_LENGTHS},
            "of": [name for name, is_said in of.items() if is_said],
            "shift": self.shift.tolist(),
            "principal_point_px": self.centre_px.tolist(),
            "calibrated_principal_point_px": self.calibrated_centre_px.tolist(),
            "detail": str(self),
        }


def calibration_of_picture(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    point_covariances: Float[np.ndarray, "n 3 3"],
    camera: Camera,
    cam_from_world: Rigid3,
    sigma_px: float,
) -> PictureCalibration | None:
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
    for _ in range(_ROUNDS):
        rotation, translation = (
            np.ascontiguousarray(pose.rotation),
            np.ascontiguousarray(pose.translation),
        )
        of_points = (observed, points_world, point_covariances, sigma_px / camera.fx, _CAUCHY_SCALE)
        information, gradient, squares = calibration_equations(
            rotation, translation, free, *of_points
        )
        information[6:, 6:] += np.eye(3) / _PRIOR**2
        gradient[6:] += free / _PRIOR**2
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
    return PictureCalibration(math.exp(free[0]), free[1:], covariance, pose)


def camera_of_picture(camera: Camera, found: PictureCalibration) -> Camera:
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


def seen_beside(
    calibrated: Camera, camera: Camera, found: PictureCalibration, place: int
) -> SeenCamera:
    """What was found with `camera`, beside the calibration that the picture came with; both of one
    picture size."""
    own = camera_of_picture(camera, found)
    way = np.array([own.cx - calibrated.cx, own.cy - calibrated.cy]) / calibrated.fx
    return SeenCamera(np.array([math.log(own.fx / calibrated.fx), *way]), found.covariance, place)
