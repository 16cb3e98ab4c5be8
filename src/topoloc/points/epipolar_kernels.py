"""Implement the Numba kernels for the disparity of single points of a rectified pair: correlation
along the row and refinement.

Dense stereo would compute many pixels that no key point needs. Descriptor matching would lose the
points that are not detected in both images. This method takes a few milliseconds for a thousand
points.
"""

import numpy as np

from topoloc.compiled import kernel

_OPTIONS = {"error_model": "numpy", "fastmath": {"reassoc", "contract", "arcp"}}


@kernel(**_OPTIONS)
def _sample_row(image, x, y, row):
    """Sample bilinearly at x, x + 1, ... of one row. All samples have the same subpixel offset, so
    that the loop vectorises."""
    left, top = int(np.floor(x)), int(np.floor(y))
    fx, fy = np.float32(x - left), np.float32(y - top)
    upper = image[top, left : left + len(row) + 1]
    lower = image[top + 1, left : left + len(row) + 1]
    for k in range(len(row)):
        row[k] = (1 - fy) * (upper[k] * (1 - fx) + upper[k + 1] * fx) + fy * (
            lower[k] * (1 - fx) + lower[k + 1] * fx
        )


@kernel(**_OPTIONS)
def _normalized_patch(image, x, y, half, patch):
    """Fill `patch` with the zero-mean, unit-norm patch around (x, y). Return its norm before
    normalisation (0: no texture)."""
    side = 2 * half + 1
    mean = np.float32(0)
    for j in range(side):
        row = patch[j]
        _sample_row(image, x - half, y + j - half, row)
        for i in range(side):
            mean += row[i]
    mean /= side * side
    norm = np.float32(0)
    for j in range(side):
        for i in range(side):
            patch[j, i] -= mean
            norm += patch[j, i] * patch[j, i]
    norm = np.sqrt(norm)
    if norm > 0:
        for j in range(side):
            for i in range(side):
                patch[j, i] /= norm
    return norm


@kernel(**_OPTIONS)
def _correlations(patch, half, image, x, y, shift_sign, num_disparities, strip, sums, scores):
    """Compute the normalised correlation of `patch` (centre (x, y) in its own image) with `image`
    at x + shift_sign * d, for d = 0 .. num_disparities - 1."""
    side = 2 * half + 1
    width = image.shape[1]
    length = num_disparities + side - 1
    start = x - half if shift_sign > 0 else x - half - (num_disparities - 1)
    # All samples of a strip have the same subpixel offset. The loops run over slices from 0 on,
    # because the compiler vectorises only these.
    first, top = int(np.floor(start)), int(np.floor(y)) - half
    fx, fy = np.float32(start - np.floor(start)), np.float32(y - np.floor(y))
    begin, end = max(0, -first), min(length, width - 1 - first)
    scores[:num_disparities] = np.float32(-1)
    if end - begin < side:
        return
    columns, squares = sums[0, begin:end], sums[1, begin:end]
    columns[:], squares[:] = 0.0, 0.0
    for j in range(side):
        upper = image[top + j, first + begin : first + end + 1]
        lower = image[top + j + 1, first + begin : first + end + 1]
        row = strip[j, begin:end]
        for k in range(len(row)):
            value = (1 - fy) * (upper[k] * (1 - fx) + upper[k + 1] * fx) + fy * (
                lower[k] * (1 - fx) + lower[k + 1] * fx
            )
            row[k] = value
            columns[k] += value
            squares[k] += value * value
    num = end - begin - side + 1  # windows that lie inside
    dots, totals, norms = sums[2, :num], sums[3, :num], sums[4, :num]
    dots[:], totals[:], norms[:] = 0.0, 0.0, 0.0
    for i in range(side):
        of_columns, of_squares = columns[i : i + num], squares[i : i + num]
        for k in range(num):
            totals[k] += of_columns[k]
            norms[k] += of_squares[k]
        for j in range(side):
            factor, row = patch[j, i], strip[j, begin + i : begin + i + num]
            for k in range(num):
                dots[k] += factor * row[k]
    for k in range(num):
        variance = norms[k] - totals[k] * totals[k] / np.float32(side * side)
        if variance > 1.0:
            d = begin + k if shift_sign > 0 else num_disparities - 1 - begin - k
            scores[d] = dots[k] / np.sqrt(variance)


