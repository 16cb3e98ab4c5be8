"""Convert calibrations of messages (REP 104) to cameras and rigs: the raw camera from K and D, the
rectified one from P.

In ROS the centre of the top-left pixel is (0, 0), as in topoloc.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc import CalibrationError, Camera, Rigid3, StereoRig, TrajectoryError
from topoloc.apps.formats.bags.messages import frame_id

_NO_DISTORTION = ("", "none", "plumb_bob", "rational_polynomial")
_MAX_BASELINE = (
    1000.0  # metres; of the largest rigs there are, and beyond what a damaged number may be
)
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt4", "kannala_brandt")


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """Hold the calibration of a topic. `rotation` rotates the raw camera to the rectified one,
    which has the projection `projection`."""

    topic: str
    frame: str
    width: int
    height: int
    model: str
    distortion: Float[np.ndarray, " d"]
    matrix: Float[np.ndarray, "3 3"]
    rotation: Float[np.ndarray, "3 3"]
    projection: Float[np.ndarray, "3 4"]

    def camera(self, is_rectified: bool) -> Camera:
        """Return the camera of the raw images, or of the rectified ones.

        Raises:
            CalibrationError: of a model that is not known here, or no camera's numbers.
        """
        if is_rectified and self.projection[0, 0] > 0.0:
            return self._make_camera("PINHOLE", self.projection, [])
        if is_rectified or not np.any(self.distortion):
            return self._make_camera("PINHOLE", self.matrix, [])
        coefficients = self.distortion.tolist()
        if self.model in _FISHEYE and len(coefficients) >= 4:
            return self._make_camera("OPENCV_FISHEYE", self.matrix, coefficients[:4])
        if self.model not in _NO_DISTORTION or len(coefficients) < 4 or any(coefficients[8:]):
            raise CalibrationError(
                f"{self.topic}: distortion_model {self.model!r} of {len(coefficients)} coefficients"
                " is not known here"
            )
        if any(coefficients[4:]):
            return self._make_camera("FULL_OPENCV", self.matrix, (coefficients + [0.0] * 4)[:8])
        return self._make_camera("OPENCV", self.matrix, coefficients[:4])

    def rig(self, right: CameraInfo, is_rectified: bool) -> StereoRig | None:
        """Return the rig of this left camera and its right one. None if P does not contain the
        baseline.

        Raises:
            CalibrationError: as of `camera`, or the right camera is not to the right.
        """
        shift = right._projection_offset() - self._projection_offset()
        if not np.isfinite(shift) or shift == 0.0:
            return None
        if abs(shift) > _MAX_BASELINE:
            raise CalibrationError(
                f"{right.topic}: P puts the right camera {abs(shift):.3g} m away"
            )
        if shift > 0.0:
            raise CalibrationError(
                f"{right.topic}: P puts the right camera {shift:.3g} m to the left; are left and"
                " right swapped?"
            )
        rect_right_from_rect_left = Rigid3(np.eye(3), np.array([shift, 0.0, 0.0]))
        if is_rectified:
            return StereoRig(self.camera(True), right.camera(True), rect_right_from_rect_left)
        try:
            rect_from_left, rect_from_right = (
                Rigid3.from_matrix(np.block([[one.rotation, np.zeros((3, 1))], [0, 0, 0, 1]]))
                for one in (self, right)
            )
        except TrajectoryError as error:
            raise CalibrationError(
                f"{right.topic}, or that of the left camera: R is {error}"
            ) from None
        return StereoRig(
            self.camera(False),
            right.camera(False),
            rect_from_right.inverse() @ rect_right_from_rect_left @ rect_from_left,
        )

    def _projection_offset(self) -> float:
        """Return the x offset of the rectified camera, from P = K [I | t]. NaN without a P."""
        return (
            float(self.projection[0, 3]) / float(self.projection[0, 0])
            if self.projection[0, 0] > 0.0
            else float("nan")
        )

    def _make_camera(self, model: str, matrix: np.ndarray, coefficients: list[float]) -> Camera:
        params = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *coefficients)
        try:
            return Camera(model, self.width, self.height, tuple(float(value) for value in params))
        except CalibrationError as error:
            raise CalibrationError(f"{self.topic}: {error}") from None


def camera_info(message: Any, topic: str) -> CameraInfo:
    """Return the calibration of a message of ROS 1 (D, K, R, P), ROS 2 (d, k, r, p) or Foxglove.

    Raises:
        CalibrationError: a field is missing, or not finite numbers of its shape.
    """
    try:
        fields = [np.array(_get_field(message, name), dtype=np.float64) for name in "DKRP"]
        distortion, matrix, rotation, projection = fields
        if not all(np.all(np.isfinite(numbers)) for numbers in fields):
            raise ValueError("numbers that are not finite")
        rotation = rotation.reshape(3, 3) if np.any(rotation) else np.eye(3)
        projection = projection.reshape(3, 4) if projection.size else np.zeros((3, 4))
        size = int(message.width), int(message.height)
        return CameraInfo(
            topic,
            frame_id(message),
            *size,
            str(message.distortion_model),
            distortion,
            matrix.reshape(3, 3),
            rotation,
            projection,
        )
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise CalibrationError(f"{topic}: no calibration ({error})") from None


def _get_field(message: Any, name: str) -> Any:
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())
