"""Extract SURF (speeded-up robust features) with an own implementation, without OpenCV's non-free
modules.

H. Bay, T. Tuytelaars, L. Van Gool, "SURF: Speeded Up Robust Features", ECCV 2006; with A. Ess, CVIU
110(3), 2008. Filter sizes, sampling, orientation window and order of descriptor components are
those of OpenCV's implementation. Key points have the same positions and sizes, and descriptors of
both implementations can be matched with each other.

Patents: the method (not any one implementation) was patented by its authors' employers, KU Leuven
and ETH Zurich, with Toyota Motor Europe. The patents are US 8,165,401, granted in 2012, and EP 2
027 558, of the international application WO 2007/128452 with a priority of 2006. Terms of twenty
years from filing end nominally in 2026 or 2027 and differ between countries. Whether a patent is
still in force in your country has not been checked here, and this is not legal advice. If this
matters, choose SIFT (`topoloc.features.sift`). Its patent, US 6,711,293, expired in March 2020.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt8

from topoloc.bounds import AtLeast, Between
from topoloc.compiled import num_threads
from topoloc.features.features import Features
from topoloc.features.parallel import parallel_for_rows
from topoloc.features.surf_descriptor_kernels import describe, orient, smooth_rows
from topoloc.features.surf_detector_kernels import detect_band, integral_image, split_columns

DESCRIPTOR_LENGTH = 64
MIN_FILTER_PX = 9  # this filter has a sigma of 1.2 pixels (Bay et al. 2008, 3.3)
FILTER_INCREMENT_PX = 6
SIGMA_PER_FILTER_PX = 1.2 / MIN_FILTER_PX
PATCH_SAMPLES = 21
# 32-bit sums hold a filter response up to this side (whole box 1 by 5/9 of it, values of 255).
MAX_FILTER_PX = 3600
# Sample spacings in pixels for which smoothed images are made, from the smallest key points on.
LEVEL_RATIO = 1.2
LEVEL_SPACINGS = 1.4 * LEVEL_RATIO ** np.arange(33)


@dataclass(frozen=True)
class SurfConfig:
    """Hold the settings of SURF."""

    hessian_threshold: Annotated[float, AtLeast(0)] = 400.0
    """Threshold of the Hessian's determinant for images of 0..255, as in OpenCV."""
    num_octaves: Annotated[int, Between(1, 8)] = 4
    """Octaves of filters, each twice as large as the one before."""
    num_layers: Annotated[int, Between(1, 64)] = 3
    """Layers of each octave in which maxima are detected."""
    upright: bool = False
    """Set all orientations to 0, for cameras that never roll."""
    max_features: Annotated[int, Between(0, 100_000)] = 2000
    """Number of features to keep, strongest first."""
    num_threads: Annotated[int | None, Between(1, 1024)] = None
    """Threads. The features are the same for any number. Unset: the number of `set_num_threads`."""

    def __post_init__(self) -> None:
        counts = (
            self.num_octaves,
            self.num_layers,
            1 if self.num_threads is None else self.num_threads,
        )
        if self.hessian_threshold < 0 or min(counts) < 1 or self.max_features < 0:
            raise ValueError(
                "SURF: threshold and max_features must be at least 0, the other numbers at least"
                f" 1: {self}"
            )
        if (MIN_FILTER_PX + FILTER_INCREMENT_PX * (self.num_layers + 1)) << (
            self.num_octaves - 1
        ) > MAX_FILTER_PX:
            raise ValueError(
                f"SURF: filters beyond {MAX_FILTER_PX} px, fewer octaves or layers are needed:"
                f" {self}"
            )


def extract_surf(image: UInt8[np.ndarray, "h w"], config: SurfConfig = SurfConfig()) -> Features:
    """Return the strongest SURF key points of a grey image, strongest first, with descriptors (n,
    64) of unit length.

    Upright key points have angle 0. As in OpenCV, their windows are sampled turned by 270 degrees.
    The result is the same for any number of threads.
    """
    integral = integral_image(np.ascontiguousarray(image))
    found = _detect(integral, config)
    found = found[np.argsort(-found[:, 3], kind="stable")[: config.max_features]]
    if len(found) == 0:
        return Features.empty(DESCRIPTOR_LENGTH)
    points, sizes = np.ascontiguousarray(found[:, :2]), found[:, 2].copy()
    angles, descriptors = _describe(
        integral, points, sizes * np.float32(SIGMA_PER_FILTER_PX), config
    )
    return Features(points, sizes, angles, found[:, 3].copy(), descriptors)


def _filter_sizes(octave: int, num_layers: int) -> Int64[np.ndarray, " layers"]:
    """Return the filter sizes of an octave in pixels. They include one layer below and one above
    the layers in which maxima are searched."""
    return (MIN_FILTER_PX + FILTER_INCREMENT_PX * np.arange(num_layers + 2)) << octave


def _pattern_edges(sizes: Int64[np.ndarray, " layers"]) -> Int64[np.ndarray, "layers 10"]:
    """Return the edges of the lobes of a 9x9 second-derivative pattern scaled to each size, in
    pixels."""
    return np.rint(
        np.outer((sizes / MIN_FILTER_PX).astype(np.float32), np.arange(10, dtype=np.float32))
    ).astype(np.int64)


