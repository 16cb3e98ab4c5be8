"""Numba kernels: the disparity of single points of a rectified pair, by correlation along the row and refinement.

Dense stereo would spend its time on pixels that no key point needs; matching descriptors of the right picture would lose
the points that the detector did not find twice. A thousand points cost a few milliseconds this way.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"reassoc", "contract", "arcp"}}


@njit(**_OPTIONS)
def _sample(image, x, y):
    """Bilinear; the caller keeps (x, y) inside."""
    ix, iy = int(x), int(y)
    fx, fy = np.float32(x - ix), np.float32(y - iy)
    top = image[iy, ix] * (1 - fx) + image[iy, ix + 1] * fx
    bottom = image[iy + 1, ix] * (1 - fx) + image[iy + 1, ix + 1] * fx
    return top * (1 - fy) + bottom * fy


@njit(**_OPTIONS)
def _normalized_patch(image, x, y, half, patch):
    """Fill `patch` with the zero-mean, unit-norm patch around (x, y); return its norm before (0: no texture)."""
    side = 2 * half + 1
    mean = np.float32(0)
    for j in range(side):
        for i in range(side):
            value = _sample(image, x + i - half, y + j - half)
            patch[j, i] = value
            mean += value
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


@njit(**_OPTIONS)
def _correlations(patch, half, image, x, y, shift_sign, num_disparities, strip, scores):
    """NCC of `patch` (centre (x, y) in its own picture) with `image` at x + shift_sign * d for d = 0 .. num_disparities - 1."""
    side = 2 * half + 1
    width = image.shape[1]
    length = num_disparities + side - 1
    start = x - half if shift_sign > 0 else x - half - (num_disparities - 1)
    for j in range(side):
        yy = y + j - half
        for k in range(length):
            xx = start + k
            if xx < 0 or xx >= width - 1:
                strip[j, k] = np.nan
            else:
                strip[j, k] = _sample(image, xx, yy)
    for d in range(num_disparities):
        first = d if shift_sign > 0 else num_disparities - 1 - d
        dot, total, squares = np.float32(0), np.float32(0), np.float32(0)
        for j in range(side):
            for i in range(side):
                value = strip[j, first + i]
                dot += patch[j, i] * value
                total += value
                squares += value * value
        variance = squares - total * total / (side * side)
        # NaN (outside of the picture) compares false, and so scores as no match
        scores[d] = dot / np.sqrt(variance) if variance > 1.0 else np.float32(-1)


@njit(**_OPTIONS)
def _refine_disparity(patch, half, right, x, y, disparity, num_iterations):
    """Gauss-Newton on the disparity with gain and offset eliminated; returns (disparity, standard deviation in pixels)."""
    side = 2 * half + 1
    width = right.shape[1]
    sigma = np.float32(np.inf)
    window = np.empty((side, side), np.float32)
    slope = np.empty((side, side), np.float32)
    for _ in range(num_iterations):
        xr = x - disparity
        if xr - half - 1 < 0 or xr + half + 2 >= width:
            return disparity, np.float32(np.inf)
        mean, slope_mean = np.float32(0), np.float32(0)
        for j in range(side):
            for i in range(side):
                xx, yy = xr + i - half, y + j - half
                window[j, i] = _sample(right, xx, yy)
                slope[j, i] = np.float32(0.5) * (_sample(right, xx + 1, yy) - _sample(right, xx - 1, yy))
                mean += window[j, i]
                slope_mean += slope[j, i]
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
        # the window moves by +step in x when the disparity falls by it
        disparity -= min(max(step, np.float32(-0.7)), np.float32(0.7))
        sigma = np.sqrt(squares / (side * side - 3) / hessian)
        if abs(step) < 0.01:
            break
    return disparity, sigma


@njit(**_OPTIONS)
def match_along_rows(left, right, points, half, max_disparity, min_score, max_ratio):
    """Disparity of each point (x, y) of `left` in `right` (float32 pictures of one size) with its standard deviation.

    NaN where the point is too near the border, without texture, not distinct along the row (the best score elsewhere
    reaches `max_ratio` of the best), below `min_score`, or not found back from the right picture within a pixel.
    """
    height, width = left.shape
    num = len(points)
    side = 2 * half + 1
    num_disparities = max_disparity + 1
    disparities = np.full(num, np.nan, np.float32)
    sigmas = np.full(num, np.nan, np.float32)
    patch = np.empty((side, side), np.float32)
    back = np.empty((side, side), np.float32)
    strip = np.empty((side, num_disparities + side), np.float32)
    scores = np.empty(num_disparities, np.float32)
    for n in range(num):
        x, y = points[n, 0], points[n, 1]
        if x < half or y < half or x >= width - half - 1 or y >= height - half - 1:
            continue
        norm = _normalized_patch(left, x, y, half, patch)
        if norm < 2.0 * side:  # standard deviation of less than two grey levels
            continue
        _correlations(patch, half, right, x, y, -1, num_disparities, strip, scores)
        best = int(np.argmax(scores))
        if not scores[best] >= min_score:
            continue
        second = np.float32(-1)
        for d in range(num_disparities):
            if abs(d - best) > 2 and scores[d] > second:
                second = scores[d]
        if second > max_ratio * scores[best]:
            continue
        disparity, sigma = _refine_disparity(patch, half, right, x, y, np.float32(best), 8)
        xr = x - disparity
        if not np.isfinite(sigma) or abs(disparity - best) > 1.5 or xr < half or xr >= width - half - 1:
            continue
        # found back within a pixel? a point seen by one camera only is not
        _normalized_patch(right, xr, y, half, back)
        _correlations(back, half, left, xr, y, 1, num_disparities, strip, scores)
        if abs(int(np.argmax(scores)) - disparity) > 1.0:
            continue
        disparities[n] = disparity
        sigmas[n] = sigma
    return disparities, sigmas
