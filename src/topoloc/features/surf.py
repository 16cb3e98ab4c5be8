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

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt8

from topoloc.compiled import kernel, num_threads as default_num_threads, parallel_for_rows
from topoloc.features.features import Features
from topoloc.features.surf_descriptors import DESCRIPTOR_LENGTH, describe

MIN_FILTER_PX = 9  # this filter has a sigma of 1.2 pixels (Bay et al. 2008, 3.3)
FILTER_INCREMENT_PX = 6
SIGMA_PER_FILTER_PX = 1.2 / MIN_FILTER_PX


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
    angles, descriptors = describe(integral, points, scales, num_parts)
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
            first, last = (height // step * one // num_parts for one in (part, part + 1))
            columns, top, rows = edges, 0, integral
            if step > 1:
                top = max((first - 1) * step - size, 0)
                bottom = min(last * step + size + step, height + 1)
                rows = scratch[part][: (bottom - top) * split_width(step)].reshape(bottom - top, -1)
                _split_columns(integral, step, top, rows)
                columns = edges % step * (split_width(step) // step) + edges // step
            found[octave, part] = _detect_band(
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


@kernel()
def integral_image(image):
    """Return the integral image, (h + 1, w + 1) int32 modulo 2^32. Entry (y, x) is the sum of
    image[:y, :x]. The difference of wrapped sums is still right if the box itself fits."""
    height, width = image.shape
    integral = np.empty((height + 1, width + 1), np.int32)
    integral[0] = 0
    for y in range(height):
        source = image[y]
        above = integral[y][1:]
        integral[y + 1, 0] = 0
        below = integral[y + 1][1:]
        total = np.int32(0)
        for x in range(width):
            total = np.int32(total + source[x])
            below[x] = total
        for x in range(width):
            below[x] = np.int32(below[x] + above[x])
    return integral


@kernel()
def _split_columns(integral, step, first, split):
    """Fill `split` with rows of the integral image from `first` on, with reordered columns: those
    at 0, step, 2 step, ..., then 1, 1 + step, ...

    The reads of a filter bank sampled at every step-th pixel are then contiguous, so that its loops
    vectorise.
    """
    width, phase_length = integral.shape[1], split.shape[1] // step
    for y in range(split.shape[0]):
        source = integral[first + y]
        for phase in range(step):
            target = split[y, phase * phase_length : (phase + 1) * phase_length]
            for j in range((width - phase + step - 1) // step):
                target[j] = source[phase + j * step]


# No fastmath: a fused product here rounded differently when compiled in this process and when read
# from the compiler's cache.
@kernel(error_model="numpy")
def _hessian_row(sums, top, edges, columns, rows, out):
    """Compute the determinants of one row of filters with their upper edge at row `top` of `sums`.

    edges are the ten edge positions of the pattern in pixels. columns are their places after
    `_split_columns`.
    """
    rows_xx, rows_yy, rows_xy = rows[0], rows[1], rows[2]
    s, e = sums[top:], edges
    i0, i1, i2, i3, i4 = s[0], s[e[1]], s[e[2]], s[e[3]], s[e[4]]
    i5, i6, i7, i8, i9 = s[e[5]], s[e[6]], s[e[7]], s[e[8]], s[e[9]]
    # A second derivative is the whole box minus three times its middle third: two boxes instead of
    # three.
    for x in range(rows.shape[1]):
        rows_xx[x] = np.int32(i7[x] - i2[x])
        rows_yy[x] = np.int32(i9[x] - i0[x] - 3 * (i6[x] - i3[x]))
        rows_xy[x] = np.int32(i4[x] - i1[x] - i8[x] + i5[x])
    xx_3, xx_6, xx_9 = rows_xx[columns[3] :], rows_xx[columns[6] :], rows_xx[columns[9] :]
    yy_2, yy_7 = rows_yy[columns[2] :], rows_yy[columns[7] :]
    xy_1, xy_4 = rows_xy[columns[1] :], rows_xy[columns[4] :]
    xy_5, xy_8 = rows_xy[columns[5] :], rows_xy[columns[8] :]
    lobe = np.float32(1.0) / np.float32((edges[6] - edges[3]) * (edges[7] - edges[2]))
    # 0.9^2 = 0.81, Bay et al. 2008, Eq. 3.
    quarter = np.float32(0.9) / np.float32((edges[4] - edges[1]) * (edges[4] - edges[1]))
    for x in range(out.shape[0]):
        dxx = np.float32(np.int32(xx_9[x] - rows_xx[x] - 3 * (xx_6[x] - xx_3[x]))) * lobe
        dyy = np.float32(np.int32(yy_7[x] - yy_2[x])) * lobe
        dxy = np.float32(np.int32(xy_4[x] - xy_1[x] - xy_8[x] + xy_5[x])) * quarter
        out[x] = dxx * dyy - dxy * dxy


@kernel(fastmath=True, error_model="numpy")
def _mark_candidates(below, up, mid, down, above, first, last, threshold, marks):
    """Set marks[j] = 1 if mid[j] exceeds the threshold and six of its 26 neighbours. This cheap
    filter vectorises."""
    count = last - first
    centre, left, right = mid[first:last], mid[first - 1 : last - 1], mid[first + 1 : last + 1]
    north, south = up[first:last], down[first:last]
    smaller, larger = below[first:last], above[first:last]
    for j in range(count):
        value = centre[j]
        beside = max(max(left[j], right[j]), max(north[j], south[j]))
        ring = max(beside, max(max(smaller[j], larger[j]), threshold))
        marks[j] = np.uint8(value > ring)


@kernel()
def _is_maximum(ring, layer, up, mid, down, j):
    value = ring[layer, mid, j]
    for other in range(layer - 1, layer + 2):
        for row in (up, mid, down):
            for column in range(j - 1, j + 2):
                if ring[other, row, column] >= value and not (
                    other == layer and row == mid and column == j
                ):
                    return False
    return True


@kernel(error_model="numpy")
def _refine(ring, layer, up, mid, down, j):
    """Return (ok, x, y, scale): the vertex of the quadratic through the 27 determinants, in grid
    units. ok is False beyond one unit."""
    below, here, above = ring[layer - 1], ring[layer], ring[layer + 1]
    value = np.float64(here[mid, j])
    gx, gy = (here[mid, j + 1] - here[mid, j - 1]) * 0.5, (here[down, j] - here[up, j]) * 0.5
    gs = (above[mid, j] - below[mid, j]) * 0.5
    xx = here[mid, j + 1] - 2.0 * value + here[mid, j - 1]
    yy = here[down, j] - 2.0 * value + here[up, j]
    ss = above[mid, j] - 2.0 * value + below[mid, j]
    xy = (here[down, j + 1] - here[down, j - 1] - here[up, j + 1] + here[up, j - 1]) * 0.25
    xs = (above[mid, j + 1] - above[mid, j - 1] - below[mid, j + 1] + below[mid, j - 1]) * 0.25
    ys = (above[down, j] - above[up, j] - below[down, j] + below[up, j]) * 0.25
    cofactor_xx, cofactor_xy, cofactor_xs = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - yy * xs
    determinant = xx * cofactor_xx + xy * cofactor_xy + xs * cofactor_xs
    if determinant == 0.0:
        return False, 0.0, 0.0, 0.0
    cofactor_yy, cofactor_ys, cofactor_ss = xx * ss - xs * xs, xy * xs - xx * ys, xx * yy - xy * xy
    dx = -(cofactor_xx * gx + cofactor_xy * gy + cofactor_xs * gs) / determinant
    dy = -(cofactor_xy * gx + cofactor_yy * gy + cofactor_ys * gs) / determinant
    ds = -(cofactor_xs * gx + cofactor_ys * gy + cofactor_ss * gs) / determinant
    return max(abs(dx), abs(dy), abs(ds)) <= 1.0, dx, dy, ds


@kernel(error_model="numpy")
def _collect_row(ring, layer, i, sizes, step, threshold, marks, words, found, count):
    """Append the maxima of row i of this layer to `found` (x, y, size, response). Return the array,
    enlarged if necessary, and its count."""
    num_columns = ring.shape[2]
    margin = sizes[layer + 1] // 2 // step + 1
    up, mid, down = (i - 1) % 3, i % 3, (i + 1) % 3
    last = num_columns - margin
    below, here, above = ring[layer - 1], ring[layer], ring[layer + 1]
    _mark_candidates(
        below[mid], here[up], here[mid], here[down], above[mid], margin, last, threshold, marks
    )
    num_marks = last - margin
    for k in range(num_marks, min((num_marks + 7) // 8 * 8, marks.shape[0])):
        marks[k] = 0
    size = sizes[layer]
    for word in range((num_marks + 7) // 8):
        if words[word] == 0:
            continue
        for k in range(word * 8, word * 8 + 8):
            j = k + margin
            if marks[k] == 0 or not _is_maximum(ring, layer, up, mid, down, j):
                continue
            ok, dx, dy, ds = _refine(ring, layer, up, mid, down, j)
            if not ok:
                continue
            if count == found.shape[0]:
                found = np.concatenate((found, np.empty_like(found)))
            half = (size - 1) * 0.5
            found[count, 0] = step * (j - size // 2 // step) + half + dx * step
            found[count, 1] = step * (i - size // 2 // step) + half + dy * step
            found[count, 2] = np.rint(size + ds * (size - sizes[layer - 1]))
            found[count, 3] = ring[layer, mid, j]
            count += 1
    return found, count


@kernel(error_model="numpy")
def _detect_band(sums, sums_top, height, width, edges, columns, step, first, last, threshold):
    """Return the maxima (m, 4) = x, y, size, response in rows [first, last) of an octave's grid
    (every step-th pixel).

    sums are rows of the integral image of a (height, width) image from `sums_top` on, ordered by
    `_split_columns`. edges and columns (n, 10) describe the filters of the octave's n layers. Only
    three rows of each layer are in memory at a time.
    """
    sizes = edges[:, 9].copy()
    num_layers, num_rows, num_columns = sizes.shape[0], height // step, width // step
    ring = np.zeros((num_layers, 3, num_columns), np.float32)
    rows = np.empty((3, sums.shape[1]), np.int32)
    marks = np.zeros((num_columns + 7) // 8 * 8, np.uint8)
    words = marks.view(np.uint64)
    found = np.empty((256, 4), np.float32)
    count = 0
    for i in range(max(first - 1, 0), min(last + 1, num_rows)):
        for layer in range(num_layers):
            size = sizes[layer]
            margin = size // 2 // step
            if i < margin or (i - margin) * step + size > height or width < size:
                continue
            out = ring[layer, i % 3, margin : margin + 1 + (width - size) // step]
            _hessian_row(
                sums, (i - margin) * step - sums_top, edges[layer], columns[layer], rows, out
            )
        row = i - 1
        if row < first:
            continue
        for layer in range(1, num_layers - 1):
            margin = sizes[layer + 1] // 2 // step + 1
            if margin <= row < num_rows - margin and num_columns > 2 * margin:
                found, count = _collect_row(
                    ring, layer, row, sizes, step, threshold, marks, words, found, count
                )
    return found[:count].copy()