def _detect(integral: Int32[np.ndarray, "h1 w1"], config: SurfConfig) -> Float32[np.ndarray, "m 4"]:
    """Return the maxima of the Hessian's determinant: rows x, y, size, response."""
    height, width = integral.shape[0] - 1, integral.shape[1] - 1

    # A maximum needs filters below and above its own. An octave whose third filter does not fit
    # into the image has none.
    sizes = {
        octave: _filter_sizes(octave, config.num_layers) for octave in range(config.num_octaves)
    }
    octaves = {
        octave: _pattern_edges(s) for octave, s in sizes.items() if s[2] < min(height, width)
    }
    if not octaves:
        return np.zeros((0, 4), np.float32)

    def detect_part(part: int, _: int) -> None:
        for octave, edges in octaves.items():
            step, size = 1 << octave, int(edges[-1, -1])
            first, last = _part_bounds(height // step, part, num_parts)
            columns, top, rows = edges, 0, integral
            if step > 1:
                top, bottom = (
                    max((first - 1) * step - size, 0),
                    min(last * step + size + step, height + 1),
                )
                rows = scratch[part][: (bottom - top) * split_width(step)].reshape(bottom - top, -1)
                split_columns(integral, step, top, rows)
                columns = edges % step * (split_width(step) // step) + edges // step
            found[octave, part] = detect_band(
                rows, top, height, width, edges, columns, step, first, last, threshold
            )

    def split_width(step: int) -> int:
        return -(-(width + 1) // step) * step

    def largest_split(part_rows: int) -> int:
        """Return the size of the largest band of reordered sums over all octaves but the first."""
        return max(
            (
                (part_rows + 3 * (1 << o) + 2 * int(e[-1, -1])) * split_width(1 << o)
                for o, e in octaves.items()
                if o > 0
            ),
            default=0,
        )

    num_parts, threshold = config.num_threads or num_threads(), np.float32(config.hessian_threshold)
    # Allocated here, not in the threads: the allocator returns the memory of a worker thread to the
    # system after each call.
    scratch = np.empty((num_parts, largest_split(-(-height // num_parts))), np.int32)
    found: dict[tuple[int, int], Float32[np.ndarray, "m 4"]] = {}
    parallel_for_rows(detect_part, num_parts, num_parts)
    # Sorted by octave, then row: so the order of equal responses does not depend on the number of
    # parts.
    return np.concatenate([found[key] for key in sorted(found)])


def _part_bounds(num_rows: int, part: int, num_parts: int) -> tuple[int, int]:
    """Return the first row of a part and the row after its last one."""
    return num_rows * part // num_parts, num_rows * (part + 1) // num_parts


def _select_part(
    rows: Int64[np.ndarray, " n"], part: int, num_parts: int
) -> Int64[np.ndarray, " m"]:
    first, last = _part_bounds(len(rows), part, num_parts)
    return rows[first:last]


@dataclass(frozen=True)
class _Level:
    """Hold a smoothed image of every step-th pixel. Its pixel (0, 0) is at (offset, offset) of the
    image. `share` is that of `smooth_rows`."""

    pixels: Float32[np.ndarray, "lh lw"]
    step: int
    box: int
    share: float

    @property
    def offset(self) -> float:
        return (self.box + 1) / 2


def _empty_level(integral: Int32[np.ndarray, "h1 w1"], spacing: float) -> _Level:
    """Return an empty level. Once filled and read bilinearly, it is as smooth as the image averaged
    over windows of `spacing` pixels.

    Bilinear reads have a mean variance of step^2 / 6, on top of a box's (side^2 - 1) / 12. OpenCV
    reads the image bilinearly, then averages. This has a variance of (spacing^2 + 1) / 12 + 1 / 6.
    """
    step = 1 << max(int(np.log2(spacing / 2.2)), 0)
    side = float(np.sqrt(spacing**2 + 4 - 2 * step**2))
    box = int(side)
    height, width = ((size - 1 - (box + 2)) // step + 1 for size in integral.shape)
    share = ((box + 2) ** 2 - side**2) / ((box + 2) ** 2 - box**2)
    return _Level(np.empty((height, width), np.float32), step, box, share)


def _describe(
    integral: Int32[np.ndarray, "h1 w1"],
    points: Float32[np.ndarray, "n 2"],
    scales: Float32[np.ndarray, " n"],
    config: SurfConfig,
) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, "n 64"]]:
    """Return angles in radians and descriptors of key points at these scales (sigma, pixels)."""
    num_parts = config.num_threads or num_threads()
    angles = np.zeros(len(points), np.float32)
    descriptors = np.empty((len(points), DESCRIPTOR_LENGTH), np.float32)
    # OpenCV averages over a whole number of pixels a side
    spacings = (np.floor(PATCH_SAMPLES * scales) / PATCH_SAMPLES).astype(np.float32)
    level_idx = np.searchsorted(LEVEL_SPACINGS[:-1] * np.sqrt(LEVEL_RATIO), spacings)
    levels = {
        int(k): _empty_level(integral, float(LEVEL_SPACINGS[k])) for k in np.unique(level_idx)
    }

    def prepare_part(part: int, _: int) -> None:
        for level in levels.values():
            first, last = _part_bounds(len(level.pixels), part, num_parts)
            smooth_rows(integral, level.box, level.share, level.step, level.pixels, first, last)
        if not config.upright:
            orient(integral, points, scales, _select_part(rows_by_y, part, num_parts), angles)

    def describe_part(part: int, _: int) -> None:
        for k, level in levels.items():
            rows = _select_part(rows_by_y[level_idx[rows_by_y] == k], part, num_parts)
            describe(
                level.pixels,
                level.offset,
                level.step,
                points,
                spacings,
                directions,
                rows,
                descriptors,
            )

    # From the top of the image down, so that the reads of a thread stay in its core's cache.
    rows_by_y = np.argsort(points[:, 1], kind="stable")
    parallel_for_rows(prepare_part, num_parts, num_parts)
    directions = np.full_like(angles, 1.5 * np.pi) if config.upright else angles
    parallel_for_rows(describe_part, num_parts, num_parts)
    return angles, descriptors
