"""Numba kernel of `matching`: nearest neighbour and ratio test in rows of scalar products."""

import numpy as np
from numba import njit

CHUNK = 256


@njit(nogil=True, cache=True)
def _are_twins(points, radii, a, b):
    squared = np.float32(0.0)
    for axis in range(3):
        squared += (points[a, axis] - points[b, axis]) ** 2
    return squared <= max(radii[a], radii[b]) ** 2


@njit(nogil=True, cache=True)
def find_unrivalled(products, largest, ratio, points, radii, out_idx):
    """For each row: the column of its largest product (given as `largest`), -1 if a rival comes within the ratio test.

    Column k belongs to the map point `points[k]`; columns within `radii` of the winner's point are its twins and no rivals.
    No points at all (0, 3): every other column is a rival. A ratio of 0 switches the test off.
    """
    num_columns = products.shape[1]
    near = np.empty(num_columns, np.int32)
    for row_idx in range(products.shape[0]):
        row, best = products[row_idx], largest[row_idx]
        # d1 < ratio * d2 with d^2 = 2 - 2 product; a rival reaches this product
        limit = np.float32(1.0 - (1.0 - best) / ratio**2) if ratio > 0.0 else best
        num_near, winner = 0, -1
        for start in range(0, num_columns, CHUNK):
            stop = min(start + CHUNK, num_columns)
            count = np.int32(0)
            for column in range(start, stop):  # without a branch, so that it runs eight columns at a time
                count += np.int32(row[column] >= limit)
            if count == 0:
                continue
            for column in range(start, stop):
                if row[column] == best and winner < 0:
                    winner = column
                elif row[column] >= limit:
                    near[num_near] = column
                    num_near += 1
        if ratio > 0.0:
            for k in range(num_near):
                if len(points) == 0 or not _are_twins(points, radii, winner, near[k]):
                    winner = -1
                    break
        out_idx[row_idx] = winner
