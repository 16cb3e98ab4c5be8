"""Read a calibration of ROS: K, D, R and P of a camera (REP 104), from messages or files.

K and D give the camera of raw images, P that of rectified ones. In ROS the centre of the top-left
pixel is (0, 0), as in topoloc.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from topoloc import CalibrationError, Camera, Rigid3, StereoRig, TrajectoryError
from topoloc.apps.core_names import (
    read_yaml,
    require_numbers,
    yaml_image_size,
    yaml_numbers,
    yaml_word,
)
from topoloc.plugin import CameraCalibration

_NO_DISTORTION = ("", "none", "plumb_bob", "rational_polynomial")
_MAX_BASELINE = 1000.0  # metres; a larger one comes from a damaged number
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt4", "kannala_brandt")


@dataclass(frozen=True, eq=False)
class RosCalibration:
    """Hold the calibration of a topic or a file. `rotation` rotates the raw camera to the rectified
    one, which has the projection `projection`. `name` is that in errors."""

    name: str
    frame: str
    width: int
    height: int
    model: str
    distortion: Float[np.ndarray, " d"]
    matrix: Float[np.ndarray, "3 3"]
    rotation: Float[np.ndarray, "3 3"]
    projection: Float[np.ndarray, "3 4"]

    @property
    def is_calibrated(self) -> bool:
        """Return whether the camera is calibrated. ROS writes K = 0 otherwise."""
        return bool(np.any(self.matrix))

    def reduced(
        self, offset: tuple[int, int], size: tuple[int, int], binning: tuple[int, int]
    ) -> RosCalibration:
        """Return the calibration of a part of the images, after binning (pixels; REP 104).

        Args:
            offset: the top-left pixel of the part, of the full image.
            size: width and height of the part, before binning. (0, 0) means the full image.
            binning: pixels that become one, across and down. 0 means 1.
        """
        across, down = max(binning[0], 1), max(binning[1], 1)
        matrix, projection = self.matrix.copy(), self.projection.copy()
        for part in (matrix, projection):
            part[:2, 2] -= offset
            part[:2] /= np.array([[across], [down]])
        width, height = size if all(size) else (self.width, self.height)
        size = width // across, height // down
        return replace(self, width=size[0], height=size[1], matrix=matrix, projection=projection)

    def camera(self, is_rectified: bool) -> Camera:
        """Return the camera of the raw images, or of the rectified ones. Raises CalibrationError:
        of a model that is not known here, or no camera's numbers."""
        if is_rectified and self.projection[0, 0] > 0.0:
            return self._make_camera("PINHOLE", self.projection, [])
        if is_rectified or not np.any(self.distortion):
            return self._make_camera("PINHOLE", self.matrix, [])
        coefficients = self.distortion.tolist()
        if self.model in _FISHEYE and len(coefficients) >= 4:
            return self._make_camera("OPENCV_FISHEYE", self.matrix, coefficients[:4])
        if self.model not in _NO_DISTORTION or len(coefficients) < 4 or any(coefficients[8:]):
            raise CalibrationError(
                f"{self.name}: distortion_model {self.model!r} of {len(coefficients)} coefficients"
                " is not known here"
            )
        if any(coefficients[4:]):
            return self._make_camera("FULL_OPENCV", self.matrix, (coefficients + [0.0] * 4)[:8])
        return self._make_camera("OPENCV", self.matrix, coefficients[:4])

    def rig(self, right: RosCalibration, is_rectified: bool) -> StereoRig | None:
        """Return the rig of this left camera and its right one. None if P does not contain the
        baseline. Raises CalibrationError: as of `camera`, or the right camera is not to the
        right."""
        shift = right._projection_offset() - self._projection_offset()
        if not np.isfinite(shift) or shift == 0.0:
            return None
        if abs(shift) > _MAX_BASELINE:
            raise CalibrationError(f"{right.name}: P puts the right camera {abs(shift):.3g} m away")
        if shift > 0.0:
            raise CalibrationError(
                f"{right.name}: P puts the right camera {shift:.3g} m to the left; are left and"
                " right swapped?"
            )
        rect_right_from_rect_left = Rigid3(np.eye(3), np.array([shift, 0.0, 0.0]))
        if is_rectified:
            return StereoRig(self.camera(True), right.camera(True), rect_right_from_rect_left)
        try:
            rect_from_left, rect_from_right = (
                Rigid3.from_matrix(np.block([[camera.rotation, np.zeros((3, 1))], [0, 0, 0, 1]]))
                for camera in (self, right)
            )
        except TrajectoryError as error:
            raise CalibrationError(
                f"{right.name}, or that of the left camera: R is {error}"
            ) from None
        right_from_left = rect_from_right.inverse() @ rect_right_from_rect_left @ rect_from_left
        return StereoRig(self.camera(False), right.camera(False), right_from_left)

    def _projection_offset(self) -> float:
        """Return the x offset of the rectified camera, from P = K [I | t]. NaN without a P."""
        focal, offset = float(self.projection[0, 0]), float(self.projection[0, 3])
        return offset / focal if focal > 0.0 else float("nan")

    def _make_camera(self, model: str, matrix: np.ndarray, coefficients: list[float]) -> Camera:
        params = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *coefficients)
        with CalibrationError.at(self.name):
            return Camera(model, self.width, self.height, tuple(float(value) for value in params))


def read_ros_pair(left: Path, right: Path, size: tuple[float, float]) -> CameraCalibration | None:
    """Read the pair of two files, one a camera. `size` (width and height, pixels) is used if a file
    contains none. None if they do not contain the baseline. Raises CalibrationError with the file
    name."""
    one, other = (_read_ros_file(path, size) for path in (left, right))
    rig = one.rig(other, is_rectified=False)
    return rig and CameraCalibration(rig.left, rig)


def _read_ros_file(path: Path, size: tuple[float, float]) -> RosCalibration:
    text = read_yaml(path)
    width, height = (int(min(length, 1e9)) for length in yaml_image_size(text) or size)
    numbers = {
        key: np.array(require_numbers(path, text, count, f"{key}_matrix"))
        for key, count in (("camera", 9), ("rectification", 9), ("projection", 12))
    }
    return RosCalibration(
        name=str(path),
        frame="",
        width=width,
        height=height,
        model=yaml_word(text, "distortion_model", ""),
        distortion=np.array(yaml_numbers(text, "distortion_coefficients")),
        matrix=numbers["camera"].reshape(3, 3),
        rotation=numbers["rectification"].reshape(3, 3),
        projection=numbers["projection"].reshape(3, 4),
    )
