"""Hold dense descriptors of a network: one on every point of a grid, sampled between its points."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32

from topoloc.compiled import kernel
from topoloc.features.features import DenseDescriptors

_RADIUS = 4  # grid steps to each side in which the most similar descriptor is searched


class GridDescriptors(DenseDescriptors):
    """Hold one descriptor every `stride_px` pixels. The descriptor of pixel (x, y) lies at column
    (x + 0.5) / stride_px - 0.5, and rows likewise.

    A key point supports a pose only if it is detected again. In rain or at night most key points
    are not. Dense descriptors need no detection. If a pose is right, the most similar descriptor
    around a map point's projection lies at the projection itself.
    """

    @cached_property
    @abstractmethod
    def grid(self) -> Float32[np.ndarray, "rows columns d"]:
        """Return the whole grid with descriptors of unit length."""

    def check_agreement(
        self, points_img: Float[np.ndarray, "n 2"], descriptors: Float32[np.ndarray, "n d"]
    ) -> Bool[np.ndarray, " n"]:
        """Return for each point whether its best match lies at its projection.

        The most similar descriptor is searched within 4 grid steps to each side. It must lie at
        most one grid step from the point.
        """
        points_img, stride_px = points_img.astype(np.float32), np.float32(self.stride_px)
        return _is_local_best_match(self.grid, points_img, descriptors, stride_px, _RADIUS)


@dataclass(frozen=True, eq=False)
class SingleLevelDescriptors(GridDescriptors):
    """Hold the output of most networks: one plane per component, not of unit length."""

    planes: Float32[np.ndarray, "d rows columns"]
    stride_px: float

    @property
    def size(self) -> int:
        """Return the length of a descriptor."""
        return self.planes.shape[0]

    def sample(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
        """Return descriptors of unit length at these pixels, interpolated bilinearly."""
        return _sample_descriptors(self.planes, points_img, np.float32(self.stride_px))

    @cached_property
    def grid(self) -> Float32[np.ndarray, "rows columns d"]:
        """Return the whole grid with descriptors of unit length."""
        return _normalize_descriptors(self.planes)


@dataclass(frozen=True, eq=False)
class TwoLevelDescriptors(GridDescriptors):
    """Hold two levels whose sum is the descriptors: `coarse`, enlarged bilinearly to twice its rows
    and columns, and `fine` times `weights`.

    Both operations are linear, and few descriptors of the grid are sampled. So the sum is computed
    only at the sampled points.
    """

    coarse: Float32[np.ndarray, "half_rows half_columns d"]
    fine: Float32[np.ndarray, "rows columns k"]
    weights: Float32[np.ndarray, "k d"]
    stride_px: float

    @property
    def size(self) -> int:
        """Return the length of a descriptor."""
        return self.coarse.shape[2]

    def sample(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
        """Return descriptors of unit length at these pixels, interpolated bilinearly."""
        levels = self.coarse, self.fine, self.weights
        return _sample_levels(*levels, points_img, np.float32(self.stride_px))

    @cached_property
    def grid(self) -> Float32[np.ndarray, "rows columns d"]:
        """Return the whole grid with descriptors of unit length."""
        return _combine_levels(self.coarse, self.fine, self.weights)


@kernel()
def _grid_position(pixel, stride, length):
    """Return the grid index before a pixel and the fraction to the next one. Pixel x lies at (x +
    0.5) / stride - 0.5 in a grid of this length."""
    at = max((pixel + np.float32(0.5)) / stride - np.float32(0.5), np.float32(0))
    at = min(at, np.float32(length - 1))
    index = min(int(at), length - 2)
    return index, np.float32(at - index)


@kernel()
def _sample_descriptors(dense, points_img, stride):
    """Return (n, d) descriptors of unit length, interpolated bilinearly."""
    size, rows, columns = dense.shape
    out = np.empty((len(points_img), size), np.float32)
    for k in range(len(points_img)):
        x, s = _grid_position(points_img[k, 0], stride, columns)
        y, t = _grid_position(points_img[k, 1], stride, rows)
        total = np.float32(0)
        for c in range(size):
            grid = dense[c]
            above = (1 - s) * grid[y, x] + s * grid[y, x + 1]
            below = (1 - s) * grid[y + 1, x] + s * grid[y + 1, x + 1]
            value = np.float32((1 - t) * above + t * below)
            out[k, c] = value
            total += value * value
        scale = np.float32(1) / max(np.sqrt(total), np.float32(1e-6))
        for c in range(size):
            out[k, c] *= scale
    return out


@kernel()
def _normalize_descriptors(planes):
    """Return (rows, columns, d) descriptors of unit length from (d, rows, columns) planes."""
    size, rows, columns = planes.shape
    grid = np.empty((rows, columns, size), np.float32)
    for y in range(rows):
        for x in range(columns):
            total = np.float32(1e-12)
            for c in range(size):
                value = planes[c, y, x]
                grid[y, x, c] = value
                total += value * value
            scale = np.float32(1) / np.sqrt(total)
            for c in range(size):
                grid[y, x, c] *= scale
    return grid


@kernel(fastmath={"contract"})
def _sample_levels(coarse, fine, weights, points_img, stride):
    """Sample the sum of two levels (`TwoLevelDescriptors`) like `_sample_descriptors`.
    `stride` is that of the finer grid."""
    rows, columns, size = fine.shape[0], fine.shape[1], coarse.shape[2]
    out, mixed = np.empty((len(points_img), size), np.float32), np.empty(fine.shape[2], np.float32)
    for k in range(len(points_img)):
        x, s = _grid_position(points_img[k, 0], stride, columns)
        y, t = _grid_position(points_img[k, 1], stride, rows)
        value = out[k]
        value[:], mixed[:] = np.float32(0), np.float32(0)
        for below in range(2):
            for right in range(2):
                share = (t if below else 1 - t) * (s if right else 1 - s)
                _add_coarse_level(coarse, y + below, x + right, share, value)
                for i in range(len(mixed)):
                    mixed[i] += share * fine[y + below, x + right, i]
        for i in range(0, len(mixed), 4):
            a, b, c, d = weights[i], weights[i + 1], weights[i + 2], weights[i + 3]
            for j in range(size):
                value[j] += (
                    mixed[i] * a[j]
                    + mixed[i + 1] * b[j]
                    + mixed[i + 2] * c[j]
                    + mixed[i + 3] * d[j]
                )
        total = np.float32(1e-12)
        for j in range(size):
            total += value[j] * value[j]
        scale = np.float32(1) / np.sqrt(total)
        for j in range(size):
            value[j] *= scale
    return out


@kernel(fastmath={"contract", "reassoc"})
def _combine_levels(coarse, fine, weights):
    """Return (rows, columns, d) descriptors of unit length: the sum of two levels
    (`TwoLevelDescriptors`). The number of columns and k must be multiples of four."""
    rows, columns, size = fine.shape[0], fine.shape[1], coarse.shape[2]
    grid = np.empty((rows, columns, size), np.float32)
    blend, sums = np.empty((coarse.shape[1] + 2, size), np.float32), np.empty(4 * size, np.float32)
    by_four = weights.copy().reshape(weights.shape[0] // 4, 4 * size)
    for y in range(rows):
        _blend_rows(coarse, y, blend)
        # Four columns at a time, so that the weights are read a quarter as often.
        for x in range(0, columns, 4):
            for half in range(2):
                at = x // 2 + half
                before, here, after = blend[at], blend[at + 1], blend[at + 2]
                for j in range(size):
                    most = np.float32(0.75) * here[j]
                    sums[2 * half * size + j] = most + np.float32(0.25) * before[j]
                    sums[2 * half * size + size + j] = most + np.float32(0.25) * after[j]
            _add_fine_level(fine[y], x, by_four, size, sums)
            for k in range(4):
                total = np.float32(1e-12)
                for j in range(size):
                    total += sums[k * size + j] * sums[k * size + j]
                scale, out = np.float32(1) / np.sqrt(total), grid[y, x + k]
                for j in range(size):
                    out[j] = sums[k * size + j] * scale
    return grid


@kernel(fastmath={"contract", "reassoc"})
def _blend_rows(coarse, y, out):
    """Interpolate row y of a grid twice as fine between two coarse rows. The first and the last
    column are repeated at the ends."""
    above, below = coarse[max((y - 1) // 2, 0)], coarse[min((y + 1) // 2, coarse.shape[0] - 1)]
    t = np.float32(0.25) if y % 2 else np.float32(0.75)
    for x in range(coarse.shape[1]):
        for j in range(coarse.shape[2]):
            out[x + 1, j] = (1 - t) * above[x, j] + t * below[x, j]
    out[0], out[-1] = out[1], out[-2]


@kernel(fastmath={"contract", "reassoc"})
def _add_fine_level(row, x, by_four, size, sums):
    """Add the finer level at four pixels from x on to `sums`, which holds their descriptors one
    after the other. A row of `by_four` holds the weights of four components."""
    a, b, c, d = row[x], row[x + 1], row[x + 2], row[x + 3]
    for k in range(by_four.shape[0]):
        w = by_four[k]
        a0, a1, a2, a3 = a[4 * k], a[4 * k + 1], a[4 * k + 2], a[4 * k + 3]
        b0, b1, b2, b3 = b[4 * k], b[4 * k + 1], b[4 * k + 2], b[4 * k + 3]
        c0, c1, c2, c3 = c[4 * k], c[4 * k + 1], c[4 * k + 2], c[4 * k + 3]
        d0, d1, d2, d3 = d[4 * k], d[4 * k + 1], d[4 * k + 2], d[4 * k + 3]
        for j in range(size):
            w0, w1, w2, w3 = w[j], w[size + j], w[2 * size + j], w[3 * size + j]
            sums[j] = sums[j] + a0 * w0 + a1 * w1 + a2 * w2 + a3 * w3
            sums[size + j] = sums[size + j] + b0 * w0 + b1 * w1 + b2 * w2 + b3 * w3
            sums[2 * size + j] = sums[2 * size + j] + c0 * w0 + c1 * w1 + c2 * w2 + c3 * w3
            sums[3 * size + j] = sums[3 * size + j] + d0 * w0 + d1 * w1 + d2 * w2 + d3 * w3


@kernel(fastmath={"contract"})
def _add_coarse_level(coarse, y, x, share, out):
    """Add the enlarged coarser level times `share` at a point of the finer grid."""
    above, left = max((y - 1) // 2, 0), max((x - 1) // 2, 0)
    below, right = min((y + 1) // 2, coarse.shape[0] - 1), min((x + 1) // 2, coarse.shape[1] - 1)
    t = np.float32(0.25) if y % 2 else np.float32(0.75)
    s = np.float32(0.25) if x % 2 else np.float32(0.75)
    a, b = coarse[above, left], coarse[above, right]
    c, d = coarse[below, left], coarse[below, right]
    p, q, r, z = share * (1 - t) * (1 - s), share * (1 - t) * s, share * t * (1 - s), share * t * s
    for j in range(len(out)):
        out[j] += p * a[j] + q * b[j] + r * c[j] + z * d[j]


@kernel(error_model="numpy", fastmath={"reassoc", "contract"})
def _is_local_best_match(grid, points_img, descriptors, stride, radius):
    """Return for each point whether its best match lies within one grid step of it. The most
    similar descriptor is searched within `radius` grid steps to each side."""
    rows, columns, size = grid.shape
    found = np.zeros(len(points_img), np.bool_)
    for k in range(len(points_img)):
        column = int(np.floor((points_img[k, 0] + np.float32(0.5)) / stride))
        row = int(np.floor((points_img[k, 1] + np.float32(0.5)) / stride))
        here, around = np.float32(-2), np.float32(-2)
        for y in range(max(row - radius, 0), min(row + radius, rows - 1) + 1):
            for x in range(max(column - radius, 0), min(column + radius, columns - 1) + 1):
                similarity = np.float32(0)
                for c in range(size):
                    similarity += grid[y, x, c] * descriptors[k, c]
                if abs(y - row) <= 1 and abs(x - column) <= 1:
                    here = max(here, similarity)
                else:
                    around = max(around, similarity)
        found[k] = here > around
    return found
