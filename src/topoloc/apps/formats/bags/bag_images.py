"""Decode images, depth and calibrations of messages.

Raw images are decoded by their encoding, compressed ones as image files. A calibration (REP 104)
may belong to the full sensor: binning and the region of interest are applied.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Int64, UInt16

from topoloc import CalibrationError, Image, UnreadableImageError, read_depth, read_image
from topoloc.apps.core_names import MAX_PIXELS
from topoloc.apps.formats.bags.messages import frame_id, image_bytes
from topoloc.apps.formats.calibrations.ros_calibration import RosCalibration
from topoloc.plugin import EncodedImage, image_size

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
_RVL_SIZE = struct.Struct("<II")


def image_file(message: Any, name: str, is_reversed: bool = False) -> EncodedImage | None:
    """Return the image of a message as a file, if it is compressed or has 16 bits, else None.
    `is_reversed` is that of `decode_pixels`. Raises UnreadableImageError."""
    if not hasattr(message, "encoding"):
        return EncodedImage(name, _message_bytes(message, name))
    if str(message.encoding) not in ("mono16", "16UC1"):
        return None
    pixels, _ = decode_pixels(message, name, is_reversed)
    return EncodedImage(name, cv2.imencode(".pgm", pixels)[1].tobytes())


def decode_image(
    message: Any, name: str, white: Callable[[], int] | None = None, is_reversed: bool = False
) -> Image:
    """Return the image of a message, grey (H, W) or RGB (H, W, 3), uint8. `white` returns that of
    `read_image`, and is not called for raw images of 8 bits. `is_reversed` is that of
    `decode_pixels`. Raises UnreadableImageError: damaged, of an encoding that is no picture, or of
    more than 100 megapixels."""
    if file := image_file(message, name, is_reversed):
        return read_image(file, white=white and white())
    pixels, to_rgb = decode_pixels(message, name, is_reversed)
    if pixels.dtype == np.float32:
        raise UnreadableImageError(f"{name}: pixels of encoding 32FC1 are depth, not a picture")
    if to_rgb is None:
        return np.array(pixels)
    try:
        return cv2.cvtColor(np.ascontiguousarray(pixels), to_rgb)
    except cv2.error:
        raise UnreadableImageError(
            f"{name}: {pixels.shape[1]}x{pixels.shape[0]} pixels of {message.encoding} are no"
            " picture"
        ) from None


def decode_depth(message: Any, name: str, is_reversed: bool = False) -> Float32[np.ndarray, "h w"]:
    """Return the depth of a message in metres, NaN if unknown. It is 16UC1 in millimetres or 32FC1
    in metres (REP 118), raw or compressedDepth. `is_reversed` is that of `decode_pixels`. Raises
    UnreadableImageError: damaged, or of another encoding."""
    if not hasattr(message, "encoding"):
        return _decode_compressed_depth(message, name)
    pixels, _ = decode_pixels(message, name, is_reversed)
    if pixels.ndim != 2 or pixels.dtype not in (np.uint16, np.float32):
        raise UnreadableImageError(
            f"{name}: depth must be 16UC1 (mm) or 32FC1 (m), not {message.encoding}"
        )
    scale = np.float32(_MILLIMETRES if pixels.dtype == np.uint16 else 1.0)
    depth = pixels.astype(np.float32) / scale
    depth[~(np.isfinite(depth) & (depth > 0.0)) | (pixels == 65535)] = np.nan
    return depth


def are_millimetres(depth: Float32[np.ndarray, " n"]) -> bool:
    """Return whether float depth that should be in metres is in millimetres: no camera measures
    hundreds of metres in whole metres, or has nothing nearer than 100 m and most beyond 1 km.

    Args:
        depth: known depth of several images. The largest value may be that of the sky.
    """
    max_metres, max_far, max_millimetres, min_whole = 100.0, 1e3, 1e5, 0.99
    depth = depth[depth < depth.max(initial=0.0)]
    if not len(depth):
        return False
    near, median = np.quantile(depth, [0.05, 0.5])
    is_whole = np.mean(depth == np.rint(depth)) > min_whole and median > max_metres
    return bool(median < max_millimetres and (is_whole or (median > max_far and near > max_metres)))


def _decode_compressed_depth(message: Any, name: str) -> Float32[np.ndarray, "h w"]:
    data = _message_bytes(message, name)
    if "compressedDepth" not in message.format:
        return read_depth(EncodedImage(name, data), _MILLIMETRES)
    if len(data) <= _COMPRESSED_DEPTH.size:
        raise UnreadableImageError(f"{name}: the picture is empty")
    _, scale, offset = _COMPRESSED_DEPTH.unpack_from(data)
    data, is_float = data[_COMPRESSED_DEPTH.size :], "32FC1" in message.format
    units_per_metre = 1.0 if is_float else _MILLIMETRES
    if "rvl" in message.format.lower():
        units = _decode_rvl(data, name).astype(np.float32)
        depth = np.where((units > 0) & (units < 65535), units / units_per_metre, np.nan)
        depth = depth.astype(np.float32)
    else:
        depth = read_depth(EncodedImage(name, data), units_per_metre)
    if not is_float:
        return depth
    with np.errstate(all="ignore"):
        depth = np.float32(scale) / (depth - np.float32(offset))
    is_known = np.isfinite(depth) & (depth > 0.0)
    return np.where(is_known, depth, np.float32(np.nan)).astype(np.float32)


def _decode_rvl(data: bytes, name: str) -> UInt16[np.ndarray, "h w"]:
    """Return the pixels of depth compressed by RVL, 0 if unknown (Wilson, *Fast lossless depth
    image compression*, ISS 2017).

    The data are counts of zeros and of other pixels, and differences of the other pixels. Raises
    UnreadableImageError: damaged, or too large.
    """
    width, height = _RVL_SIZE.unpack_from(data) if len(data) >= _RVL_SIZE.size else (0, 0)
    if not 0 < width * height <= MAX_PIXELS:
        raise UnreadableImageError(f"{name}: depth of {width}x{height} pixels, compressed by RVL")
    numbers = _decode_numbers(data[_RVL_SIZE.size :])
    pixels = np.zeros(width * height, np.int64)
    is_known = np.zeros(width * height, bool)
    row = start = 0
    while start < len(pixels):
        zeros, others = numbers[row : row + 2] if row + 2 <= len(numbers) else (0, len(pixels) + 1)
        row, start = row + 2, start + int(zeros)
        end = start + int(others)
        if end > len(pixels) or row + others > len(numbers):
            raise UnreadableImageError(f"{name}: depth compressed by RVL is damaged")
        pixels[start:end] = numbers[row : row + others]
        is_known[start:end] = True
        row, start = row + int(others), end
    zigzag = pixels[is_known]
    pixels[is_known] = np.cumsum((zigzag >> 1) ^ -(zigzag & 1))
    return (pixels & 0xFFFF).astype(np.uint16).reshape(height, width)


def _decode_numbers(data: bytes) -> Int64[np.ndarray, " n"]:
    """Return the numbers in groups of nibbles: three bits each, the lowest first. The fourth bit is
    set if the number continues."""
    max_nibbles = 11  # of 32 bits
    words = np.frombuffer(data, "<u4", len(data) // 4)
    nibbles = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 15).ravel()
    ends = np.flatnonzero(nibbles < 8)
    if not len(ends):
        return np.zeros(0, np.int64)
    nibbles = nibbles[: ends[-1] + 1].astype(np.int64)
    starts = np.append(0, ends[:-1] + 1)
    place = np.arange(len(nibbles)) - np.repeat(starts, ends - starts + 1)
    bits = np.where(place < max_nibbles, (nibbles & 7) << np.minimum(3 * place, 33), 0)
    return np.add.reduceat(bits, starts)


def _message_bytes(message: Any, name: str) -> bytes:
    try:
        return image_bytes(message)
    except (ValueError, TypeError):
        raise UnreadableImageError(f"{name}: the data of this picture are no bytes") from None


def decode_pixels(
    message: Any, name: str, is_reversed: bool = False
) -> tuple[np.ndarray, int | None]:
    """Return the stored pixels without the padding of rows, and OpenCV's conversion to RGB. With
    `is_reversed`, the bytes of each pixel come in the other order than the message says."""
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
    if is_reversed:
        rows = rows.reshape(height, width, -1)[..., ::-1].reshape(height, row)
    pixels = np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="), copy=False)
    return pixels if channels == 1 else pixels.reshape(height, width, channels), to_rgb


def camera_info(message: Any, topic: str) -> RosCalibration:
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
        return RosCalibration(topic, frame_id(message), *size, model, *numbers)
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise CalibrationError(f"{topic}: no calibration ({error})") from None


def reduce_to_part(found: RosCalibration, message: Any) -> RosCalibration:
    """Return the calibration of the images that the binning and the region of interest of its
    message describe."""
    part = getattr(message, "roi", None)
    names = ("x_offset", "y_offset", "width", "height")
    x, y, width, height = (int(getattr(part, name, 0)) for name in names)
    across, down = (int(getattr(message, f"binning_{axis}", 1)) for axis in "xy")
    return found.reduced((x, y), (width, height), (across, down))


def message_size(message: Any, name: str) -> tuple[int, int]:
    """Return width and height of an image of a message. Raises UnreadableImageError."""
    if hasattr(message, "encoding"):
        return int(message.width), int(message.height)
    return image_size(EncodedImage(name, _message_bytes(message, name)))


def _get_field(message: Any, name: str) -> Any:
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.lower())
