"""Implement the Numba kernels of `point_tracking`: alignment of tracked points with the key frame,
and corner selection.

Point trackers step from frame to frame and drift a little at each step. The patch of the last key
frame does not drift.
"""

import numpy as np

from topoloc.compiled import kernel

_OPTIONS = {"error_model": "numpy", "fastmath": {"reassoc", "contract", "arcp"}}


@kernel(error_model="numpy", inline="always")  # inlined, so that the caller's fastmath applies
def sample_bilinear(image, x, y):
    """Return the bilinear sample at (x, y), which must lie inside the image."""
    ix, iy = int(x), int(y)
    fx, fy = np.float32(x - ix), np.float32(y - iy)
    top = image[iy, ix] * (1 - fx) + image[iy, ix + 1] * fx
    bottom = image[iy + 1, ix] * (1 - fx) + image[iy + 1, ix + 1] * fx
    return top * (1 - fy) + bottom * fy


@kernel(**_OPTIONS)
def _prepare_patch(image, x, y, half, patch, slope_x, slope_y):
    """Fill the zero-mean patch around (x, y) and its zero-mean slopes. Return the patch's norm and
    the sums xx, xy, yy of the 2x2 normal matrix."""
    side = 2 * half + 1
    mean, mean_x, mean_y = np.float32(0), np.float32(0), np.float32(0)
    for j in range(side):
        for i in range(side):
            xx, yy = x + i - half, y + j - half
            patch[j, i] = sample_bilinear(image, xx, yy)
            slope_x[j, i] = np.float32(0.5) * (
                sample_bilinear(image, xx + 1, yy) - sample_bilinear(image, xx - 1, yy)
            )
            slope_y[j, i] = np.float32(0.5) * (
                sample_bilinear(image, xx, yy + 1) - sample_bilinear(image, xx, yy - 1)
            )
            mean += patch[j, i]
            mean_x += slope_x[j, i]
            mean_y += slope_y[j, i]
    area = np.float32(side * side)
    norm, xx_sum, xy_sum, yy_sum = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    for j in range(side):
        for i in range(side):
            patch[j, i] -= mean / area
            slope_x[j, i] -= mean_x / area
            slope_y[j, i] -= mean_y / area
            norm += patch[j, i] ** 2
            xx_sum += slope_x[j, i] ** 2
            xy_sum += slope_x[j, i] * slope_y[j, i]
            yy_sum += slope_y[j, i] ** 2
    return np.sqrt(norm), xx_sum, xy_sum, yy_sum


@kernel(**_OPTIONS)
def _sample_patch(image, x, y, scale, half, patch, window):
    """Fill `window` with the zero-mean patch around (x, y), enlarged by `scale`. Return its sum of
    squares and its product with `patch`."""
    side = 2 * half + 1
    mean = np.float32(0)
    for j in range(side):
        for i in range(side):
            window[j, i] = sample_bilinear(image, x + scale * (i - half), y + scale * (j - half))
            mean += window[j, i]
    mean /= side * side
    squares, dot = np.float32(0), np.float32(0)
    for j in range(side):
        for i in range(side):
            window[j, i] -= mean
            squares += window[j, i] ** 2
            dot += window[j, i] * patch[j, i]
    return squares, dot


