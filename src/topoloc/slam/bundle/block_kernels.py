"""Numba kernels of `block_system.py`: Cholesky factorisation of a matrix of 6x6 blocks, solution,
and the pairs of key frames that its blocks connect."""

import numpy as np

from topoloc.compiled import kernel

_OPTIONS = {"error_model": "numpy"}


@kernel(**_OPTIONS)
def find_block_idx(starts, rows, row, column):
    """Return the index of block (row, column). `row` must be at or below `column`, and the block
    must exist."""
    low, high = starts[column], starts[column + 1]
    while high - low > 1:
        middle = (low + high) // 2
        if rows[middle] <= row:
            low = middle
        else:
            high = middle
    return low


@kernel(**_OPTIONS)
def _cholesky(matrix):
    """Replace the lower triangle by the Cholesky factor."""
    for i in range(6):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(max(total, 1e-12)) if i == j else total / matrix[j, j]


@kernel(**_OPTIONS)
def _solve_lower(factor, vector):
    for i in range(6):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]


@kernel(**_OPTIONS)
def _solve_upper(factor, vector):
    """Solve with the transpose of `factor`, in place."""
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


@kernel(**_OPTIONS)
def _subtract_product(block, a, b):
    """Compute block - a b', in place."""
    for r in range(6):
        for s in range(6):
            total = 0.0
            for k in range(6):
                total += a[r, k] * b[s, k]
            block[r, s] -= total


@kernel(**_OPTIONS)
def factor_blocks(starts, rows, blocks):
    """Factor `blocks` (b, 6, 6) in place. The upper triangles of the diagonal blocks are not
    changed."""
    for p in range(len(starts) - 1):
        first, last = starts[p], starts[p + 1]
        _cholesky(blocks[first])
        for k in range(first + 1, last):
            for r in range(6):
                _solve_lower(blocks[first], blocks[k, r])
        for k in range(first + 1, last):
            at = starts[rows[k]]
            for other in range(k, last):
                while rows[at] != rows[other]:
                    at += 1
                _subtract_product(blocks[at], blocks[other], blocks[k])


@kernel(**_OPTIONS)
def solve_factored(starts, rows, blocks, vector):
    """Replace `vector` (n, 6) by the solution."""
    num = len(starts) - 1
    for p in range(num):
        _solve_lower(blocks[starts[p]], vector[p])
        for k in range(starts[p] + 1, starts[p + 1]):
            for r in range(6):
                for s in range(6):
                    vector[rows[k], r] -= blocks[k, r, s] * vector[p, s]
    for p in range(num - 1, -1, -1):
        for k in range(starts[p] + 1, starts[p + 1]):
            for r in range(6):
                for s in range(6):
                    vector[p, s] -= blocks[k, r, s] * vector[rows[k], r]
        _solve_upper(blocks[starts[p]], vector[p])


@kernel(**_OPTIONS)
def count_covisible_pairs(starts, keyframe_idx, slots):
    """Count the pairs of free key frames that `find_covisible_pairs` writes, including
    repetitions."""
    total = 0
    for n in range(len(starts) - 1):
        free = 0
        for k in range(starts[n], starts[n + 1]):
            free += slots[keyframe_idx[k]] >= 0
        total += free * (free - 1) // 2
    return total


@kernel(**_OPTIONS)
def find_covisible_pairs(starts, keyframe_idx, slots, num_free, keys):
    """Write i * num_free + j to `keys` for each pair of slots i, j and each point that both see."""
    at = 0
    for n in range(len(starts) - 1):
        for k in range(starts[n], starts[n + 1]):
            for other in range(starts[n], k):
                i, j = slots[keyframe_idx[k]], slots[keyframe_idx[other]]
                if i >= 0 and j >= 0:
                    keys[at] = max(i, j) * num_free + min(i, j)
                    at += 1
