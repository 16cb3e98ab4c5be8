"""Describe key points of `surf`: an image pyramid, and orientation and descriptor of each point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

from topoloc.compiled import kernel, parallel_for_rows

DESCRIPTOR_LENGTH = 64
# Sample spacings in pixels for which smoothed images are made, from the smallest key points on.
LEVEL_RATIO = 1.2
LEVEL_SPACINGS = 1.4 * LEVEL_RATIO ** np.arange(33)
PATCH_SIZE = 20  # samples a side of the described window, in units of the key point's scale s
ORIENTATION_RADIUS = 6  # in units of s
SECTOR_DEG = 5  # step of the sliding orientation window
WINDOW_SECTORS = 12


def _gaussian(length, sigma):
    offsets = np.arange(length) - (length - 1) / 2
    weights = np.exp(-(offsets**2) / (2 * sigma**2))
    return weights / weights.sum()


def _orientation_samples():
    """Return rows (x, y, weight) of the samples within 6 s of the key point, in units of s. Weights
    are from a Gaussian of 2.5 s."""
    radius = ORIENTATION_RADIUS
    x, y = np.indices((2 * radius + 1, 2 * radius + 1)) - radius
    inside = x**2 + y**2 <= radius**2
    kernel = _gaussian(2 * radius + 1, 2.5)
    return np.stack([x[inside], y[inside], np.outer(kernel, kernel)[inside]]).astype(np.float32)


ORIENTATION_SAMPLES = _orientation_samples()
# Rows and columns of the (21, 21) samples of a patch, one after the other.
GRID_ROWS, GRID_COLUMNS = (
    np.indices((PATCH_SIZE + 1, PATCH_SIZE + 1)).reshape(2, -1).astype(np.float32)
)
# Padded with zeros to whole vectors of eight numbers: values beyond a row are read with weight
# zero.
PADDED_SIZE = 24
PATCH_WEIGHTS = np.zeros((PATCH_SIZE, PADDED_SIZE), np.float32)
PATCH_WEIGHTS[:, :PATCH_SIZE] = np.outer(_gaussian(PATCH_SIZE, 3.3), _gaussian(PATCH_SIZE, 3.3))


@dataclass(frozen=True)
class _Level:
    """Hold a smoothed image of every step-th pixel. Its pixel (0, 0) is at (offset, offset) of the
    image, with offset = (box + 1) / 2. `share` is that of `_smooth_rows`."""

    pixels: Float32[np.ndarray, "lh lw"]
    step: int
    box: int
    share: float


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


def describe(
    integral: Int32[np.ndarray, "h1 w1"],
    points: Float32[np.ndarray, "n 2"],
    scales: Float32[np.ndarray, " n"],
    num_parts: int,
) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, "n 64"]]:
    """Return angles in radians and descriptors of key points at these scales (sigma, pixels)."""
    angles = np.zeros(len(points), np.float32)
    descriptors = np.empty((len(points), DESCRIPTOR_LENGTH), np.float32)
    # OpenCV averages over a whole number of pixels a side
    num_samples = PATCH_SIZE + 1
    spacings = (np.floor(num_samples * scales) / num_samples).astype(np.float32)
    level_idx = np.searchsorted(LEVEL_SPACINGS[:-1] * np.sqrt(LEVEL_RATIO), spacings)
    used = np.unique(level_idx).tolist()
    levels = {k: _empty_level(integral, float(LEVEL_SPACINGS[k])) for k in used}

    def bounds(length: int, part: int) -> tuple[int, int]:
        return length * part // num_parts, length * (part + 1) // num_parts

    def prepare_part(part: int, _: int) -> None:
        for level in levels.values():
            smoothed = level.pixels, *bounds(len(level.pixels), part)
            _smooth_rows(integral, level.box, level.share, level.step, *smoothed)
        rows = rows_by_y[slice(*bounds(len(points), part))]
        _orient(integral, points, scales, rows, angles)

    def describe_part(part: int, _: int) -> None:
        for k, level in levels.items():
            rows = rows_by_y[level_idx[rows_by_y] == k]
            rows, offset = rows[slice(*bounds(len(rows), part))], (level.box + 1) / 2
            given = points, spacings, angles, rows, descriptors
            _describe_rows(level.pixels, offset, level.step, *given)

    # From the top of the image down, so that the reads of a thread stay in its core's cache.
    rows_by_y = np.argsort(points[:, 1], kind="stable")
    parallel_for_rows(prepare_part, num_parts, num_parts)
    parallel_for_rows(describe_part, num_parts, num_parts)
    return angles, descriptors


@kernel(fastmath=True, error_model="numpy")
def _smooth_rows(integral, box, share, step, level, first, last):
    """Write rows [first, last) of `level`. Each pixel, at every step-th image pixel, mixes two
    means: `share` of the mean over box x box, and the rest over a box of side box + 2.

    At pixel (0, 0) of the level the larger box touches the upper left corner of the image.
    """
    inner = np.float32(share / (box * box))
    outer = np.float32((1 - share) / ((box + 2) * (box + 2)))
    width = integral.shape[1]
    line = np.empty(width - (box + 2), np.float32)
    columns, larger = np.empty(width, np.int32), box + 2
    columns_inner = np.empty(width, np.int32)
    for i in range(first, last):
        row = i * step
        top, bottom = integral[row], integral[row + larger]
        top_inner, bottom_inner = integral[row + 1], integral[row + 1 + box]
        for x in range(width):
            columns[x] = np.int32(bottom[x] - top[x])
            columns_inner[x] = np.int32(bottom_inner[x] - top_inner[x])
        right = columns[larger:]
        left_inner, right_inner = columns_inner[1:], columns_inner[1 + box :]
        # Compute the whole line although only every step-th pixel is kept: only reads without a
        # stride vectorise.
        target = level[i] if step == 1 else line
        for x in range(line.shape[0]):
            target[x] = (
                np.float32(np.int32(right[x] - columns[x])) * outer
                + np.float32(np.int32(right_inner[x] - left_inner[x])) * inner
            )
        if step > 1:
            for j in range(level.shape[1]):
                level[i, j] = line[j * step]


@kernel(fastmath=True, error_model="numpy")
def _haar_samples(integral, centre_x, centre_y, scale, corners, weights, gradients):
    """Fill gradients (2, n) with the weighted Haar responses (side about 4 s) around a key point.
    They are zero beyond the image.

    corners and weights (n,) are scratch space. A first loop, which vectorises, computes the places
    of all windows. A second one computes their sums.
    """
    stride = np.int32(integral.shape[1])
    half = np.int32(np.rint(np.float32(2.0) * scale))
    side = np.int32(2 * half)
    last_x, last_y = np.int32(integral.shape[1] - side), np.int32(integral.shape[0] - side)
    start_x = centre_x - (side - 1) * np.float32(0.5)
    start_y = centre_y - (side - 1) * np.float32(0.5)
    for k in range(corners.shape[0]):
        x = np.int32(np.rint(start_x + ORIENTATION_SAMPLES[0, k] * scale))
        y = np.int32(np.rint(start_y + ORIENTATION_SAMPLES[1, k] * scale))
        inside = (x >= 0) & (y >= 0) & (x < last_x) & (y < last_y)
        corners[k] = np.int32(y * stride + x) if inside else np.int32(0)
        weights[k] = ORIENTATION_SAMPLES[2, k] if inside else np.float32(0.0)
    a_flat = integral.ravel()
    b_flat, c_flat = a_flat[half:], a_flat[side:]
    d_flat, f_flat = a_flat[half * stride :], a_flat[half * stride + side :]
    g_flat = a_flat[side * stride :]
    h_flat, i_flat = g_flat[half:], g_flat[side:]
    for k in range(corners.shape[0]):
        at = np.uintp(corners[k])
        rising, falling = np.int32(i_flat[at] - a_flat[at]), np.int32(g_flat[at] - c_flat[at])
        across = np.int32(rising - 2 * (h_flat[at] - b_flat[at]) + falling)
        down = np.int32(rising - 2 * (f_flat[at] - d_flat[at]) - falling)
        gradients[0, k] = np.float32(across) * weights[k]
        gradients[1, k] = np.float32(down) * weights[k]


@kernel(fastmath=True, error_model="numpy")
def _sectors(gradients, sectors, first_degree):
    """Compute the sector of each gradient's direction, rounded to whole degrees. `first_degree` (2,
    n) repeats the gradients at a sector's first degree.

    The arc tangent is a polynomial, exact to 0.001 degrees and without branches, so that the loop
    vectorises.
    """
    for k in range(sectors.shape[0]):
        x, y = gradients[0, k], gradients[1, k]
        ax, ay = abs(x), abs(y)
        ratio = min(ax, ay) / max(max(ax, ay), np.float32(1e-30))
        square = ratio * ratio
        angle = np.float32(-0.01172120) * square + np.float32(0.05265332)
        angle = angle * square - np.float32(0.11643287)
        angle = angle * square + np.float32(0.19354346)
        angle = angle * square - np.float32(0.33262347)
        angle = (angle * square + np.float32(0.99997726)) * ratio * np.float32(180 / np.pi)
        angle = np.float32(90.0) - angle if ay > ax else angle
        angle = np.float32(180.0) - angle if x < 0 else angle
        angle = np.float32(360.0) - angle if y < 0 else angle
        degree = np.int32(angle + np.float32(0.5))
        degree = np.int32(0) if degree >= 360 else degree
        sector = np.int32(np.float32(degree) * np.float32(1 / SECTOR_DEG) + np.float32(0.1))
        is_first = degree == sector * np.int32(SECTOR_DEG)
        sectors[k] = sector
        first_degree[0, k] = x if is_first else np.float32(0.0)
        first_degree[1, k] = y if is_first else np.float32(0.0)


@kernel(fastmath=True, error_model="numpy")
def _dominant_angle(gradients, sectors, first_degree, sums, threes, windows):
    """Return the direction of the longest sum of gradients within any window of 60 degrees (Bay et
    al. 2008, 4.1).

    Windows are centred on multiples of 5 degrees and open, 59 whole degrees wide: twelve sectors
    without the first degree.
    """
    num_sectors = windows.shape[1]
    sums[:] = 0
    windows[:] = 0
    for axis in range(2):
        for k in range(sectors.shape[0]):
            sums[axis, sectors[k]] += gradients[axis, k]
            windows[axis, sectors[k]] -= first_degree[axis, k]
        for sector in range(WINDOW_SECTORS):
            sums[axis, num_sectors + sector] = sums[axis, sector]
        for first in range(threes.shape[0]):
            threes[first] = sums[axis, first] + sums[axis, first + 1] + sums[axis, first + 2]
        for first in range(num_sectors):
            windows[axis, first] += (
                threes[first] + threes[first + 3] + threes[first + 6] + threes[first + 9]
            )
    best, best_x, best_y = np.float32(-1.0), np.float32(0.0), np.float32(0.0)
    for first in range(num_sectors):
        x, y = windows[0, first], windows[1, first]
        length = x * x + y * y
        if length > best:
            best, best_x, best_y = length, x, y
    return np.arctan2(best_y, best_x)


@kernel(error_model="numpy")
def _orient(integral, points, scales, rows, angles):
    """Fill angles[rows] for the key points at points[rows] (x, y) with scales[rows]."""
    num_samples, num_sectors = ORIENTATION_SAMPLES.shape[1], 360 // SECTOR_DEG
    corners, sectors = np.empty(num_samples, np.int32), np.empty(num_samples, np.int32)
    weights = np.empty(num_samples, np.float32)
    gradients = np.empty((2, num_samples), np.float32)
    first_degree = np.empty_like(gradients)
    sums = np.empty((2, num_sectors + WINDOW_SECTORS), np.float32)
    threes = np.empty(num_sectors + WINDOW_SECTORS - 3, np.float32)
    windows = np.empty((2, num_sectors), np.float32)
    for row in rows:
        _haar_samples(
            integral, points[row, 0], points[row, 1], scales[row], corners, weights, gradients
        )
        _sectors(gradients, sectors, first_degree)
        angles[row] = _dominant_angle(gradients, sectors, first_degree, sums, threes, windows)


@kernel(fastmath=True, error_model="numpy")
def _sample_patch(level, origin_x, origin_y, step_x, step_y, indices, fractions, patch):
    """Sample `level` bilinearly on the grid origin + column * (step_x, step_y) + row * (-step_y,
    step_x), clamped to the image."""
    stride = np.int32(level.shape[1])
    max_left, max_top = np.int32(level.shape[1] - 2), np.int32(level.shape[0] - 2)
    max_x, max_y = np.float32(level.shape[1] - 1), np.float32(level.shape[0] - 1)
    for k in range(indices.shape[0]):
        x = origin_x + GRID_COLUMNS[k] * step_x - GRID_ROWS[k] * step_y
        y = origin_y + GRID_COLUMNS[k] * step_y + GRID_ROWS[k] * step_x
        x, y = min(max(x, np.float32(0.0)), max_x), min(max(y, np.float32(0.0)), max_y)
        left, top = min(np.int32(x), max_left), min(np.int32(y), max_top)
        fractions[0, k] = x - np.float32(left)
        fractions[1, k] = y - np.float32(top)
        indices[k] = np.int32(top * stride + left)
    flat = level.ravel()
    right, below, diagonal = flat[1:], flat[stride:], flat[stride + 1 :]
    for k in range(indices.shape[0]):
        i = np.uintp(indices[k])
        fraction = fractions[0, k]
        upper = flat[i] + fraction * (right[i] - flat[i])
        lower = below[i] + fraction * (diagonal[i] - below[i])
        patch[k] = upper + fractions[1, k] * (lower - upper)


@kernel(fastmath=True, error_model="numpy")
def _describe_patch(patch, sums, descriptor):
    """Compute the descriptor of a (21, 21) patch: Gaussian-weighted sums of dx, dy, |dx|, |dy| in
    4x4 cells, scaled to unit length (Bay et al. 2008, 4.2)."""
    side = PATCH_SIZE + 1
    cell = PATCH_SIZE // 4
    square = np.float32(0.0)
    for cell_y in range(4):
        sums[:] = 0
        for y in range(cell_y * cell, cell_y * cell + cell):
            upper, lower, weights = patch[y * side :], patch[y * side + side :], PATCH_WEIGHTS[y]
            for x in range(PADDED_SIZE):
                falling = (lower[x + 1] - upper[x]) * weights[x]
                rising = (upper[x + 1] - lower[x]) * weights[x]
                dx, dy = falling + rising, falling - rising
                sums[0, x] += dx
                sums[1, x] += dy
                sums[2, x] += abs(dx)
                sums[3, x] += abs(dy)
        for cell_x in range(4):
            for part in range(4):
                total = np.float32(0.0)
                for x in range(cell_x * cell, cell_x * cell + cell):
                    total += sums[part, x]
                descriptor[(cell_y * 4 + cell_x) * 4 + part] = total
                square += total * total
    scale = np.float32(1.0) / np.sqrt(max(square, np.float32(1e-20)))
    for k in range(descriptor.shape[0]):
        descriptor[k] *= scale


@kernel(error_model="numpy")
def _describe_rows(level, offset, level_step, points, spacings, angles, rows, descriptors):
    """Fill descriptors[rows] from one level of the pyramid, whose pixel (0, 0) is at (offset,
    offset) of the image."""
    side = PATCH_SIZE + 1
    indices, fractions = np.empty(side * side, np.int32), np.empty((2, side * side), np.float32)
    patch = np.zeros(side * side + PADDED_SIZE, np.float32)
    sums = np.empty((4, PADDED_SIZE), np.float32)
    per_pixel = 1.0 / level_step
    for row in rows:
        step_x = np.cos(angles[row]) * spacings[row] * per_pixel
        step_y = np.sin(angles[row]) * spacings[row] * per_pixel
        origin_x = (points[row, 0] - offset) * per_pixel - (step_x - step_y) * (PATCH_SIZE // 2)
        origin_y = (points[row, 1] - offset) * per_pixel - (step_x + step_y) * (PATCH_SIZE // 2)
        _sample_patch(
            level,
            np.float32(origin_x),
            np.float32(origin_y),
            np.float32(step_x),
            np.float32(step_y),
            indices,
            fractions,
            patch,
        )
        _describe_patch(patch, sums, descriptors[row])
