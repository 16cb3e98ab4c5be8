"""Numba kernels of `surf`, second half: orientation and descriptor of each key point."""

import numpy as np
from numba import njit

PATCH_SIZE = 20  # samples a side of the described window, in units of the key point's scale s
ORIENTATION_RADIUS = 6  # in units of s
NUM_SECTORS = 72  # steps of 5 degrees for the sliding window
WINDOW_SECTORS = 12  # of 60 degrees


def _gaussian(length, sigma):
    offsets = np.arange(length) - (length - 1) / 2
    weights = np.exp(-(offsets**2) / (2 * sigma**2))
    return weights / weights.sum()


def _orientation_samples():
    """Rows (x, y, weight) of the samples within 6 s of the key point, in units of s; weights of a Gaussian of 2.5 s."""
    radius = ORIENTATION_RADIUS
    x, y = np.meshgrid(np.arange(-radius, radius + 1), np.arange(-radius, radius + 1), indexing="ij")
    inside = x**2 + y**2 <= radius**2
    kernel = _gaussian(2 * radius + 1, 2.5)
    return np.stack([x[inside], y[inside], np.outer(kernel, kernel)[inside]]).astype(np.float32)


ORIENTATION_SAMPLES = _orientation_samples()
PATCH_WEIGHTS = np.outer(_gaussian(PATCH_SIZE, 3.3), _gaussian(PATCH_SIZE, 3.3)).astype(np.float32)


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def box_mean_rows(integral, box, step, level, first, last):
    """Rows [first, last) of `level`: means of the box x box windows whose upper left corners are at multiples of step."""
    scale = np.float32(1.0) / np.float32(box * box)
    for i in range(first, last):
        top, bottom = integral[i * step], integral[i * step + box]
        top_right, bottom_right = top[box:], bottom[box:]
        target = level[i]
        if step == 1:
            for j in range(level.shape[1]):
                target[j] = np.float32(np.int32(bottom_right[j] - bottom[j] - top_right[j] + top[j])) * scale
        else:
            for j in range(level.shape[1]):
                x = j * step
                target[j] = np.float32(np.int32(bottom_right[x] - bottom[x] - top_right[x] + top[x])) * scale


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _haar_samples(integral, centre_x, centre_y, scale, gradients):
    """Fill gradients (2, n) with the weighted Haar responses (side about 4 s) around a key point; returns their number."""
    height, width = integral.shape
    half = np.int64(np.rint(2 * scale))
    side = 2 * half
    start_x, start_y = centre_x - (side - 1) * 0.5, centre_y - (side - 1) * 0.5
    count = 0
    for k in range(ORIENTATION_SAMPLES.shape[1]):
        x = np.int64(np.rint(start_x + ORIENTATION_SAMPLES[0, k] * scale))
        y = np.int64(np.rint(start_y + ORIENTATION_SAMPLES[1, k] * scale))
        if x < 0 or y < 0 or x >= width - side or y >= height - side:
            continue
        a, b, c = integral[y, x], integral[y, x + half], integral[y, x + side]
        d, f = integral[y + half, x], integral[y + half, x + side]
        g, h, i = integral[y + side, x], integral[y + side, x + half], integral[y + side, x + side]
        weight = ORIENTATION_SAMPLES[2, k]
        gradients[0, count] = np.float32(np.int32(i - g - c + a - 2 * (h - b) + 2 * (g - a))) * weight
        gradients[1, count] = np.float32(np.int32(i - g - c + a - 2 * (f - d) + 2 * (c - a))) * weight
        count += 1
    return count


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _sectors(gradients, count, sectors):
    """The 5-degree sector of each gradient, by a polynomial for the arc tangent (error below 0.01 degrees)."""
    per_radian = np.float32(NUM_SECTORS / (2 * np.pi))
    quarter = np.float32(NUM_SECTORS / 4)
    for k in range(count):
        x, y = gradients[0, k], gradients[1, k]
        ax, ay = abs(x), abs(y)
        ratio = min(ax, ay) / max(max(ax, ay), np.float32(1e-30))
        r2 = ratio * ratio
        poly = np.float32(-0.01172120) * r2 + np.float32(0.05265332)
        poly = poly * r2 - np.float32(0.11643287)
        poly = poly * r2 + np.float32(0.19354346)
        poly = poly * r2 - np.float32(0.33262347)
        poly = poly * r2 + np.float32(0.99997726)
        turn = ratio * poly * per_radian
        turn = quarter - turn if ay > ax else turn
        turn = 2 * quarter - turn if x < 0 else turn
        turn = 4 * quarter - turn if y < 0 else turn
        sectors[k] = min(np.int32(turn), np.int32(NUM_SECTORS - 1))


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _dominant_angle(gradients, sectors, count, sums):
    """The direction of the longest sum of gradients within any window of 60 degrees (Bay et al. 2008, 4.1)."""
    sums[:] = 0
    for k in range(count):
        sums[0, sectors[k]] += gradients[0, k]
        sums[1, sectors[k]] += gradients[1, k]
    sums[:, NUM_SECTORS:] = sums[:, :WINDOW_SECTORS]
    best, best_x, best_y = np.float32(-1.0), np.float32(0.0), np.float32(0.0)
    for first in range(NUM_SECTORS):
        x, y = np.float32(0.0), np.float32(0.0)
        for sector in range(first, first + WINDOW_SECTORS):
            x += sums[0, sector]
            y += sums[1, sector]
        length = x * x + y * y
        if length > best:
            best, best_x, best_y = length, x, y
    return np.arctan2(best_y, best_x)


