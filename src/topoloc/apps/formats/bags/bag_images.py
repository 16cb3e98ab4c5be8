"""Decode images and depth of messages: raw ones by their encoding, compressed ones as image
files."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from topoloc import Image, UnreadableImageError, read_depth, read_image
from topoloc.apps.formats.bags.messages import image_bytes
from topoloc.plugin import MAX_PIXELS, EncodedImage

# The type of a pixel, its channels, and what OpenCV makes RGB of it with (None: it is grey, or
# RGB).
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
_COMPRESSED_DEPTH = struct.Struct(
    "<iff"
)  # image_transport's header before the PNG: format, and how inverse depth was quantised


def decode_image(message: Any, name: str) -> Image:
    """Return the image of a message, grey (H, W) or RGB (H, W, 3), uint8.

    Raises:
        UnreadableImageError: damaged, of an encoding that is no picture, or of more than 100
            megapixels.
    """
    if not hasattr(message, "encoding"):
        return read_image(EncodedImage(name, _message_bytes(message, name)))
    pixels, to_rgb = _decode_pixels(message, name)
    if pixels.dtype == np.float32:
        raise UnreadableImageError(f"{name}: pixels of encoding 32FC1 are depth, not a picture")
    if pixels.dtype == np.uint16:
        return cv2.convertScaleAbs(pixels, alpha=1.0 / 257.0)
    try:
        return (
            np.array(pixels)
            if to_rgb is None
            else cv2.cvtColor(np.ascontiguousarray(pixels), to_rgb)
        )
    except cv2.error:
        raise UnreadableImageError(
            f"{name}: {pixels.shape[1]}x{pixels.shape[0]} pixels of {message.encoding} are no"
            " picture"
        ) from None


def decode_depth(message: Any, name: str) -> Float32[np.ndarray, "h w"]:
    """Return the depth of a message in metres, NaN if unknown. It is 16UC1 in millimetres or 32FC1
    in metres (REP 118), raw or compressedDepth.

    Raises:
        UnreadableImageError: damaged, or of another encoding.
    """
    if not hasattr(message, "encoding"):
        return _decode_compressed_depth(message, name)
    pixels, _ = _decode_pixels(message, name)
    if pixels.ndim != 2 or pixels.dtype not in (np.uint16, np.float32):
        raise UnreadableImageError(
            f"{name}: depth must be 16UC1 (mm) or 32FC1 (m), not {message.encoding}"
        )
    depth = pixels.astype(np.float32) / np.float32(
        _MILLIMETRES if pixels.dtype == np.uint16 else 1.0
    )
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
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(np.nan)).astype(
        np.float32
    )


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
    width, height, step, data = (
        int(message.width),
        int(message.height),
        int(message.step),
        _message_bytes(message, name),
    )
    kind = np.dtype(kind).newbyteorder(">" if getattr(message, "is_bigendian", 0) else "<")
    row = width * channels * kind.itemsize
    if not 0 < width * height <= MAX_PIXELS or step < row or len(data) < step * height:
        raise UnreadableImageError(
            f"{name}: {len(data)} bytes are no {width}x{height} pixels of {encoding}"
        )
    rows = np.frombuffer(data, np.uint8, step * height).reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="), copy=False)
    return pixels if channels == 1 else pixels.reshape(height, width, channels), to_rgb
