"""Hold the deviation of an image's camera from its calibration, and combine those of many images.

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

from topoloc.geometry.camera import MODELS, Camera
from topoloc.json_data import NonNegative, encode_json

MIN_IMAGES, MIN_PLACES = 5, 4  # images of one place share their errors, however many there are
_NUM_SIGMAS, _MIN_RELATIVE_DEVIATION = 3.0, 0.02  # of the focal length, or of the image's width
_NUM_MEAN_ITERATIONS = 10
_CAUCHY_SCALE = 2.3849
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, eq=False)
class IntrinsicsDeviation:
    """Hold the deviation of an image's estimated intrinsics from the calibration, independent of
    the image size.

    Args:
        deviation: logarithm of the focal length over the calibrated one, and the shift of the
            principal point in calibrated focal lengths (x, y).
        covariance: its noise under independent errors of the points.
        place: node that the image shows. Images of one node share the errors of its points.
        is_distorted: whether the image shows distortion that the calibration leaves out.
    """

    deviation: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "3 3"]
    place: int = -1
    is_distorted: bool = False


@dataclass(frozen=True, eq=False)
class CalibrationMismatch:
    """Compare the camera estimated from an image with the calibration, in pixels of the original
    image.

    `of` names the deviating parts: "focal_length", "principal_point", "distortion", whose amount is
    not measured, or "height" of an image that was scaled in one direction: focal lengths are then
    fy. `shift` is the left perturbation (metres, radians) from the pose under the calibration to
    the pose under the estimated camera.
    """

    focal_length_px: NonNegative
    focal_sigma_px: NonNegative
    calibrated_focal_length_px: NonNegative
    principal_point_px: Float[np.ndarray, " 2"]
    calibrated_principal_point_px: Float[np.ndarray, " 2"]
    of: list[str]
    shift: Float[np.ndarray, " 6"]

    def __str__(self) -> str:
        parts = []
        if "height" in self.of:
            parts.append(
                f"fy = {self.focal_length_px:.0f} +- {self.focal_sigma_px:.0f} px, the calibration"
                f" {self.calibrated_focal_length_px:.0f}, as after scaling in one direction"
            )
        if "focal_length" in self.of:
            measured = f"f = {self.focal_length_px:.0f} +- {max(self.focal_sigma_px, 0.5):.0f} px"
            parts.append(f"{measured}, the calibration {self.calibrated_focal_length_px:.0f}")
        if "principal_point" in self.of:
            (x, y), (cx, cy) = self.principal_point_px, self.calibrated_principal_point_px
            parts.append(
                f"the principal point at ({x:.0f}, {y:.0f}), the calibration ({cx:.0f}, {cy:.0f})"
            )
        if "distortion" in self.of:
            parts.append("that its lens distorts more than the calibration states")
        return f"the picture says {'; '.join(parts)}"

    def to_json(self) -> dict[str, Any]:
        """Return the mismatch as JSON, with a text for the user as `detail`."""
        return encode_json(self) | {"detail": str(self)}


def corrected_camera(camera: Camera, deviation: Float[np.ndarray, " 3"]) -> Camera:
    """Return the camera with another focal length and principal point (`IntrinsicsDeviation`). Its
    distortion is unchanged."""
    scale = math.exp(deviation[0])
    cx, cy = np.array([camera.cx, camera.cy]) + camera.fx * deviation[1:]
    moved = {"f": scale * camera.fx, "fx": scale * camera.fx, "fy": scale * camera.fy}
    moved |= {"cx": cx, "cy": cy}
    named = zip(MODELS[camera.model], camera.params, strict=True)
    return replace(camera, params=tuple(float(moved.get(name, value)) for name, value in named))


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
