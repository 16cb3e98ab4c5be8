"""Hold the deviation of an image's camera from its calibration: plain data, cheap to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.json_data import NonNegative, encode_json


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

    `of` names the deviating parts: "focal_length", "principal_point", or "distortion", whose amount
    is not measured. `shift` is the left
    perturbation (metres, radians) from the pose under the calibration to the pose under the
    estimated camera.
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
