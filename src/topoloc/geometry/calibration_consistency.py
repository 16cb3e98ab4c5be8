"""Check the calibration of a camera with many of its images together, which are more precise than
one.

Each image is weighted by its information. Images that disagree by more than their noise get smaller
weights (Cauchy). Their scatter beyond the noise is added to each variance (random effects:
DerSimonian and Laird, *Controlled Clinical Trials* 7, 1986). Images of one place share the errors
of its points, so the covariance is scaled to the number of places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.geometry.calibration_mismatch import IntrinsicsDeviation
from topoloc.geometry.camera import Camera

MIN_IMAGES, MIN_PLACES = 5, 4  # images of one place share their errors, however many there are
_NUM_SIGMAS, _MIN_RELATIVE_DEVIATION = 3.0, 0.02  # of the focal length, or of the image's width
_NUM_ITERATIONS = 10
_MAD_TO_SIGMA = 1.4826
_CAUCHY_SCALE_SQUARED = 2.3849**2


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

    @property
    def is_contradicted(self) -> bool:
        """Return whether the images contradict the calibration."""
        return self.has_focal_mismatch or self.has_principal_point_mismatch

    def __str__(self) -> str:
        (x, y), (x_sigma, y_sigma), (cx, cy) = (
            self.principal_point_px,
            self.principal_point_sigma_px,
            self.calibrated_principal_point_px,
        )
        focal = (
            f"f = {self.focal_length_px:.1f} +- {self.focal_sigma_px:.1f} px, the calibration"
            f" {self.calibrated_focal_length_px:.1f}"
        )
        centre = (
            f"the principal point at ({x:.1f} +- {x_sigma:.1f}, {y:.1f} +- {y_sigma:.1f}), the"
            f" calibration ({cx:.1f}, {cy:.1f})"
        )
        if not self.is_contradicted:
            return f"the pictures agree with it: {focal} ({self.num_images} pictures)"
        parts = [
            text
            for text, is_said in (
                (focal, self.has_focal_mismatch),
                (centre, self.has_principal_point_mismatch),
            )
            if is_said
        ]
        return f"the pictures say {'; '.join(parts)} ({self.num_images} pictures)"

    def to_json(self) -> dict[str, Any]:
        """Return the result as JSON, with a text for the user as `detail`."""
        return {
            "num_pictures": self.num_images,
            "focal_length_px": self.focal_length_px,
            "focal_sigma_px": self.focal_sigma_px,
            "calibrated_focal_length_px": self.calibrated_focal_length_px,
            "principal_point_px": self.principal_point_px.tolist(),
            "principal_point_sigma_px": self.principal_point_sigma_px.tolist(),
            "calibrated_principal_point_px": self.calibrated_principal_point_px.tolist(),
            "contradicted": self.is_contradicted,
            "detail": str(self),
        }


def check_calibration_consistency(
    observations: Sequence[IntrinsicsDeviation], calibrated: Camera
) -> CalibrationConsistency | None:
    """Return the intrinsics estimated from images of one camera. Return None if there are fewer
    than five images or fewer than four places."""
    if len(observations) < MIN_IMAGES or len({one.place for one in observations}) < MIN_PLACES:
        return None
    deviation, covariance = _robust_mean(observations)
    sigmas = np.sqrt(np.diag(covariance))
    shares = np.abs(deviation) * np.array([1.0, *np.repeat(calibrated.fx / calibrated.width, 2)])
    is_off = (np.abs(deviation) > _NUM_SIGMAS * sigmas) & (shares > _MIN_RELATIVE_DEVIATION)
    focal, centre = (
        calibrated.fx * float(np.exp(deviation[0])),
        np.array([calibrated.cx, calibrated.cy]),
    )
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
    )


def _robust_mean(
    observations: Sequence[IntrinsicsDeviation],
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Return the robust mean of the deviations and its covariance."""
    deviations, covariances = (
        np.stack([one.deviation for one in observations]),
        np.stack([one.covariance for one in observations]),
    )
    variances = np.einsum("nii->ni", covariances)
    mean = np.median(deviations, axis=0)
    information = np.eye(3)
    for _ in range(_NUM_ITERATIONS):
        residuals = deviations - mean
        spread = (_MAD_TO_SIGMA * np.median(np.abs(residuals), axis=0)) ** 2
        excess = np.maximum(spread - np.median(variances, axis=0), 0.0)
        inverse = np.linalg.inv(covariances + np.diag(excess))
        squares = np.einsum("ni,nij,nj->n", residuals, inverse, residuals)
        inverse /= (1.0 + squares / _CAUCHY_SCALE_SQUARED)[:, None, None]
        information = inverse.sum(axis=0)
        mean = np.linalg.solve(information, np.einsum("nij,nj->i", inverse, deviations))
    num_places = len({one.place for one in observations})
    return mean, np.linalg.inv(information) * len(observations) / num_places
