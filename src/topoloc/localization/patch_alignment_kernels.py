"""Numba kernels of `patch_alignment`."""

import numpy as np

from topoloc.compiled import kernel

_HALF = 5  # the patch has 11 x 11 pixels
_SIDE = 2 * _HALF + 1
_MIN_VARIANCE = 4.0  # grey levels squared: a patch with less has no texture


@kernel(fastmath={"reassoc", "contract"})
def _dot(patch, window, j0, i0):
    total = np.float32(0.0)
    for j in range(_SIDE):
        for i in range(_SIDE):
            total += patch[j, i] * window[j0 + j, i0 + i]
    return total


@kernel(fastmath={"reassoc", "contract"})
def _sample_patch(template, size, x, y, warp, patch):
    """Write the zero-mean template patch around (x, y), warped to the query, and return its norm:
    0 if it leaves the template or has no texture."""
    height, width = size[0], size[1]
    total, squares = np.float32(0.0), np.float32(0.0)
    for j in range(_SIDE):
        for i in range(_SIDE):
            u, v = i - _HALF, j - _HALF
            px = x + warp[0, 0] * u + warp[0, 1] * v
            py = y + warp[1, 0] * u + warp[1, 1] * v
            x0, y0 = int(np.floor(px)), int(np.floor(py))
            if x0 < 0 or y0 < 0 or x0 + 1 >= width or y0 + 1 >= height:
                return np.float32(0.0)
            fx, fy = np.float32(px - x0), np.float32(py - y0)
            one = np.float32(1.0)
            value = (one - fy) * (
                (one - fx) * template[y0, x0] + fx * template[y0, x0 + 1]
            ) + fy * ((one - fx) * template[y0 + 1, x0] + fx * template[y0 + 1, x0 + 1])
            patch[j, i] = value
            total += value
            squares += value * value
    count = np.float32(_SIDE * _SIDE)
    variance = squares - total * total / count
    if variance < _MIN_VARIANCE * count:
        return np.float32(0.0)
    for j in range(_SIDE):
        for i in range(_SIDE):
            patch[j, i] -= total / count
    return np.sqrt(variance)


@kernel()
def _find_peak(scores, i, j):
    """Return the offset (x, y) of the peak of the quadratic through the 3 x 3 scores around (i, j),
    at most a pixel."""
    best = scores[j, i]
    slope_x, slope_y = (
        0.5 * (scores[j, i + 1] - scores[j, i - 1]),
        0.5 * (scores[j + 1, i] - scores[j - 1, i]),
    )
    bend_x = scores[j, i + 1] - 2.0 * best + scores[j, i - 1]
    bend_y = scores[j + 1, i] - 2.0 * best + scores[j - 1, i]
    twist = 0.25 * (
        scores[j + 1, i + 1] - scores[j + 1, i - 1] - scores[j - 1, i + 1] + scores[j - 1, i - 1]
    )
    determinant = bend_x * bend_y - twist * twist
    if not (bend_x < 0.0 and determinant > 0.0):
        return 0.0, 0.0
    x = (twist * slope_y - bend_y * slope_x) / determinant
    y = (twist * slope_x - bend_x * slope_y) / determinant
    return min(max(x, -1.0), 1.0), min(max(y, -1.0), 1.0)


@kernel()
def align_patches(image, templates, sizes, which, at, centre, warp, reach):
    """Return the pixel of each point in `image` at which the template's patch around `centre`
    correlates best, at most `reach` pixels from `at`, and the correlation (-1: none)."""
    number = len(at)
    out, correlations = np.full((number, 2), np.nan), np.full(number, -1.0)
    width = 2 * reach + 1
    full = _SIDE + 2 * reach
    patch = np.zeros((_SIDE, _SIDE), np.float32)
    window = np.zeros((full, full), np.float32)
    sums, squares = np.zeros((full + 1, full + 1)), np.zeros((full + 1, full + 1))
    scores = np.zeros((width, width), np.float32)
    height, columns = image.shape
    count = _SIDE * _SIDE
    margin = _HALF + reach
    for k in range(number):
        if not (np.isfinite(at[k, 0]) and np.isfinite(warp[k, 0, 0])):
            continue
        cx, cy = int(np.round(at[k, 0])), int(np.round(at[k, 1]))
        if cx < margin or cy < margin or cx >= columns - margin or cy >= height - margin:
            continue
        norm = _sample_patch(
            templates[which[k]], sizes[which[k]], centre[k, 0], centre[k, 1], warp[k], patch
        )
        if not norm > 0.0:
            continue
        for j in range(full):
            row_sum, row_squares = 0.0, 0.0
            for i in range(full):
                value = image[cy - margin + j, cx - margin + i]
                window[j, i] = value
                row_sum += value
                row_squares += float(value) * value
                sums[j + 1, i + 1] = sums[j, i + 1] + row_sum
                squares[j + 1, i + 1] = squares[j, i + 1] + row_squares
        best, bi, bj = np.float32(-2.0), 0, 0
        for sj in range(width):
            for si in range(width):
                b, r = sj + _SIDE, si + _SIDE
                total = sums[b, r] - sums[sj, r] - sums[b, si] + sums[sj, si]
                spread = (
                    squares[b, r] - squares[sj, r] - squares[b, si] + squares[sj, si]
                ) - total * total / count
                score = np.float32(-1.0)
                if spread > _MIN_VARIANCE * count:
                    score = np.float32(_dot(patch, window, sj, si) / (norm * np.sqrt(spread)))
                scores[sj, si] = score
                if score > best:
                    best, bi, bj = score, si, sj
        if bi == 0 or bj == 0 or bi == width - 1 or bj == width - 1:
            continue
        dx, dy = _find_peak(scores, bi, bj)
        out[k, 0], out[k, 1] = cx + bi - reach + dx, cy + bj - reach + dy
        correlations[k] = best
    return out, correlations