@kernel(**_OPTIONS)
def refine_tracks(
    reference, image, points_ref, points, scales, half, num_iterations, max_shift, first, last,
    refined, scores, sigmas,
):  # fmt: skip
    """Fill `refined`, `scores` and `sigmas` for the rows first .. last - 1.

    A patch of the image is `scales` times as large as that of the reference. Gauss-Newton estimates
    a shift with gain and offset of the light eliminated. Slopes are those of the reference (inverse
    compositional alignment, Baker and Matthews, IJCV 2004). The score is the final normalised
    correlation. It is -1 if the point is near a border, has no texture, or moves farther than
    `max_shift` pixels. The sigma is the standard deviation of the shift if the residuals are noise
    (pixels, mean of both directions).
    """
    side = 2 * half + 1
    patch, window = np.empty((side, side), np.float32), np.empty((side, side), np.float32)
    slope_x, slope_y = np.empty((side, side), np.float32), np.empty((side, side), np.float32)
    height, width = image.shape
    for n in range(first, last):
        scores[n] = np.float32(-1)
        x, y = points[n, 0], points[n, 1]
        refined[n, 0], refined[n, 1] = x, y
        rx, ry = points_ref[n, 0], points_ref[n, 1]
        margin = half + 2
        if rx < margin or ry < margin or rx >= width - margin - 1 or ry >= height - margin - 1:
            continue
        norm, a, b, c = _prepare_patch(reference, rx, ry, half, patch, slope_x, slope_y)
        determinant = a * c - b * b
        if norm < 2.0 * side or determinant < 1e-3 * (a + c) * (a + c):
            continue
        sigmas[n] = np.inf
        scale = scales[n]
        margin = int(half * scale) + 2
        for _ in range(num_iterations):
            last_x, last_y = width - margin - 1, height - margin - 1
            if not (x >= margin and y >= margin and x < last_x and y < last_y):
                scores[n] = np.float32(-1)
                break
            squares, dot = _sample_patch(image, x, y, scale, half, patch, window)
            if squares < 1.0:
                scores[n] = np.float32(-1)
                break
            scores[n] = dot / (norm * np.sqrt(squares))
            gain = norm / np.sqrt(squares)
            gx, gy = np.float32(0), np.float32(0)
            for j in range(side):
                for i in range(side):
                    residual = window[j, i] * gain - patch[j, i]
                    gx += slope_x[j, i] * residual
                    gy += slope_y[j, i] * residual
            step_x = scale * (c * gx - b * gy) / determinant
            step_y = scale * (a * gy - b * gx) / determinant
            length = np.sqrt(step_x * step_x + step_y * step_y)
            if length > 1.0:
                step_x, step_y = step_x / length, step_y / length
            x, y = x - step_x, y - step_y
            if length < 0.01:
                break
        if (x - points[n, 0]) ** 2 + (y - points[n, 1]) ** 2 > max_shift * max_shift:
            scores[n] = np.float32(-1)
        if scores[n] > 0:
            refined[n, 0], refined[n, 1] = x, y
            unlike = max(np.float32(1) - scores[n] * scores[n], np.float32(0))
            noise = norm * norm * unlike / (side * side)
            sigmas[n] = scale * np.sqrt(noise * (a + c) / (2 * determinant))


@kernel()
def _is_peak(strength, y, x):
    value = strength[y, x]
    for row in range(y - 1, y + 2):
        for column in range(x - 1, x + 2):
            if strength[row, column] > value:
                return False
    return True


@kernel()
def select_cell_corners(strength, is_free, side, top, left, border, threshold, corners):
    """Fill `corners` with x, y of the strongest peak of each free cell, row by row of the grid.
    Return their number.

    `is_free` (rows, columns) are the cells, `side` pixels wide, starting at (left, top). A peak
    must be stronger than `threshold` and at least `border` (1 or more) pixels inside the image. Of
    equal peaks the first counts.
    """
    height, width = strength.shape
    count = 0
    for row in range(is_free.shape[0]):
        first_y = max(top + row * side, border)
        last_y = min(top + (row + 1) * side, height - border)
        for column in range(is_free.shape[1]):
            if not is_free[row, column]:
                continue
            first_x = max(left + column * side, border)
            last_x = min(left + (column + 1) * side, width - border)
            best, best_x, best_y = threshold, -1, -1
            for y in range(first_y, last_y):
                for x in range(first_x, last_x):
                    if strength[y, x] > best and _is_peak(strength, y, x):
                        best, best_x, best_y = strength[y, x], x, y
            if best_x >= 0:
                corners[count, 0], corners[count, 1] = best_x, best_y
                count += 1
    return count
