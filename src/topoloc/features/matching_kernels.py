"""Implement the Numba kernels of `matching`: scalar products of descriptors, nearest neighbour and
ratio test.

The product does not use a BLAS. A threaded BLAS waits for its threads in a busy loop. Beside
another busy program each call then costs a time slice of the scheduler, some 15 ms. This kernel is
about as fast as a BLAS on one thread.
"""

import numpy as np

from topoloc.compiled import kernel

# Columns of a block of train descriptors, which stays in the first-level cache. With a power of
# two, rows would share its lines.
TILE = 96
ROWS = 2  # query rows processed together; with GROUP components they fit into the registers
GROUP = 4
# A multiple of ROWS. Their products are read again while they are still in the cache.
ROWS_AT_ONCE = 32


@kernel(fastmath={"contract"})
def multiply(query, packed, out):
    """Compute out[i, j] = query[i] . train[j]. The number of query rows must be a multiple of ROWS.
    `packed` comes from `matching._packed`."""
    sums = np.empty(ROWS * TILE, np.float32)
    for tile in range(packed.shape[0]):
        for i in range(0, query.shape[0] - ROWS + 1, ROWS):
            sums[:] = np.float32(0.0)
            a, b = query[i], query[i + 1]
            for k in range(packed.shape[1]):
                t = packed[tile, k]
                a0, a1, a2, a3 = a[4 * k], a[4 * k + 1], a[4 * k + 2], a[4 * k + 3]
                b0, b1, b2, b3 = b[4 * k], b[4 * k + 1], b[4 * k + 2], b[4 * k + 3]
                for j in range(TILE):
                    t0, t1, t2, t3 = t[j], t[TILE + j], t[2 * TILE + j], t[3 * TILE + j]
                    sums[j] = sums[j] + a0 * t0 + a1 * t1 + a2 * t2 + a3 * t3
                    sums[TILE + j] = sums[TILE + j] + b0 * t0 + b1 * t1 + b2 * t2 + b3 * t3
            for row in range(ROWS):
                for j in range(TILE):
                    out[i + row, tile * TILE + j] = sums[row * TILE + j]


@kernel()
def find_similar(query, packed, num_columns, least):
    """Return (row, column) of all products of at least `least`, an array (k, 2).

    `query` and `packed` are those of `multiply`. Columns from `num_columns` on are ignored.
    """
    products = np.empty((ROWS, TILE * packed.shape[0]), np.float32)
    found, count = np.empty((1024, 2), np.int64), 0
    for i in range(0, query.shape[0] - ROWS + 1, ROWS):
        multiply(query[i : i + ROWS], packed, products)
        for row in range(ROWS):
            total = np.int32(0)
            for column in range(num_columns):  # without branches, so that the loop vectorises
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
    return found[:count]


@kernel()
def largest_products(rows, packed, out):
    """Raise out[column] to the largest product of a row with it. `rows` and `packed` are `query`
    and `packed` of `multiply`."""
    products = np.empty((ROWS, TILE * packed.shape[0]), np.float32)
    for i in range(0, rows.shape[0] - ROWS + 1, ROWS):
        multiply(rows[i : i + ROWS], packed, products)
        for row in range(ROWS):
            for column in range(len(out)):
                product = products[row, column]
                out[column] = product if product > out[column] else out[column]


@kernel()
def _are_duplicates(points, radii, a, b):
    squared = np.float32(0.0)
    for axis in range(3):
        squared += (points[a, axis] - points[b, axis]) ** 2
    return squared <= max(radii[a], radii[b]) ** 2


@kernel()
def find_nearest(
    query, packed, num_columns, ratio, points, radii, out_winner, out_product, column_largest
):
    """Write the column of the largest product of each query row (the first of equal ones) and that
    product.

    The column is -1 if the winner fails the ratio test or if no product is comparable (NaN).
    `query` and `packed` are those of `multiply`. Columns from `num_columns` on are ignored.

    Column k belongs to the map point `points[k]`. Columns within `radii` of the winner's point are
    duplicates and not rivals. Without points (0, 3), every other column is a rival. A ratio of 0
    disables the test. The length of `out_winner` is the number of query rows. `column_largest` is
    updated with the largest product of each column.
    """
    table = np.empty((ROWS_AT_ONCE, TILE * packed.shape[0]), np.float32)
    lanes = np.empty(TILE, np.float32)
    for start in range(0, query.shape[0], ROWS_AT_ONCE):
        stop = min(start + ROWS_AT_ONCE, query.shape[0])
        multiply(query[start:stop], packed, table)
        for k in range(min(stop, len(out_winner)) - start):
            row = table[k]
            row[num_columns:] = -np.inf  # so that whole tiles can be searched
            best = _row_maximum(row, lanes, column_largest)
            out_product[start + k] = best
            out_winner[start + k] = (
                -1 if best == -np.inf else _find_unambiguous(row, lanes, best, ratio, points, radii)
            )


@kernel()
def _row_maximum(row, lanes, column_largest):
    """Return the maximum of whole tiles of products. NaN is ignored. `lanes[j]` becomes the maximum
    over column j of all tiles."""
    lanes[:] = -np.inf
    for tile in range(len(row) // TILE):
        part = row[tile * TILE : (tile + 1) * TILE]
        above = column_largest[tile * TILE : (tile + 1) * TILE]
        for j in range(TILE):  # each lane by itself, so that the loop vectorises
            lanes[j] = part[j] if part[j] > lanes[j] else lanes[j]
        for j in range(TILE):
            above[j] = part[j] if part[j] > above[j] else above[j]
    best = lanes[0]
    for j in range(1, TILE):
        best = max(best, lanes[j])
    return best


@kernel()
def _find_unambiguous(row, lanes, best, ratio, points, radii):
    """Return the first column with the largest product, or -1 if it has a rival. Only lanes that
    can hold such columns are searched."""
    winner = len(row)
    for j in range(TILE):
        if lanes[j] == best:
            for column in range(j, winner, TILE):
                if row[column] == best:
                    winner = column
                    break
    if ratio <= 0.0:
        return winner
    # d1 < ratio * d2 with d^2 = 2 - 2 product. A rival reaches this product. Rounding may raise
    # `best` above 1.
    limit = min(best, np.float32(1.0 - (1.0 - best) / ratio**2))
    for j in range(TILE):
        if lanes[j] >= limit:
            for column in range(j, len(row), TILE):
                if (
                    row[column] >= limit
                    and column != winner
                    and (len(points) == 0 or not _are_duplicates(points, radii, winner, column))
                ):
                    return -1
    return winner
