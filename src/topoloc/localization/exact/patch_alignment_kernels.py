"""Numba kernels of `patch_alignment`."""

import numpy as np

from topoloc.compiled import kernel


@kernel(fastmath={"reassoc", "contract"})
def _sample_patch(template, size, x, y, warp, patch):
    """Write the template around (x, y), warped to the query, into `patch`, with zero mean. Return
    the sum of its squares, 0 if it leaves the template."""
    side = len(patch)
    half = side // 2
    height, width = size[0], size[1]
    total, squares, one = np.float32(0.0), np.float32(0.0), np.float32(1.0)
    for j in range(side):
        for i in range(side):
            px = x + warp[0, 0] * (i - half) + warp[0, 1] * (j - half)
            py = y + warp[1, 0] * (i - half) + warp[1, 1] * (j - half)
            x0, y0 = int(np.floor(px)), int(np.floor(py))
            if x0 < 0 or y0 < 0 or x0 + 1 >= width or y0 + 1 >= height:
                return np.float32(0.0)
            fx, fy = np.float32(px - x0), np.float32(py - y0)
            upper = (one - fx) * template[y0, x0] + fx * template[y0, x0 + 1]
            lower = (one - fx) * template[y0 + 1, x0] + fx * template[y0 + 1, x0 + 1]
            value = (one - fy) * upper + fy * lower
            patch[j, i] = value
            total += value
            squares += value * value
    mean = total / np.float32(side * side)
    for j in range(side):
        for i in range(side):
            patch[j, i] -= mean
    return squares - total * mean


@kernel(fastmath={"reassoc", "contract"})
def _dot(patch, window, j0, i0):
    total = np.float32(0.0)
    for j in range(len(patch)):
        for i in range(len(patch)):
            total += patch[j, i] * window[j0 + j, i0 + i]
    return total


@kernel()
def _correlate(patch, patch_squares, window, min_squares, scores):
    """Write the correlation of the patch with the window at each shift into `scores`, -1 without
    texture. Sums over rectangles come from integral images."""
    full, side = len(window), len(patch)
    sums, squares = np.zeros((full + 1, full + 1)), np.zeros((full + 1, full + 1))
    for j in range(full):
        for i in range(full):
            value = float(window[j, i])
            sums[j + 1, i + 1] = sums[j, i + 1] + sums[j + 1, i] - sums[j, i] + value
            squares[j + 1, i + 1] = (
                squares[j, i + 1] + squares[j + 1, i] - squares[j, i] + value * value
            )
    for j in range(len(scores)):
        for i in range(len(scores)):
            b, r = j + side, i + side
            total = sums[b, r] - sums[j, r] - sums[b, i] + sums[j, i]
            spread = squares[b, r] - squares[j, r] - squares[b, i] + squares[j, i]
            spread -= total * total / (side * side)
            scores[j, i] = -1.0
            if spread > min_squares:
                scores[j, i] = _dot(patch, window, j, i) / np.sqrt(patch_squares * spread)


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
def align_patches(
    image,
    templates,
    sizes,
    template_of_match,
    predicted,
    centres,
    warps,
    patch_px,
    reach_px,
    min_sigma,
):
    """Return the pixel of each match in `image` at which the patch around `centres` in its template
    correlates best, at most `reach_px` from `predicted`, and the correlation (-1: none).

    `sizes` are the heights and widths of `templates`, `warps` the derivatives of a template's
    pixel by the image's. The patch has an odd side, and grey levels that vary by `min_sigma`.
    """
    pixels, correlations = np.full((len(predicted), 2), np.nan), np.full(len(predicted), -1.0)
    patch = np.zeros((patch_px, patch_px), np.float32)
    scores = np.zeros((2 * reach_px + 1, 2 * reach_px + 1), np.float32)
    margin, last = patch_px // 2 + reach_px, 2 * reach_px
    min_squares = min_sigma**2 * patch_px**2
    for k in range(len(predicted)):
        if not (np.isfinite(predicted[k, 0]) and np.isfinite(warps[k, 0, 0])):
            continue
        x, y = int(np.round(predicted[k, 0])), int(np.round(predicted[k, 1]))
        if not (margin <= x < image.shape[1] - margin and margin <= y < image.shape[0] - margin):
            continue
        row = template_of_match[k]
        squares = _sample_patch(
            templates[row], sizes[row], centres[k, 0], centres[k, 1], warps[k], patch
        )
        if squares < min_squares:
            continue
        window = image[y - margin : y + margin + 1, x - margin : x + margin + 1].astype(np.float32)
        _correlate(patch, squares, window, min_squares, scores)
        best = np.argmax(scores)
        j, i = best // (last + 1), best % (last + 1)
        if 0 < i < last and 0 < j < last:
            dx, dy = _find_peak(scores, i, j)
            pixels[k, 0], pixels[k, 1] = x + i - reach_px + dx, y + j - reach_px + dy
            correlations[k] = scores[j, i]
    return pixels, correlations
