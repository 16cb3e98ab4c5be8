"""What many pictures of one camera say of its calibration together: what one picture cannot tell,
they can.

Each picture's say is weighed by its information; pictures that disagree with the others by more
than their noise allows for are heard less (Cauchy weights), and what they scatter by beyond their
noise is one more variance of each (random effects: DerSimonian and Laird, *Controlled Clinical
Trials* 7, 1986). Pictures of one place share what its points are wrong by, so that they count as
one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.geometry.calibration_check import SeenCamera
from topoloc.geometry.camera import Camera

MIN_PICTURES, MIN_PLACES = 5, 4  # pictures of one place are wrong together, however many they are
_NUM_SIGMAS, _SHARE = 3.0, 0.02  # of the focal length, or of the picture's width
_ROUNDS = 10
_SIGMAS_OF_MAD = 1.4826
_CAUCHY_SQUARE = 2.3849**2


@dataclass(frozen=True, eq=False)
class CalibrationVerdict:
    """Pixels of the pictures as they came; sigmas are of the numbers before them. `num_pictures`
    are those that had something to say."""

    num_pictures: int
    focal_length_px: float
    focal_sigma_px: float
    calibrated_focal_length_px: float
    centre_px: Float[np.ndarray, " 2"]
    centre_sigma_px: Float[np.ndarray, " 2"]
    calibrated_centre_px: Float[np.ndarray, " 2"]
    is_of_focal_length: bool
    is_of_centre: bool

    @property
    def contradicts(self) -> bool:
        """Is the calibration contradicted?"""
        return self.is_of_focal_length or self.is_of_centre

    def __str__(self) -> str:
        (x, y), (x_sigma, y_sigma), (cx, cy) = (
            self.centre_px,
            self.centre_sigma_px,
            self.calibrated_centre_px,
        )
        focal = (
            f"f = {self.focal_length_px:.1f} +- {self.focal_sigma_px:.1f} px, the calibration"
            f" {self.calibrated_focal_length_px:.1f}"
        )
        centre = (
            f"the principal point at ({x:.1f} +- {x_sigma:.1f}, {y:.1f} +- {y_sigma:.1f}), the"
            f" calibration ({cx:.1f}, {cy:.1f})"
        )
        if not self.contradicts:
            return f"the pictures agree with it: {focal} ({self.num_pictures} pictures)"
        parts = [
            text
            for text, is_said in ((focal, self.is_of_focal_length), (centre, self.is_of_centre))
            if is_said
        ]
        return f"the pictures say {'; '.join(parts)} ({self.num_pictures} pictures)"

    def to_json(self) -> dict[str, Any]:
        return {
            "num_pictures": self.num_pictures,
            "focal_length_px": self.focal_length_px,
            "focal_sigma_px": self.focal_sigma_px,
            "calibrated_focal_length_px": self.calibrated_focal_length_px,
            "principal_point_px": self.centre_px.tolist(),
            "principal_point_sigma_px": self.centre_sigma_px.tolist(),
            "calibrated_principal_point_px": self.calibrated_centre_px.tolist(),
            "contradicted": self.contradicts,
            "detail": str(self),
        }


def verdict_of_pictures(
    seen: Sequence[SeenCamera], calibrated: Camera
) -> CalibrationVerdict | None:
    """What pictures of one camera say together; None from fewer than five, or of fewer than four
    places."""
    if len(seen) < MIN_PICTURES or len({one.place for one in seen}) < MIN_PLACES:
        return None
    deviation, covariance = _combined(seen)
    sigmas = np.sqrt(np.diag(covariance))
    shares = np.abs(deviation) * np.array([1.0, *np.repeat(calibrated.fx / calibrated.width, 2)])
    is_off = (np.abs(deviation) > _NUM_SIGMAS * sigmas) & (shares > _SHARE)
    focal, centre = (
        calibrated.fx * float(np.exp(deviation[0])),
        np.array([calibrated.cx, calibrated.cy]),
    )
    return CalibrationVerdict(
        len(seen),
        focal,
        focal * float(sigmas[0]),
        calibrated.fx,
        centre + calibrated.fx * deviation[1:],
        calibrated.fx * sigmas[1:],
        centre,
        bool(is_off[0]),
        bool(is_off[1:].any()),
    )


def _combined(
    seen: Sequence[SeenCamera],
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Robust mean of the deviations, and its covariance."""
    deviations, covariances = (
        np.stack([one.deviation for one in seen]),
        np.stack([one.covariance for one in seen]),
    )
    variances = np.einsum("nii->ni", covariances)
    mean = np.median(deviations, axis=0)
    information = np.eye(3)
    for _ in range(_ROUNDS):
        residuals = deviations - mean
        spread = (_SIGMAS_OF_MAD * np.median(np.abs(residuals), axis=0)) ** 2
        excess = np.maximum(spread - np.median(variances, axis=0), 0.0)
        inverse = np.linalg.inv(covariances + np.diag(excess))
        squares = np.einsum("ni,nij,nj->n", residuals, inverse, residuals)
        inverse /= (1.0 + squares / _CAUCHY_SQUARE)[:, None, None]
        information = inverse.sum(axis=0)
        mean = np.linalg.solve(information, np.einsum("nij,nj->i", inverse, deviations))
    num_places = len({one.place for one in seen})
    return mean, np.linalg.inv(information) * len(seen) / num_places
