"""Read image files, and depth images in metres (16-bit, OpenEXR or NumPy arrays).

The header is checked, then the file is decoded once with Pillow and converted to grey or RGB.
Size and type are checked before decoding, so that a small file cannot fill the memory. Truncated
files are errors, so that no image is half grey. Images are rotated by their EXIF orientation. Their
size is the size after rotation.
"""

from __future__ import annotations

import io
import stat
import struct
import warnings
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt16
from PIL import (  # importing the readers registers them in Pillow
    BmpImagePlugin,  # noqa: F401
    ExifTags,
    Image as Pillow,
    ImageFile,
    ImageOps,
    JpegImagePlugin,  # noqa: F401
    PngImagePlugin,  # noqa: F401
    PpmImagePlugin,  # noqa: F401
    TiffImagePlugin,  # noqa: F401
    WebPImagePlugin,  # noqa: F401
)

from topoloc.errors import MissingExtraError, RecordingError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import DepthImage, Image, find_depth_problem
from topoloc.recordings.image_files import find_path, unknown_pixels_reason, unreadable_reason

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp", ".heic", ".heif"}
)
MAX_PIXELS = 100_000_000
_IMAGE_TYPES = ("PNG", "JPEG", "BMP", "PPM", "TIFF", "WEBP")
# Pillow warns of odd metadata and of large images. `MAX_PIXELS` is the limit here.
warnings.filterwarnings("ignore", module=r"PIL\.")
_GREY_MODES, _GREY_16_MODES = ("L", "1"), ("I;16", "I;16L", "I;16B", "I")
_TRANSPOSED_ORIENTATIONS = (5, 6, 7, 8)  # EXIF orientations that swap width and height
# errors that Pillow raises for damaged files
DAMAGE_ERRORS = (
    *(OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError, OverflowError),
    *(EOFError, struct.error, zlib.error),
)


@dataclass(frozen=True)
class EncodedImage:
    """Hold an encoded image that is not a file, such as the image of a message. Errors refer to it
    by `name`."""

    name: str
    data: bytes
    suffix: str = ""

    def __str__(self) -> str:
        return self.name


def read_image(
    path: str | Path | EncodedImage,
    as_stored: bool = False,
    white: int | None = None,
    max_pixels: int = MAX_PIXELS,
    max_size: tuple[int, int] | None = None,
) -> Image:
    """Read an image as grey (H, W) or RGB (H, W, 3), uint8. Alpha is dropped. `as_stored` ignores
    the EXIF orientation. 16 bits are scaled to 8, so that `white` becomes 255. By default it is
    that of `find_white_level`. An image of 8 bits and more than `max_pixels` is reduced by 2, 4
    or 8.

    Raises:
        UnreadableImageError: the file is missing, empty, truncated, damaged, not an image, or
            larger than 100 megapixels or than `max_size` (width, height).
    """
    with open_image(path) as picture:
        width, height = picture.size
        if max_size and (width > max_size[0] or height > max_size[1]):
            most = f"{max_size[0]}x{max_size[1]}"
            raise UnreadableImageError(f"{path} is {width}x{height}, more than {most}")
        if picture.format == "WEBP" and (as_stored or _orientation(picture) == 1):
            return _decode_webp(path, _reduction(picture, max_pixels))
    with _decode_image(path, as_stored, max_pixels) as picture:
        if picture.mode in _GREY_MODES:
            return np.array(picture.convert("L"))
        if picture.mode in _GREY_16_MODES:
            values = np.array(picture).astype(np.uint16)
            return cv2.convertScaleAbs(values, alpha=255.0 / (white or _white_level(values)))
        if picture.mode == "F":
            raise UnreadableImageError(f"{path}: {unknown_pixels_reason('32-bit floats')}")
        return np.array(picture if picture.mode == "RGB" else picture.convert("RGB"))


def _decode_webp(path: str | Path | EncodedImage, factor: int) -> Image:
    """Decode a WebP image with OpenCV, which takes a third of Pillow's memory."""
    flags = {1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4}
    flag = flags.get(factor, cv2.IMREAD_REDUCED_COLOR_8) | cv2.IMREAD_IGNORE_ORIENTATION
    bgr = cv2.imdecode(np.frombuffer(_read_bytes(path), np.uint8), flag)
    if bgr is None:
        raise UnreadableImageError(f"{path}: damaged or truncated WebP file")
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB, dst=bgr)


def find_white_level(paths: Iterable[Path | EncodedImage]) -> int:
    """Return the largest value of a camera of 10, 12, 14 or 16 bits whose 16-bit images these are.

    Images that cannot be read are skipped.
    """
    white = 0
    for path in paths:
        with suppress(UnreadableImageError), open_image(path) as picture:
            if picture.mode not in _GREY_16_MODES:
                break
            white = max(white, _white_level(np.array(picture).astype(np.uint16)))
    return white or 65535


