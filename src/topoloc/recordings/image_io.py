"""Picture files: checked by their headers, decoded once by Pillow, and brought to this house's
types.

A broken file must not become a half-grey picture, nor a small file fill the memory: size and type
are known before anything is decoded, and files that end early are refused. A picture is turned as
its EXIF orientation says, and its size is that of the turned picture.
"""

from __future__ import annotations

import io
import math
import stat
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from PIL import (  # the readers make themselves known to Pillow
    BmpImagePlugin,  # noqa: F401
    ExifTags,
    ImageFile,
    ImageOps,
    JpegImagePlugin,  # noqa: F401
    PngImagePlugin,  # noqa: F401
    PpmImagePlugin,  # noqa: F401
    TiffImagePlugin,  # noqa: F401
    WebPImagePlugin,  # noqa: F401
)
from PIL import Image as Pillow

from topoloc.errors import UnreadableImageError
from topoloc.recordings.frame import Image

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp", ".heic", ".heif"}
)
MAX_PIXELS = 100_000_000
_IMAGE_TYPES = ("PNG", "JPEG", "BMP", "PPM", "TIFF", "WEBP")
# Pillow warns of odd metadata, and of pictures larger than it likes; the limit here is ours.
warnings.filterwarnings("ignore", module=r"PIL\.")
_GREY_MODES, _GREY_16_MODES = ("L", "1"), ("I;16", "I;16L", "I;16B", "I")
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}  # inch, centimetre, millimetre
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
_TRANSPOSED_ORIENTATIONS = (5, 6, 7, 8)  # EXIF orientations that lay a picture on its side
# What Pillow raises about damaged files of one kind or another.
_DAMAGE_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    OverflowError,
    EOFError,
    struct.error,
    zlib.error,
)


@dataclass(frozen=True)
class EncodedImage:
    """An encoded picture that is no file of its own, such as a message's; `name` is what errors
    call it."""

    name: str
    data: bytes
    suffix: str = ""

    def __str__(self) -> str:
        return self.name


def read_image(path: Path | EncodedImage) -> Image:
    """A picture as grey (H, W) or RGB (H, W, 3), uint8; alpha is dropped, 16 bits are scaled down
    to 8.

    Raises:
        UnreadableImageError: missing, empty, truncated, damaged, no picture, or of more than 100
            megapixels.
    """
    with _decode_image(path) as picture:
        if picture.mode in _GREY_MODES:
            return np.array(picture.convert("L"))
        if picture.mode in _GREY_16_MODES:
            return cv2.convertScaleAbs(np.array(picture).astype(np.uint16), alpha=1.0 / 257.0)
        if picture.mode == "F":
            raise UnreadableImageError(f"{path}: pixels of type float32, not of 8 or 16 bits")
        return np.array(picture.convert("RGB"))