@njit(nogil=True, cache=True, error_model="numpy")
def orient(integral, points, scales, angles):
    """Fill angles (n,) of the key points at points (n, 2) of scales (n,)."""
    gradients = np.zeros((2, ORIENTATION_SAMPLES.shape[1]), np.float32)
    sectors = np.zeros(ORIENTATION_SAMPLES.shape[1], np.int32)
    sums = np.zeros((2, NUM_SECTORS + WINDOW_SECTORS), np.float32)
    for k in range(points.shape[0]):
        count = _haar_samples(integral, points[k, 0], points[k, 1], scales[k], gradients)
        _sectors(gradients, count, sectors)
        angles[k] = _dominant_angle(gradients, sectors, count, sums)


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _sample_patch(level, origin_x, origin_y, step_x, step_y, indices, fractions, patch):
    """Bilinear samples of `level` on the grid origin + column * (step_x, step_y) + row * (-step_y, step_x), clamped to the image."""
    side = PATCH_SIZE + 1
    stride = np.int32(level.shape[1])
    max_x, max_y = np.float32(level.shape[1]) - np.float32(1.001), np.float32(level.shape[0]) - np.float32(1.001)
    for row in range(side):
        row_x, row_y = origin_x - row * step_y, origin_y + row * step_x
        for column in range(side):
            x = min(max(row_x + np.float32(column) * step_x, np.float32(0.0)), max_x)
            y = min(max(row_y + np.float32(column) * step_y, np.float32(0.0)), max_y)
            left, top = np.int32(x), np.int32(y)
            k = row * side + column
            fractions[0, k] = x - np.float32(left)
            fractions[1, k] = y - np.float32(top)
            indices[k] = np.int32(top * stride + left)
    flat = level.ravel()
    right, below, diagonal = flat[1:], flat[stride:], flat[stride + 1 :]
    for k in range(side * side):
        i = np.uintp(indices[k])
        fraction = fractions[0, k]
        upper = flat[i] + fraction * (right[i] - flat[i])
        lower = below[i] + fraction * (diagonal[i] - below[i])
        patch[k] = upper + fractions[1, k] * (lower - upper)


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy")
def _describe_patch(patch, sums, descriptor):
    """Sums of dx, dy, |dx|, |dy| in 4x4 cells of the (21, 21) patch, Gaussian-weighted, to unit length (Bay et al. 2008, 4.2)."""
    side = PATCH_SIZE + 1
    cell = PATCH_SIZE // 4
    square = np.float32(0.0)
    for cell_y in range(4):
        sums[:] = 0
        for y in range(cell_y * cell, cell_y * cell + cell):
            upper, lower, weights = patch[y * side : y * side + side], patch[y * side + side : y * side + 2 * side], PATCH_WEIGHTS[y]
            for x in range(PATCH_SIZE):
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


@njit(nogil=True, cache=True, error_model="numpy")
def describe(level, offset, level_step, points, spacings, angles, rows, descriptors):
    """Fill descriptors[rows] from one level of the pyramid, whose pixel (0, 0) is at (offset, offset) of the image."""
    side = PATCH_SIZE + 1
    indices = np.empty(side * side, np.int32)
    fractions = np.empty((2, side * side), np.float32)
    patch = np.empty(side * side, np.float32)
    sums = np.empty((4, PATCH_SIZE), np.float32)
    per_pixel = 1.0 / level_step
    for row in rows:
        step_x = np.cos(angles[row]) * spacings[row] * per_pixel
        step_y = np.sin(angles[row]) * spacings[row] * per_pixel
        origin_x = (points[row, 0] - offset) * per_pixel - (step_x - step_y) * (PATCH_SIZE // 2)
        origin_y = (points[row, 1] - offset) * per_pixel - (step_x + step_y) * (PATCH_SIZE // 2)
        _sample_patch(level, np.float32(origin_x), np.float32(origin_y), np.float32(step_x), np.float32(step_y), indices, fractions, patch)
        _describe_patch(patch, sums, descriptors[row])