def _white_level(values: UInt16[np.ndarray, "h w"]) -> int:
    return next(white for white in (1023, 4095, 16383, 65535) if values.max(initial=0) <= white)


def read_depth(
    path: str | Path | EncodedImage, units_per_metre: float
) -> Float32[np.ndarray, "h w"]:
    """Read a depth image of 16 or 32 bits, or of floats (TIFF), in metres. Unknown depth is NaN (0
    in the file, and 65535 of 16 bits).

    Raises:
        UnreadableImageError: as `read_image`, or the image is not one such channel.
    """
    with _decode_image(path) as picture:
        if picture.mode not in (*_GREY_16_MODES, "F"):
            raise UnreadableImageError(
                f"{path}: depth must be one channel of 16 bits, not pixels of {picture.mode}"
            )
        units = np.array(picture).astype(np.float32 if picture.mode == "F" else np.int32)
    return _to_metres(units, units_per_metre)


def _to_metres(units: np.ndarray, units_per_metre: float) -> Float32[np.ndarray, "h w"]:
    """Return depth in metres, NaN if unknown. The largest number of 16 bits means unknown, or that
    of more bits if they hold larger ones."""
    is_known = np.isfinite(units) & (units > 0)
    if units.dtype.kind != "f":
        is_known &= units != (65535 if units.max(initial=0) <= 65535 else np.iinfo(units.dtype).max)
    with np.errstate(over="ignore", invalid="ignore"):
        metres = units.astype(np.float32) / np.float32(units_per_metre)
    metres[~is_known] = np.nan
    return metres


def image_size(path: Path | EncodedImage, as_stored: bool = False) -> tuple[int, int]:
    """Read width and height in pixels from the header, after EXIF rotation unless `as_stored`.

    Raises:
        UnreadableImageError: as `read_image`, as far as the header shows it.
    """
    with open_image(path) as picture:
        width, height = picture.size
        is_turned = _orientation(picture) in _TRANSPOSED_ORIENTATIONS
        return (height, width) if is_turned and not as_stored else (width, height)


def _read_bytes(path: str | Path | EncodedImage) -> bytes:
    try:
        if isinstance(path, EncodedImage):
            return path.data
        path = find_path(Path(path))
        # Reading a FIFO would block.
        if not stat.S_ISREG(path.stat().st_mode) and not path.is_dir():
            raise UnreadableImageError(f"{path}: not a file")
        data = path.read_bytes()
    except FileNotFoundError:
        raise UnreadableImageError(f"{path}: no such picture") from None
    except OSError as error:
        raise UnreadableImageError(f"{path}: {error.strerror}") from None
    except ValueError:  # the name contains a NUL
        raise UnreadableImageError(f"{str(path)!r}: not the name of a file") from None
    if not data:
        raise UnreadableImageError(f"{path}: the file is empty")
    return data


@contextmanager
def open_image(path: str | Path | EncodedImage) -> Iterator[ImageFile.ImageFile]:
    """Yield the image with its header read. Errors of damaged files raised in the body become
    UnreadableImageError."""
    data = _read_bytes(path)
    try:
        types = _supported_types(path, data)
        picture = Pillow.open(io.BytesIO(data), formats=types)
        if picture.format == "PNG":  # its checksums are not verified otherwise
            picture.verify()
            picture = Pillow.open(io.BytesIO(data), formats=types)
    except Pillow.UnidentifiedImageError:
        raise UnreadableImageError(f"{path}: {unreadable_reason(data)}") from None
    except Pillow.DecompressionBombError:
        raise UnreadableImageError(
            f"{path}: more than {MAX_PIXELS // 1_000_000} megapixels"
        ) from None
    except DAMAGE_ERRORS as error:
        raise UnreadableImageError(
            f"{path}: not a picture, or damaged ({_one_line(error)})"
        ) from None
    with picture:
        width, height = picture.size
        most = f"{MAX_PIXELS // 1_000_000} megapixels" if width * height > MAX_PIXELS else ""
        most = most or ("30000 pixels on a side" if max(width, height) > 30_000 else "")
        if most:
            raise UnreadableImageError(f"{path}: {width}x{height} is more than {most}")
        try:
            yield picture
        except DAMAGE_ERRORS as error:
            raise UnreadableImageError(f"{path}: damaged picture ({_one_line(error)})") from None