def to_grey(image: Image) -> UInt8[np.ndarray, "h w"]:
    """The picture in grey, by the luma weights of Rec. 601; a grey one is returned as it is."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def read_depth(path: Path | EncodedImage, units_per_metre: float) -> Float32[np.ndarray, "h w"]:
    """A 16-bit depth picture in metres; NaN where unknown (0 and 65535 in the file).

    Raises:
        UnreadableImageError: as `read_image`, or not a picture of one channel of 16 bits.
    """
    with _decode_image(path) as picture:
        if picture.mode not in _GREY_16_MODES:
            raise UnreadableImageError(
                f"{path}: depth must be one channel of 16 bits, not pixels of {picture.mode}"
            )
        units = np.array(picture).astype(np.uint16)
    depth = units.astype(np.float32) / np.float32(units_per_metre)
    depth[(units == 0) | (units == 65535)] = np.nan
    return depth


def encode_jpeg(image: Image, quality: int) -> bytes:
    """The picture encoded; the same picture gives the same bytes."""
    bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def image_size(path: Path | EncodedImage) -> tuple[int, int]:
    """Width and height in pixels, from the header.

    Raises:
        UnreadableImageError: as `read_image`, but of what the header says alone.
    """
    with _open_image(path) as picture:
        width, height = picture.size
        return (
            (height, width)
            if picture.getexif().get(ExifTags.Base.Orientation) in _TRANSPOSED_ORIENTATIONS
            else (width, height)
        )


def exif_focal_length(path: Path | EncodedImage, width: int, height: int) -> float | None:
    """Focal length in pixels of a picture of this size, by its EXIF data; None where the file says
    nothing usable.

    The focal length equivalent on 35 mm film counts first (its diagonal stands for the picture's),
    then the one in millimetres with the resolution of the sensor (EXIF 2.32, JEITA CP-3451).
    """
    try:
        with _open_image(path) as picture:
            found = picture.getexif().get_ifd(ExifTags.IFD.Exif)
            tags = {tag: _exif_number(found.get(tag)) for tag in ExifTags.Base}
    except (UnreadableImageError, *_DAMAGE_ERRORS):
        return None
    focal = tags[ExifTags.Base.FocalLengthIn35mmFilm] * math.hypot(width, height) / _DIAGONAL_35MM
    if not focal > 0.0:
        mm_a_unit = _MM_PER_UNIT.get(int(tags[ExifTags.Base.FocalPlaneResolutionUnit]), 25.4)
        exif_width = tags[ExifTags.Base.ExifImageWidth]
        scale = (
            max(width, height) / exif_width if exif_width > 0.0 else 1.0
        )  # the width as taken, before it was turned
        focal = (
            tags[ExifTags.Base.FocalLength]
            * tags[ExifTags.Base.FocalPlaneXResolution]
            / mm_a_unit
            * scale
        )
    side = max(width, height)
    return focal if 0.1 * side < focal < 50.0 * side else None


def _exif_number(value: Any) -> float:
    """Of an EXIF tag; 0 where it is none that makes sense."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return 0.0
    return number if math.isfinite(number) else 0.0


def _read_bytes(path: Path | EncodedImage) -> bytes:
    try:
        if isinstance(path, EncodedImage):
            return path.data
        if (
            not stat.S_ISREG(path.stat().st_mode) and not path.is_dir()
        ):  # a FIFO would be waited for
            raise UnreadableImageError(f"{path}: not a file")
        data = path.read_bytes()
    except FileNotFoundError:
        raise UnreadableImageError(f"{path}: no such picture") from None
    except OSError as error:
        raise UnreadableImageError(f"{path}: {error.strerror}") from None
    except ValueError:  # a name with a NUL in it
        raise UnreadableImageError(f"{str(path)!r}: not the name of a file") from None
    if not data:
        raise UnreadableImageError(f"{path}: the file is empty")
    return data


@contextmanager
def _open_image(path: Path | EncodedImage) -> Iterator[ImageFile.ImageFile]:
    """The picture with its header read. What the body raises of a damaged file comes as
    UnreadableImageError, too."""
    data = _read_bytes(path)
    try:
        types = _supported_types(path)
        picture = Pillow.open(io.BytesIO(data), formats=types)
        if picture.format == "PNG":  # its checksums are not looked at otherwise
            picture.verify()
            picture = Pillow.open(io.BytesIO(data), formats=types)
    except Pillow.UnidentifiedImageError:
        raise UnreadableImageError(f"{path}: {_unreadable_reason(data)}") from None
    except Pillow.DecompressionBombError:
        raise UnreadableImageError(
            f"{path}: more than {MAX_PIXELS // 1_000_000} megapixels"
        ) from None
    except _DAMAGE_ERRORS as error:
        raise UnreadableImageError(
            f"{path}: not a picture, or damaged ({_one_line(error)})"
        ) from None
    with picture:
        width, height = picture.size
        if width * height > MAX_PIXELS:
            raise UnreadableImageError(
                f"{path}: {width}x{height} is more than {MAX_PIXELS // 1_000_000} megapixels"
            )
        try:
            yield picture
        except _DAMAGE_ERRORS as error:
            raise UnreadableImageError(f"{path}: damaged picture ({_one_line(error)})") from None


@contextmanager
def _decode_image(path: Path | EncodedImage) -> Iterator[Pillow.Image]:
    with _open_image(path) as picture:
        picture.load()
        if picture.mode == "P" or picture.getexif().get(ExifTags.Base.Orientation, 1) != 1:
            upright = ImageOps.exif_transpose(picture)
            yield upright.convert("RGB") if upright.mode == "P" else upright
        else:
            yield picture


def _supported_types(path: Path | EncodedImage) -> tuple[str, ...]:
    """What is tried; HEIF only where the name says so, for its decoder is an extra."""
    if path.suffix.lower() not in (".heic", ".heif"):
        return _IMAGE_TYPES
    try:
        import pi_heif  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise UnreadableImageError(
            f"{path}: HEIC pictures need the extra heic: pip install 'topoloc[heic]'"
        ) from None
    pi_heif.register_heif_opener()
    return (*_IMAGE_TYPES, "HEIF")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _unreadable_reason(data: bytes) -> str:
    starts = {
        b"\x89PNG": "PNG",
        b"\xff\xd8": "JPEG",
        b"BM": "BMP",
        b"RIFF": "WebP",
        b"II*\0": "TIFF",
        b"MM\0*": "TIFF",
    }
    known = next((name for start, name in starts.items() if data.startswith(start)), None)
    if known is not None:
        return f"damaged or truncated {known} file"
    return "not a picture, or not of a known type (PNG, JPEG, BMP, PNM, TIFF, WebP, HEIC)"
