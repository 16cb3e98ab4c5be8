"""Decode images, depth and calibrations of messages.

Raw images are decoded by their encoding, compressed ones as image files. A calibration (REP 104)
gives the raw camera from K and D, the rectified one from P. In ROS the centre of the top-left pixel
is (0, 0), as in topoloc.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Float32

from topoloc import (
    CalibrationError,
    Camera,
    Image,
    Rigid3,
    StereoRig,
    TrajectoryError,
    UnreadableImageError,
    read_depth,
    read_image,
)
from topoloc.apps.formats.bags.messages import frame_id, image_bytes
from topoloc.plugin import MAX_PIXELS, EncodedImage

# Type of a pixel, number of channels, and OpenCV's conversion to RGB (None for grey and RGB).
_ENCODINGS: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    "16UC1": ("u2", 1, None),
    "rgb8": ("u1", 3, None),
    "8UC3": ("u1", 3, cv2.COLOR_BGR2RGB),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2RGB),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2RGB),
    # OpenCV names a Bayer pattern by its second row's second pixel and the one before it.
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGB2RGB),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "32FC1": ("f4", 1, None),
}
_MILLIMETRES = 1000.0
# Header of image_transport before the PNG: the format, and the quantization of inverse depth.
_COMPRESSED_DEPTH = struct.Struct("<iff")
_NO_DISTORTION = ("", "none", "plumb_bob", "rational_polynomial")
_MAX_BASELINE = 1000.0  # metres; a larger one comes from a damaged number
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt4", "kannala_brandt")


def decode_image(message: Any, name: str) -> Image:
    """Return the image of a message, grey (H, W) or RGB (H, W, 3), uint8. Raises
    UnreadableImageError: damaged, of an encoding that is no picture, or of more than 100
    megapixels."""
    if not hasattr(message, "encoding"):
        return read_image(EncodedImage(name, _message_bytes(message, name)))
    pixels, to_rgb = _decode_pixels(message, name)
    if pixels.dtype == np.float32:
        raise UnreadableImageError(f"{name}: pixels of encoding 32FC1 are depth, not a picture")
    if pixels.dtype == np.uint16:
        return cv2.convertScaleAbs(pixels, alpha=1.0 / 257.0)
    if to_rgb is None:
        return np.array(pixels)
    try:
        return cv2.cvtColor(np.ascontiguousarray(pixels), to_rgb)
    except cv2.error:
        raise UnreadableImageError(
            f"{name}: {pixels.shape[1]}x{pixels.shape[0]} pixels of {message.encoding} are no"
            " picture"
        ) from None


def decode_depth(message: Any, name: str) -> Float32[np.ndarray, "h w"]:
    """Return the depth of a message in metres, NaN if unknown. It is 16UC1 in millimetres or 32FC1
    in metres (REP 118), raw or compressedDepth. Raises UnreadableImageError: damaged, or of another
    encoding."""
    if not hasattr(message, "encoding"):
        return _decode_compressed_depth(message, name)
    pixels, _ = _decode_pixels(message, name)
    if pixels.ndim != 2 or pixels.dtype not in (np.uint16, np.float32):
        raise UnreadableImageError(
            f"{name}: depth must be 16UC1 (mm) or 32FC1 (m), not {message.encoding}"
        )
    scale = np.float32(_MILLIMETRES if pixels.dtype == np.uint16 else 1.0)
    depth = pixels.astype(np.float32) / scale
    depth[~(np.isfinite(depth) & (depth > 0.0)) | (pixels == 65535)] = np.nan
    return depth


def _decode_compressed_depth(message: Any, name: str) -> Float32[np.ndarray, "h w"]:
    data = _message_bytes(message, name)
    if "compressedDepth" not in message.format:
        return read_depth(EncodedImage(name, data), _MILLIMETRES)
    if len(data) <= _COMPRESSED_DEPTH.size:
        raise UnreadableImageError(f"{name}: the picture is empty")
    _, scale, offset = _COMPRESSED_DEPTH.unpack_from(data)
    picture = EncodedImage(name, data[_COMPRESSED_DEPTH.size :])
    if "32FC1" not in message.format:
        return read_depth(picture, _MILLIMETRES)
    with np.errstate(all="ignore"):
        depth = np.float32(scale) / (read_depth(picture, 1.0) - np.float32(offset))
    is_known = np.isfinite(depth) & (depth > 0.0)
    return np.where(is_known, depth, np.float32(np.nan)).astype(np.float32)


def _message_bytes(message: Any, name: str) -> bytes:
    try:
        return image_bytes(message)
    except (ValueError, TypeError):
        raise UnreadableImageError(f"{name}: the data of this picture are no bytes") from None


def _decode_pixels(message: Any, name: str) -> tuple[np.ndarray, int | None]:
    """Return the stored pixels without the padding of rows."""
    encoding = str(message.encoding)
    if encoding not in _ENCODINGS:
        raise UnreadableImageError(
            f"{name}: pixels of encoding {encoding[:40]!r}; known are {', '.join(_ENCODINGS)}"
        )
    kind, channels, to_rgb = _ENCODINGS[encoding]
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = _message_bytes(message, name)
    kind = np.dtype(kind).newbyteorder(">" if getattr(message, "is_bigendian", 0) else "<")
    row = width * channels * kind.itemsize
    if not 0 < width * height <= MAX_PIXELS or step < row or len(data) < step * height:
        raise UnreadableImageError(
            f"{name}: {len(data)} bytes are no {width}x{height} pixels of {encoding}"
        )
    rows = np.frombuffer(data, np.uint8, step * height).reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="), copy=False)
    return pixels if channels == 1 else pixels.reshape(height, width, channels), to_rgb


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
                f"{self.topic}: distortion_model {self.model!r} of {len(coefficients)} coefficients"
                " is not known here"
            )
        if any(coefficients[4:]):
            return self._make_camera("FULL_OPENCV", self.matrix, (coefficients + [0.0] * 4)[:8])
        return self._make_camera("OPENCV", self.matrix, coefficients[:4])

    def rig(self, right: CameraInfo, is_rectified: bool) -> StereoRig | None:
        """Return the rig of this left camera and its right one. None if P does not contain the
        baseline. Raises CalibrationError: as of `camera`, or the right camera is not to the
        right."""
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
        right_from_left = rect_from_right.inverse() @ rect_right_from_rect_left @ rect_from_left
        return StereoRig(self.camera(False), right.camera(False), right_from_left)

    def _projection_offset(self) -> float:
        """Return the x offset of the rectified camera, from P = K [I | t]. NaN without a P."""
        focal, offset = float(self.projection[0, 0]), float(self.projection[0, 3])
        return offset / focal if focal > 0.0 else float("nan")

    def _make_camera(self, model: str, matrix: np.ndarray, coefficients: list[float]) -> Camera:
        params = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *coefficients)
        try:
            return Camera(model, self.width, self.height, tuple(float(value) for value in params))
        except CalibrationError as error:
            raise CalibrationError(f"{self.topic}: {error}") from None


def camera_info(message: Any, topic: str) -> CameraInfo:
    """Return the calibration of a message of ROS 1 (D, K, R, P), ROS 2 (d, k, r, p) or Foxglove.
    Raises CalibrationError: a field is missing, or not finite numbers of its shape."""
    try:
        fields = [np.array(_get_field(message, name), dtype=np.float64) for name in "DKRP"]
        distortion, matrix, rotation, projection = fields
        if not all(np.all(np.isfinite(numbers)) for numbers in fields):
            raise ValueError("numbers that are not finite")
        rotation = rotation.reshape(3, 3) if np.any(rotation) else np.eye(3)
        projection = projection.reshape(3, 4) if projection.size else np.zeros((3, 4))
        size, model = (int(message.width), int(message.height)), str(message.distortion_model)
        numbers = (distortion, matrix.reshape(3, 3), rotation, projection)
        return CameraInfo(topic, frame_id(message), *size, model, *numbers)
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise CalibrationError(f"{topic}: no calibration ({error})") from None


def _get_field(message: Any, name: str) -> Any:
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())
