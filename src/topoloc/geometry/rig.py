"""A stereo rig: two calibrated cameras and the transform between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3


@dataclass(frozen=True)
class StereoRig:
    """Left and right camera; `right_from_left` in metres.

    Raises:
        CalibrationError: the two cameras stand in the same place, or not finite.
    """

    left: Camera
    right: Camera
    right_from_left: Rigid3

    def __post_init__(self) -> None:
        if not np.isfinite(self.baseline) or self.baseline < 1e-6:
            raise CalibrationError(f"stereo rig: baseline of {self.baseline:g} m")

    @staticmethod
    def rectified(camera: Camera, baseline: float) -> StereoRig:
        """Two equal pinhole cameras side by side, the right one `baseline` metres to +x."""
        return StereoRig(camera, camera, Rigid3(np.eye(3), np.array([-baseline, 0.0, 0.0])))

    @property
    def baseline(self) -> float:
        """Distance between the two centres, metres."""
        return float(np.linalg.norm(self.right_from_left.translation))

    @property
    def is_rectified(self) -> bool:
        """Undistorted, equal rows, right camera straight to +x (principal points may differ in x)."""
        if self.left.is_distorted or self.right.is_distorted or "OPENCV_FISHEYE" in (self.left.model, self.right.model):
            return False
        translation = self.right_from_left.translation
        return bool(
            np.allclose([self.left.fx, self.left.fy, self.left.cy], [self.right.fx, self.right.fy, self.right.cy], atol=1e-6)
            and np.allclose(self.right_from_left.rotation, np.eye(3), atol=1e-9)
            and translation[0] < 0
            and np.allclose(translation[1:], 0.0, atol=1e-9)
        )
