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

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt8

from topoloc.compiled import num_threads as default_num_threads, parallel_for_rows
from topoloc.features.features import Features
from topoloc.features.surf_descriptor_kernels import describe, orient, smooth_rows
from topoloc.features.surf_detector_kernels import detect_band, integral_image, split_columns

DESCRIPTOR_LENGTH = 64
MIN_FILTER_PX = 9  # this filter has a sigma of 1.2 pixels (Bay et al. 2008, 3.3)
FILTER_INCREMENT_PX = 6
SIGMA_PER_FILTER_PX = 1.2 / MIN_FILTER_PX
PATCH_SAMPLES = 21
# Sample spacings in pixels for which smoothed images are made, from the smallest key points on.
LEVEL_RATIO = 1.2
LEVEL_SPACINGS = 1.4 * LEVEL_RATIO ** np.arange(33)


def extract_surf(
    image: UInt8[np.ndarray, "h w"],
    hessian_threshold: float = 400.0,
    max_features: int = 2000,
    num_threads: int | None = None,
) -> Features:
    """Return the strongest SURF key points of a grey image, strongest first, with descriptors (n,
    64) of unit length. The result is the same for any number of threads.

    Args:
        hessian_threshold: threshold of the Hessian's determinant for images of 0..255, as in
            OpenCV.
        max_features: number of features to keep.
        num_threads: default: the number of `set_num_threads`.
    """
    integral = integral_image(np.ascontiguousarray(image))
    num_parts = num_threads or default_num_threads()
    found = _detect(integral, hessian_threshold, num_parts)
    found = found[np.argsort(-found[:, 3], kind="stable")[:max_features]]
    if len(found) == 0:
        return Features.empty(DESCRIPTOR_LENGTH)
    points, sizes = np.ascontiguousarray(found[:, :2]), found[:, 2].copy()
    scales = sizes * np.float32(SIGMA_PER_FILTER_PX)
    angles, descriptors = _describe(integral, points, scales, num_parts)
    return Features(points, sizes, angles, found[:, 3].copy(), descriptors)


def _filter_edges(octave: int) -> Int64[np.ndarray, "layers 10"]:
    """Return the edges (pixels) of the lobes of a 9x9 second-derivative pattern scaled to the
    filters of an octave: three layers in which maxima are searched, one below and one above."""
    sizes = (MIN_FILTER_PX + FILTER_INCREMENT_PX * np.arange(5)) << octave
    edges = np.outer((sizes / MIN_FILTER_PX).astype(np.float32), np.arange(10, dtype=np.float32))
    return np.rint(edges).astype(np.int64)


def _detect(
    integral: Int32[np.ndarray, "h1 w1"], hessian_threshold: float, num_parts: int
) -> Float32[np.ndarray, "m 4"]:
    """Return the maxima of the Hessian's determinant: rows x, y, size, response."""
    num_octaves = 4  # octaves of filters, each twice as large as the one before
    height, width = integral.shape[0] - 1, integral.shape[1] - 1
    # A maximum needs filters below and above its own. An octave whose third filter does not fit
    # into the image has none.
    octaves = {
        octave: edges
        for octave in range(num_octaves)
        if (edges := _filter_edges(octave))[2, -1] < min(height, width)
    }
    if not octaves:
        return np.zeros((0, 4), np.float32)

    def detect_part(part: int, _: int) -> None:
        for octave, edges in octaves.items():
            step, size = 1 << octave, int(edges[-1, -1])
            first, last = _part_bounds(height // step, part, num_parts)
            columns, top, rows = edges, 0, integral
            if step > 1:
                top = max((first - 1) * step - size, 0)
                bottom = min(last * step + size + step, height + 1)
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
        splits = (
            (part_rows + 3 * (1 << octave) + 2 * int(edges[-1, -1])) * split_width(1 << octave)
            for octave, edges in octaves.items()
            if octave > 0
        )
        return max(splits, default=0)

    threshold = np.float32(hessian_threshold)
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
    num_parts: int,
) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, "n 64"]]:
    """Return angles in radians and descriptors of key points at these scales (sigma, pixels)."""
    angles = np.zeros(len(points), np.float32)
    descriptors = np.empty((len(points), DESCRIPTOR_LENGTH), np.float32)
    # OpenCV averages over a whole number of pixels a side
    spacings = (np.floor(PATCH_SAMPLES * scales) / PATCH_SAMPLES).astype(np.float32)
    level_idx = np.searchsorted(LEVEL_SPACINGS[:-1] * np.sqrt(LEVEL_RATIO), spacings)
    used = np.unique(level_idx).tolist()
    levels = {k: _empty_level(integral, float(LEVEL_SPACINGS[k])) for k in used}

    def prepare_part(part: int, _: int) -> None:
        for level in levels.values():
            first, last = _part_bounds(len(level.pixels), part, num_parts)
            smooth_rows(integral, level.box, level.share, level.step, level.pixels, first, last)
        orient(integral, points, scales, _select_part(rows_by_y, part, num_parts), angles)

    def describe_part(part: int, _: int) -> None:
        for k, level in levels.items():
            rows = _select_part(rows_by_y[level_idx[rows_by_y] == k], part, num_parts)
            given = points, spacings, angles, rows, descriptors
            describe(level.pixels, level.offset, level.step, *given)

    # From the top of the image down, so that the reads of a thread stay in its core's cache.
    rows_by_y = np.argsort(points[:, 1], kind="stable")
    parallel_for_rows(prepare_part, num_parts, num_parts)
    parallel_for_rows(describe_part, num_parts, num_parts)
    return angles, descriptors
