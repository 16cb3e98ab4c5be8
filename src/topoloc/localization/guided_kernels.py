"""Numba kernel of guided matching: which key point lies where a map point must be seen, and looks like it?"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def match_projections(projections, map_descriptors, points_img, descriptors, width, height, radius, min_similarity, min_margin):
    """For every map point (row of `projections`, NaN where out of view) the key point within `radius` pixels that is most similar.

    Returns the key point's row for each map point, -1 for none, and the similarity (scalar product). Of several key points
    within the radius the best must lead by `min_margin`, unless they lie within two pixels of each other: one blob found at two scales.
    """
    num_columns, num_rows = int(width / radius) + 1, int(height / radius) + 1
    num_cells = num_columns * num_rows
    cells = np.empty(len(points_img), np.int64)
    starts = np.zeros(num_cells + 1, np.int64)
    for k in range(len(points_img)):
        column = min(max(int(points_img[k, 0] / radius), 0), num_columns - 1)
        row = min(max(int(points_img[k, 1] / radius), 0), num_rows - 1)
        cells[k] = row * num_columns + column
        starts[cells[k] + 1] += 1
    starts = np.cumsum(starts)
    order = np.argsort(cells, kind="mergesort")
    found = np.full(len(projections), -1, np.int32)
    similarities = np.zeros(len(projections), np.float32)
    for n in range(len(projections)):
        x, y = projections[n, 0], projections[n, 1]
        if not (x > -radius and y > -radius and x < width + radius and y < height + radius):
            continue
        column, row = int(np.floor(x / radius)), int(np.floor(y / radius))
        best, second, best_k = np.float32(-2), np.float32(-2), -1
        for r in range(max(row - 1, 0), min(row + 2, num_rows)):
            for c in range(max(column - 1, 0), min(column + 2, num_columns)):
                cell = r * num_columns + c
                for position in range(starts[cell], starts[cell + 1]):
                    k = order[position]
                    dx, dy = points_img[k, 0] - x, points_img[k, 1] - y
                    if dx * dx + dy * dy > radius * radius:
                        continue
                    product = np.float32(0)
                    for d in range(descriptors.shape[1]):
                        product += descriptors[k, d] * map_descriptors[n, d]
                    if product > best:
                        if best_k < 0 or abs(points_img[k, 0] - points_img[best_k, 0]) + abs(points_img[k, 1] - points_img[best_k, 1]) > 2:
                            second = best
                        best, best_k = product, k
                    elif product > second and (
                        abs(points_img[k, 0] - points_img[best_k, 0]) + abs(points_img[k, 1] - points_img[best_k, 1]) > 2
                    ):
                        second = product
        if best_k >= 0 and best >= min_similarity and best - second >= min_margin:
            found[n], similarities[n] = best_k, best
    return found, similarities
