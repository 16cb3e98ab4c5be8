"""Numba kernels of `matching`: scalar products of descriptors; nearest neighbour and ratio test in rows of them.

The product is our own because a threaded BLAS waits for its other threads by spinning: beside any other busy program each
call then costs a time slice of the scheduler, some 15 ms. It reaches about two thirds of BLAS's speed.
"""

import numpy as np

from topoloc.compiled import kernel

CHUNK = 256
TILE = 64  # columns of a block of train descriptors, which stays in the first-level cache
ROWS = 2  # query rows worked on together, and components: what the registers hold
GROUP = 4


@kernel(fastmath={"contract"})
def multiply(query, packed, out):
    """out[i, j] = query[i] . train[j]; the rows of `query` are a multiple of ROWS, `packed` is made by `matching._packed`."""
    sums = np.empty(ROWS * TILE, np.float32)
    for tile in range(packed.shape[0]):
        for i in range(0, query.shape[0] - ROWS + 1, ROWS):
            sums[:] = np.float32(0.0)
            for k in range(packed.shape[1]):
                t = packed[tile, k]
                a0, a1, a2, a3 = query[i, 4 * k], query[i, 4 * k + 1], query[i, 4 * k + 2], query[i, 4 * k + 3]
                b0, b1, b2, b3 = query[i + 1, 4 * k], query[i + 1, 4 * k + 1], query[i + 1, 4 * k + 2], query[i + 1, 4 * k + 3]
                for j in range(TILE):
                    t0, t1, t2, t3 = t[j], t[TILE + j], t[2 * TILE + j], t[3 * TILE + j]
                    sums[j] = sums[j] + a0 * t0 + a1 * t1 + a2 * t2 + a3 * t3
                    sums[TILE + j] = sums[TILE + j] + b0 * t0 + b1 * t1 + b2 * t2 + b3 * t3
            for row in range(ROWS):
                for j in range(TILE):
                    out[i + row, tile * TILE + j] = sums[row * TILE + j]


@kernel()
def find_alike(query, packed, num_columns, least, found, count):
    """Append (row, column) of all products of at least `least` to `found` (k, 2), which holds `count` of them; returns the (grown) array
    and the new count. `query` and `packed` as of `multiply`; columns from `num_columns` on do not count."""
    products = np.empty((ROWS, TILE * packed.shape[0]), np.float32)
    for i in range(0, query.shape[0] - ROWS + 1, ROWS):
        multiply(query[i : i + ROWS], packed, products)
        for row in range(ROWS):
            total = np.int32(0)
            for column in range(num_columns):  # without a branch, so that it runs eight columns at a time
                total += np.int32(products[row, column] >= least)
            if total == 0:
                continue
            while count + total > found.shape[0]:
                found = np.concatenate((found, np.empty_like(found)))
            for column in range(num_columns):
                if products[row, column] >= least:
                    found[count, 0] = i + row
                    found[count, 1] = column
                    count += 1
    return found, count


@kernel()
def _are_twins(points, radii, a, b):
    squared = np.float32(0.0)
    for axis in range(3):
        squared += (points[a, axis] - points[b, axis]) ** 2
    return squared <= max(radii[a], radii[b]) ** 2


@kernel()
def reject_rivalled(products, num_columns, winners, ratio, points, radii, out_product):
    """Set the winner of each row (the column of its largest product) to -1 if a rival comes within the ratio test, or it is NaN.

    Columns from `num_columns` on do not count. Column k belongs to the map point `points[k]`; columns within `radii` of the winner's point
    are its twins and no rivals. No points at all (0, 3): every other column is a rival. A ratio of 0 switches the test off.
    """
    for row_idx in range(products.shape[0]):
        row, winner = products[row_idx], winners[row_idx]
        best = row[winner]
        out_product[row_idx] = best
        if np.isnan(best):
            winners[row_idx] = -1
        if np.isnan(best) or ratio <= 0.0:
            continue
        # d1 < ratio * d2 with d^2 = 2 - 2 product; a rival reaches this product; rounding may lift `best` above 1
        limit = min(best, np.float32(1.0 - (1.0 - best) / ratio**2))
        for start in range(0, num_columns, CHUNK):
            stop = min(start + CHUNK, num_columns)
            count = np.int32(0)
            for column in range(start, stop):  # without a branch, so that it runs eight columns at a time
                count += np.int32(row[column] >= limit)
            if count == 0:
                continue
            for column in range(start, stop):
                if row[column] >= limit and column != winner and (len(points) == 0 or not _are_twins(points, radii, winner, column)):
                    winners[row_idx] = -1
                    break
            if winners[row_idx] < 0:
                break
