"""Picture files: checked, decoded once, and brought to this house's types.

A broken file must not become a half-grey picture: OpenCV decodes many truncated files without a word, so size and
completeness are checked on the bytes before they are decoded. EXIF orientation is not applied: a calibration is of the
pixels as they are stored.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from topoloc.errors import UnreadableImageError
from topoloc.sequences.frame import Image
from topoloc.sequences.picture_headers import BrokenPicture, header_size

PICTURE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"})
MAX_PIXELS = 100_000_000
_LOG_LEVEL_LOCK = threading.Lock()


def read_image(path: Path) -> Image:
    """A picture as grey (H, W) or RGB (H, W, 3), uint8; alpha is dropped, 16 bits are scaled down to 8.

    Raises:
        UnreadableImageError: missing, empty, truncated, damaged, no picture, or of more than 100 megapixels.
    """
    pixels = _decode(path)
    if pixels.dtype == np.uint16:
        pixels = cv2.convertScaleAbs(pixels, alpha=1.0 / 257.0)
    if pixels.dtype != np.uint8:
        raise UnreadableImageError(f"{path}: pixels of type {pixels.dtype}, not of 8 or 16 bits")
    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] == 3:
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
    if pixels.shape[2] == 4:
        return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGB)
    return np.ascontiguousarray(pixels[:, :, 0])


def grey_image(image: Image) -> UInt8[np.ndarray, "h w"]:
    """The picture in grey, by the luma weights of Rec. 601; a grey one is returned as it is."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def read_depth(path: Path, units_per_metre: float) -> Float32[np.ndarray, "h w"]:
    """A 16-bit depth picture in metres; NaN where unknown (0 and 65535 in the file).

    Raises:
        UnreadableImageError: as `read_image`, or not a picture of one channel of 16 bits.
    """
    pixels = _decode(path)
    if pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise UnreadableImageError(f"{path}: depth must be one channel of 16 bits, not shape {pixels.shape} of {pixels.dtype}")
    depth = pixels.astype(np.float32) / np.float32(units_per_metre)
    depth[(pixels == 0) | (pixels == 65535)] = np.nan
    return depth


def jpeg_of(image: Image, quality: int) -> bytes:
    """The picture encoded; the same picture gives the same bytes."""
    bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the header where the file type allows it, else by decoding.

    Raises:
        UnreadableImageError: as `read_image`.
    """
    size = _checked_size(path, _read_bytes(path))
    if size is None:
        height, width = _decode(path).shape[:2]
        return width, height
    return size


def _read_bytes(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise UnreadableImageError(f"{path}: no such picture") from None
    except OSError as error:
        raise UnreadableImageError(f"{path}: {error.strerror}") from None
    if not data:
        raise UnreadableImageError(f"{path}: the file is empty")
    return data


def _checked_size(path: Path, data: bytes) -> tuple[int, int] | None:
    """Width and height by the header, None for the file types whose header is not read here."""
    try:
        size = header_size(data)
    except BrokenPicture as broken:
        raise UnreadableImageError(f"{path}: {broken}") from None
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        raise UnreadableImageError(f"{path}: {size[0]}x{size[1]} is more than {MAX_PIXELS // 1_000_000} megapixels")
    return size


def _decode(path: Path) -> np.ndarray:
    data = _read_bytes(path)
    try:
        if _checked_size(path, data) is not None:
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        else:
            with opencv_silent():
                pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.size == 0:
        raise UnreadableImageError(f"{path}: not a picture, or damaged")
    if pixels.shape[0] * pixels.shape[1] > MAX_PIXELS:
        raise UnreadableImageError(f"{path}: {pixels.shape[1]}x{pixels.shape[0]} is more than {MAX_PIXELS // 1_000_000} megapixels")
    return pixels


@contextmanager
def opencv_silent() -> Iterator[None]:
    """No OpenCV messages on stderr: types that are checked only by decoding make it write there about every broken file."""
    logging: Any = getattr(cv2.utils, "logging", cv2)  # OpenCV 4 has these functions in its own name space
    with _LOG_LEVEL_LOCK:
        level = logging.getLogLevel()
        logging.setLogLevel(0)
        try:
            yield
        finally:
            logging.setLogLevel(level)
