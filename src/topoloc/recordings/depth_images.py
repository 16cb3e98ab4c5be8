"""Read depth images in metres: 16-bit images, OpenEXR (Record3D) or NumPy arrays."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from topoloc.errors import MissingExtraError, RecordingError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import DepthImage, find_depth_problem
from topoloc.recordings.image_io import MAX_PIXELS, read_depth


def read_depth_image(path: Path, units_per_metre: float) -> Float32[np.ndarray, "h w"]:
    """Read depth along z in metres. Unknown depth is NaN (0 in the file, and 65535 of 16 bits).

    Raises:
        UnreadableImageError: the file is missing, damaged, not a depth image, or too large.
        RecordingError: the median depth is implausible, so `units_per_metre` must be wrong.
        MissingExtraError: the file is EXR and the extra `exr` is not installed.
    """
    suffix = path.suffix.lower()
    if suffix in (".exr", ".npy"):
        units = _read_exr(path) if suffix == ".exr" else _read_npy(path)
        with np.errstate(invalid="ignore", over="ignore"):
            is_known = np.isfinite(units) & (units > 0.0)
            depth = np.where(is_known, units / units_per_metre, np.nan).astype(np.float32)
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
    return np.array(units, dtype=np.float64).reshape(units.shape[:2])


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