@contextmanager
def _decode_image(
    path: str | Path | EncodedImage, as_stored: bool = False, max_pixels: int = MAX_PIXELS
) -> Iterator[Pillow.Image]:
    with open_image(path) as picture:
        factor = _reduction(picture, max_pixels)
        if factor > 1 and picture.format == "JPEG":  # reduced while it is decoded
            picture.draft(None, (picture.width // factor or 1, picture.height // factor or 1))
        picture.load()
        is_turned = _orientation(picture) != 1 and not as_stored
        decoded = ImageOps.exif_transpose(picture) if is_turned else picture
        decoded = decoded.convert("RGB") if decoded.mode == "P" else decoded
        is_reducible = decoded.mode not in (*_GREY_16_MODES, "1", "F")
        factor = _reduction(decoded, max_pixels) if is_reducible else 1
        yield decoded.reduce(factor) if factor > 1 else decoded


def _reduction(picture: Pillow.Image, max_pixels: int) -> int:
    """Return the factor, 1, 2, 4 or 8, that reduces an image to `max_pixels`."""
    return next((k for k in (1, 2, 4) if picture.width * picture.height <= max_pixels * k * k), 8)


def _orientation(picture: Pillow.Image) -> int:
    return picture.getexif().get(ExifTags.Base.Orientation, 1)


def _supported_types(path: str | Path | EncodedImage, data: bytes) -> tuple[str, ...]:
    """Return the types to try. HEIF is included only for its first bytes, because its decoder is an
    extra."""
    if data[4:8] != b"ftyp" or data[8:12] not in (b"heic", b"heix", b"heim", b"heis", b"mif1"):
        return _IMAGE_TYPES
    try:
        pi_heif = import_module("pi_heif")
    except ImportError:
        raise UnreadableImageError(
            f"{path}: HEIC pictures need the extra heic: pip install 'topoloc[heic]'"
        ) from None
    pi_heif.register_heif_opener()
    return (*_IMAGE_TYPES, "HEIF")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def read_depth_image(path: Path, units_per_metre: float) -> Float32[np.ndarray, "h w"]:
    """Read depth along z in metres. Unknown depth is NaN (0 in the file, and 65535 of 16 bits).

    Raises:
        UnreadableImageError: the file is missing, damaged, not a depth image, or too large.
        RecordingError: the median depth is implausible, so `units_per_metre` must be wrong.
        MissingExtraError: the file is EXR and the extra `exr` is not installed.
    """
    path, suffix = find_path(path), path.suffix.lower()
    if suffix in (".exr", ".npy"):
        units = _read_exr(path) if suffix == ".exr" else _read_npy(path)
        depth = _to_metres(units, units_per_metre)
    else:
        depth = read_depth(path, units_per_metre)
    if problem := find_depth_problem(depth):
        raise RecordingError(f"{path}: {problem}")
    return depth


def depth_image_of(
    path: Path | str,
    depth: Float32[np.ndarray, "h w"],
    camera: Camera,
    cam_from_depth: Rigid3 | None = None,
) -> DepthImage:
    """Return depth taken by `camera`, at any resolution of its aspect ratio.

    Raises:
        UnreadableImageError: the aspect ratio differs.
    """
    height, width = depth.shape
    if (width, height) != (camera.width, camera.height):
        rounding = max(camera.width, camera.height)  # of a pixel
        if abs(width * camera.height - height * camera.width) > rounding:
            raise UnreadableImageError(
                f"{path}: depth of {width}x{height} is not of the shape of its"
                f" {camera.width}x{camera.height} picture; crop the one that shows more"
            )
        camera = camera.rescaled(width, height)
    return DepthImage(depth, camera, cam_from_depth or Rigid3.identity())


def _read_npy(path: Path) -> np.ndarray:
    try:
        units = np.load(path, mmap_mode="r", allow_pickle=False)
        is_depth = (
            units.ndim in (2, 3)
            and units.size == units.shape[0] * units.shape[1] <= MAX_PIXELS
            and units.dtype.kind in "uif"
        )
    except (OSError, ValueError, EOFError, SyntaxError, TypeError, AttributeError) as error:
        raise UnreadableImageError(
            f"{path}: no array of depth ({' '.join(str(error).split())[:80]})"
        ) from None
    if not is_depth:
        raise UnreadableImageError(f"{path}: no array of depth, which is height x width numbers")
    return np.array(units).reshape(units.shape[:2])


def _read_exr(path: Path) -> np.ndarray:
    """Read the first channel of an EXR file. OpenCV's wheels lack OpenEXR, so this uses the OpenEXR
    package."""
    with MissingExtraError.on_import(f"{path}: depth in EXR files needs the extra exr", "exr"):
        openexr = import_module("OpenEXR")
    if not path.is_file():
        raise UnreadableImageError(f"{path}: no such file")
    try:
        with openexr.File(str(path), separate_channels=True, header_only=True) as file:
            low, high = file.header()["dataWindow"]
            width, height = int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1
        if not 0 < width * height <= MAX_PIXELS:
            raise UnreadableImageError(
                f"{path}: {width}x{height} is more than {MAX_PIXELS // 1_000_000} megapixels"
            )
        with openexr.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            name = next(name for name in ("R", "Y", "Z", *channels) if name in channels)
            return np.array(channels[name].pixels, dtype=np.float64)
    except UnreadableImageError:
        raise
    # The binding raises RuntimeError, TypeError, ValueError and its own errors.
    except Exception as error:
        raise UnreadableImageError(
            f"{path}: damaged picture ({' '.join(str(error).split())[:80]})"
        ) from None
