"""Numba kernels of `learned`: maxima of the scores, descriptors between the grid's points."""

import numpy as np

from topoloc.compiled import kernel

_RADIUS = 2


@kernel()
def find_maxima(scores, height, width, border, min_score):
    """Pixels (x, y) that score more than all others within two pixels, moved to the top of the parabola through each and its neighbours;
    and their scores. Of equal ones the first counts. The picture has `height` rows and `width` columns, the scores may have more."""
    points, found = np.empty((height * width // 9 + 1, 2), np.float32), np.empty(height * width // 9 + 1, np.float32)
    count = 0
    for y in range(max(border, _RADIUS), height - max(border, _RADIUS)):
        row = scores[y]
        for x in range(max(border, _RADIUS), width - max(border, _RADIUS)):
            score = row[x]
            if score <= min_score or score <= row[x - 1] or score < row[x + 1]:
                continue
            if not _is_maximum(scores, y, x):
                continue
            points[count, 0] = x + _top(row[x - 1], score, row[x + 1])
            points[count, 1] = y + _top(scores[y - 1, x], score, scores[y + 1, x])
            found[count] = score
            count += 1
    return points[:count].copy(), found[:count].copy()


@kernel()
def _is_maximum(scores, y, x):
    score = scores[y, x]
    for v in range(y - _RADIUS, y + _RADIUS + 1):
        for u in range(x - _RADIUS, x + _RADIUS + 1):
            if scores[v, u] > score or (scores[v, u] == score and (v < y or (v == y and u < x))):
                return False
    return True


@kernel()
def _top(before, here, after):
    """Where the parabola through the logarithms of three scores, at -1, 0 and 1, has its top; within half a pixel."""
    a, b, c = np.log(before + np.float32(1e-6)), np.log(here + np.float32(1e-6)), np.log(after + np.float32(1e-6))
    bend = a - 2 * b + c
    if bend > -1e-6:
        return np.float32(0.0)
    return np.float32(min(max(0.5 * (a - c) / bend, -0.5), 0.5))


@kernel()
def sample_descriptors(dense, points_img, stride):
    """(n, d) descriptors of unit length, bilinear between those of the grid; pixel x lies at (x + 0.5) / stride - 0.5 in it."""
    size, rows, columns = dense.shape
    out = np.empty((len(points_img), size), np.float32)
    for k in range(len(points_img)):
        u = min(max((points_img[k, 0] + np.float32(0.5)) / stride - np.float32(0.5), np.float32(0)), np.float32(columns - 1))
        v = min(max((points_img[k, 1] + np.float32(0.5)) / stride - np.float32(0.5), np.float32(0)), np.float32(rows - 1))
        x, y = min(int(u), columns - 2), min(int(v), rows - 2)
        s, t = np.float32(u - x), np.float32(v - y)
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
def turned_to_unit_length(planes):
    """(rows, columns, d) descriptors of unit length, of (d, rows, columns) of any."""
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


@kernel(error_model="numpy", fastmath={"reassoc", "contract"})
def is_most_similar_here(grid, points_img, descriptors, stride, radius):
    """For each point: is the descriptor most like its own, of those within `radius` grid steps to each side, within one step of it?"""
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
