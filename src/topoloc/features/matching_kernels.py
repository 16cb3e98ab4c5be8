"""Numba kernels of `matching`: scalar products of descriptors; nearest neighbour and ratio test in
rows of them.

The product is our own because a threaded BLAS waits for its other threads by spinning: beside any
other busy program each call then costs a time slice of the scheduler, some 15 ms. It is about as
fast as a BLAS on one thread.
"""

import numpy as np

from topoloc.compiled import kernel

# columns of a block of train descriptors, which stays in the first-level cache; rows of a power of
# two would share its lines
TILE = 96
ROWS = 2  # query rows worked on together, and components: what the registers hold
GROUP = 4
ROWS_AT_ONCE = (
    32  # a multiple of ROWS; their products are read again while they are still in the cache
)


@kernel(fastmath={"contract"})
def multiply(query, packed, out):
    """out[i, j] = query[i] . train[j]; the rows of `query` are a multiple of ROWS, `packed` is made
    by `matching._packed`."""
    sums = np.empty(ROWS * TILE, np.float32)
    for tile in range(packed.shape[0]):
        for i in range(0, query.shape[0] - ROWS + 1, ROWS):
            sums[:] = np.float32(0.0)
            for k in range(packed.shape[1]):
                t = packed[tile, k]
                a0, a1, a2, a3 = (
                    query[i, 4 * k],
                    query[i, 4 * k + 1],
                    query[i, 4 * k + 2],
                    query[i, 4 * k + 3],
                )
                b0, b1, b2, b3 = (
                    query[i + 1, 4 * k],
                    query[i + 1, 4 * k + 1],
                    query[i + 1, 4 * k + 2],
                    query[i + 1, 4 * k + 3],
                )
                for j in range(TILE):
                    t0, t1, t2, t3 = t[j], t[TILE + j], t[2 * TILE + j], t[3 * TILE + j]
                    sums[j] = sums[j] + a0 * t0 + a1 * t1 + a2 * t2 + a3 * t3
                    sums[TILE + j] = sums[TILE + j] + b0 * t0 + b1 * t1 + b2 * t2 + b3 * t3
            for row in range(ROWS):
                for j in range(TILE):
                    out[i + row, tile * TILE + j] = sums[row * TILE + j]


@kernel()
def find_similar(query, packed, num_columns, least, found, count):
    """Append (row, column) of all products of at least `least` to `found` (k, 2), which holds
    `count` of them; returns the (grown) array and the new count. `query` and `packed` as of
    `multiply`; columns from `num_columns` on do not count."""
    products = np.empty((ROWS, TILE * packed.shape[0]), np.float32)
    for i in range(0, query.shape[0] - ROWS + 1, ROWS):
        multiply(query[i : i + ROWS], packed, products)
        for row in range(ROWS):
            total = np.int32(0)
            for column in range(
                num_columns
            ):  # without a branch, so that it runs eight columns at a time
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
def _are_duplicates(points, radii, a, b):
    squared = np.float32(0.0)
    for axis in range(3):
        squared += (points[a, axis] - points[b, axis]) ** 2
    return squared <= max(radii[a], radii[b]) ** 2


@kernel()
def find_nearest(
    query, packed, num_columns, ratio, points, radii, out_winner, out_product, column_largest
):
    """Of each query row the column of its largest product (the first of equal ones) and that
    product; -1 if a rival comes within the ratio test, or where nothing is comparable (NaN).

    `query` and `packed` are as `multiply` takes them, of which columns from `num_columns` on do not
    count. Column k belongs to the map point `points[k]`; columns within `radii` of the winner's
    point are its twins and no rivals. No points at all (0, 3): every other column is a rival. A
    ratio of 0 switches the test off. There are as many rows as `out_winner` is long;
    `column_largest` is lifted to the largest product of each column.
    """
    table, lanes = (
        np.empty((ROWS_AT_ONCE, TILE * packed.shape[0]), np.float32),
        np.empty(TILE, np.float32),
    )
    for start in range(0, query.shape[0], ROWS_AT_ONCE):
        stop = min(start + ROWS_AT_ONCE, query.shape[0])
        multiply(query[start:stop], packed, table)
        for k in range(min(stop, len(out_winner)) - start):
            row = table[k]
            row[num_columns:] = -np.inf  # so that whole tiles can be looked at
            best = _row_maximum(row, lanes, column_largest)
            out_product[start + k] = best
            out_winner[start + k] = (
                -1 if best == -np.inf else _find_unambiguous(row, lanes, best, ratio, points, radii)
            )


@kernel()
def _row_maximum(row, lanes, column_largest):
    """Of whole tiles of products; those that are NaN do not count. `lanes[j]` becomes the largest
    of the columns j of all tiles."""
    lanes[:] = -np.inf
    for tile in range(len(row) // TILE):
        part, above = (
            row[tile * TILE : (tile + 1) * TILE],
            column_largest[tile * TILE : (tile + 1) * TILE],
        )
        for j in range(TILE):  # each lane by itself, so that it runs many at a time
            lanes[j] = part[j] if part[j] > lanes[j] else lanes[j]
        for j in range(TILE):
            above[j] = part[j] if part[j] > above[j] else above[j]
    best = lanes[0]
    for j in range(1, TILE):
        best = max(best, lanes[j])
    return best


@kernel()
def _find_unambiguous(row, lanes, best, ratio, points, radii):
    """The first column with the largest product, -1 if it has a rival; only lanes that hold such
    columns are gone through."""
    winner = len(row)
    for j in range(TILE):
        if lanes[j] == best:
            for column in range(j, winner, TILE):
                if row[column] == best:
                    winner = column
                    break
    if ratio <= 0.0:
        return winner
    # d1 < ratio * d2 with d^2 = 2 - 2 product; a rival reaches this product; rounding may lift
    # `best` above 1
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