@kernel(**_OPTIONS)
def _refine_disparity(patch, half, right, x, y, disparity):
    """Refine a disparity with Gauss-Newton, with gain and offset eliminated. Return (disparity,
    standard deviation in pixels)."""
    side = 2 * half + 1
    width = right.shape[1]
    sigma = np.float32(np.inf)
    window, slope = np.empty((side, side), np.float32), np.empty((side, side), np.float32)
    samples = np.empty(side + 2, np.float32)  # of a row, and one more at each end
    for _ in range(8):
        xr = x - disparity
        if xr - half - 1 < 0 or xr + half + 2 >= width:
            return disparity, np.float32(np.inf)
        mean, slope_mean = np.float32(0), np.float32(0)
        for j in range(side):
            _sample_row(right, xr - half - 1, y + j - half, samples)
            values, slopes = window[j], slope[j]
            for i in range(side):
                values[i] = samples[i + 1]
                slopes[i] = np.float32(0.5) * (samples[i + 2] - samples[i])
                mean += values[i]
                slope_mean += slopes[i]
        mean /= side * side
        slope_mean /= side * side
        gain = np.float32(0)
        for j in range(side):
            for i in range(side):
                gain += (window[j, i] - mean) ** 2
        gain = np.sqrt(gain)
        if gain < 1.0:
            return disparity, np.float32(np.inf)
        gradient, hessian, squares = np.float32(0), np.float32(0), np.float32(0)
        for j in range(side):
            for i in range(side):
                residual = patch[j, i] * gain - (window[j, i] - mean)
                g = slope[j, i] - slope_mean
                gradient += g * residual
                hessian += g * g
                squares += residual * residual
        if hessian < 1.0:
            return disparity, np.float32(np.inf)
        step = gradient / hessian
        # the window moves by +step in x if the disparity falls by step
        disparity -= min(max(step, np.float32(-0.7)), np.float32(0.7))
        sigma = np.sqrt(squares / (side * side - 3) / hessian)
        if abs(step) < 0.01:
            break
    return disparity, sigma


@kernel(**_OPTIONS)
def _match_point(
    left, right, x, y, half, min_disparity, num_disparities, min_score, max_ratio,
    patch, back, strip, sums, scores,
):  # fmt: skip
    """Return (disparity, sigma) of one point, searched among min_disparity .. min_disparity +
    num_disparities - 1. Both are NaN under the conditions of `match_in_ranges`."""
    height, width = left.shape
    side = 2 * half + 1
    nothing = np.float32(np.nan), np.float32(np.nan)
    if x < half or y < half or x >= width - half - 1 or y >= height - half - 1:
        return nothing
    # A standard deviation of less than two grey levels.
    if _normalized_patch(left, x, y, half, patch) < 2.0 * side:
        return nothing
    _correlations(
        patch, half, right, x - min_disparity, y, -1, num_disparities, strip, sums, scores
    )
    best = int(np.argmax(scores[:num_disparities]))
    if not scores[best] >= min_score:
        return nothing
    second = np.float32(-1)
    for d in range(num_disparities):
        if abs(d - best) > 2 and scores[d] > second:
            second = scores[d]
    if second > max_ratio * scores[best]:
        return nothing
    start = np.float32(min_disparity + best)
    disparity, sigma = _refine_disparity(patch, half, right, x, y, start)
    xr = x - disparity
    is_beside = xr < half or xr >= width - half - 1
    if is_beside or not np.isfinite(sigma) or abs(disparity - min_disparity - best) > 1.5:
        return nothing
    # The search back must return within a pixel. For a point visible in one camera only it does
    # not.
    _normalized_patch(right, xr, y, half, back)
    _correlations(back, half, left, xr + min_disparity, y, 1, num_disparities, strip, sums, scores)
    if abs(min_disparity + int(np.argmax(scores[:num_disparities])) - disparity) > 1.0:
        return nothing
    return disparity, sigma


@kernel(**_OPTIONS)
def match_in_ranges(
    left, right, points, min_disparities, range_lengths, half, min_score, max_ratio,
    disparities, sigmas,
):  # fmt: skip
    """Write the disparity and standard deviation of each point (x, y) of `left` in `right` (float32
    images of one size).

    Point n is searched among min_disparities[n] .. min_disparities[n] + range_lengths[n] - 1. The
    result is NaN if

    * the point is too near the border or has no texture,
    * its best score is below `min_score`,
    * the best score elsewhere on the row reaches `max_ratio` of it, or
    * the search back from the right image misses the point by more than a pixel.
    """
    side = 2 * half + 1
    most = 1
    for n in range(len(points)):
        most = max(most, range_lengths[n])
    patch, back = np.empty((side, side), np.float32), np.empty((side, side), np.float32)
    strip, sums = np.empty((side, most + side), np.float32), np.empty((5, most + side), np.float32)
    scores = np.empty(most, np.float32)
    for n in range(len(points)):
        disparities[n], sigmas[n] = _match_point(
            left, right, points[n, 0], points[n, 1], half, min_disparities[n], range_lengths[n],
            min_score, max_ratio, patch, back, strip, sums, scores,
        )  # fmt: skip
