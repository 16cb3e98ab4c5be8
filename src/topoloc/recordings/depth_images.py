"""Read depth images in metres: 16-bit images, OpenEXR (Record3D) or NumPy arrays."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from topoloc.errors import MissingExtraError, RecordingError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.recordings.image_io import MAX_PIXELS, read_depth

MIN_MEDIAN_DEPTH, MAX_MEDIAN_DEPTH = 0.05, 100.0
"""Limits of the median depth of an image, in metres. A median outside of them indicates a wrong
unit."""
_TYPICAL_MEDIAN_DEPTH = (
    2.5  # metres; the most likely unit is the power of ten that brings the median nearest to this
)
_SAMPLE_STEP = 8  # pixels


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
            depth = np.where(
                np.isfinite(units) & (units > 0.0), units / units_per_metre, np.nan
            ).astype(np.float32)
    else:
        depth = read_depth(path, units_per_metre)
    if problem := find_depth_problem(depth):
        raise RecordingError(f"{path}: {problem}")
    return depth


def find_depth_problem(depth: Float32[np.ndarray, "h w"]) -> str | None:
    """Describe the problem if the median depth is implausible, with the likely factor. Return None
    otherwise."""
    sample = depth[::_SAMPLE_STEP, ::_SAMPLE_STEP]
    known = sample[np.isfinite(sample)]
    if len(known) == 0:
        return None
    median = float(np.median(known))
    if MIN_MEDIAN_DEPTH <= median <= MAX_MEDIAN_DEPTH:
        return None
    factor = 10.0 ** round(np.log10(max(median, 1e-30) / _TYPICAL_MEDIAN_DEPTH))
    by = (
        f"{factor:g} times the depth_factor"
        if factor > 1.0
        else f"the depth_factor divided by {1.0 / factor:g}"
    )
    return (
        f"a median depth of {median:.4g} m is that of no camera; {by} is likely right (depth arrays"
        " are in metres)"
    )


def resize_depth(
    path: Path, depth: Float32[np.ndarray, "h w"], camera: Camera
) -> Float32[np.ndarray, "h2 w2"]:
    """Resize a depth image to the image of `camera`. Pixels beside unknown depth become unknown.

    Raises:
        UnreadableImageError: its aspect ratio differs from the image's.
    """
    height, width = depth.shape
    if (width, height) == (camera.width, camera.height):
        return depth
    if abs(width * camera.height - height * camera.width) > max(
        camera.width, camera.height
    ):  # more than the rounding of a pixel
        raise UnreadableImageError(
            f"{path}: depth of {width}x{height} is not of the shape of its"
            f" {camera.width}x{camera.height} picture"
        )
    return cv2.resize(depth, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)


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
        OpenEXR: Any = importlib.import_module("OpenEXR")
    if not path.is_file():
        raise UnreadableImageError(f"{path}: no such file")
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            low, high = file.header()["dataWindow"]
            width, height = int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1
        if not 0 < width * height <= MAX_PIXELS:
            raise UnreadableImageError(
                f"{path}: {width}x{height} is more than {MAX_PIXELS // 1_000_000} megapixels"
            )
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            name = next(name for name in ("R", "Y", "Z", *channels) if name in channels)
            return np.array(channels[name].pixels, dtype=np.float64)
    except UnreadableImageError:
        raise
    except (
        Exception
    ) as error:  # the binding raises RuntimeError, TypeError, ValueError and its own errors
        raise UnreadableImageError(
            f"{path}: damaged picture ({' '.join(str(error).split())[:80]})"
        ) from None
