"""Implement the Numba kernels of global descriptors: sums of residuals, and products of stored rows
with one vector.

BLAS and FAISS would start threads for these products, which take a fraction of a millisecond.
Waking the threads costs more than they save, and many times more on a busy machine.
"""

import numpy as np

from topoloc.compiled import kernel

_FAST_MATH = {"reassoc", "contract", "arcp"}


@kernel(error_model="numpy", fastmath=_FAST_MATH)
def _dot(a, b):
    total = np.float32(0)
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@kernel(error_model="numpy", fastmath=_FAST_MATH)
def add_residuals(descriptors, words, half_squares, sums):
    """Add each descriptor's unit residual from its nearest word to that word's row of `sums`.
    half_squares = |word|^2 / 2."""
    residual = np.empty(words.shape[1], np.float32)
    for n in range(len(descriptors)):
        descriptor = descriptors[n]
        nearest, best = 0, np.float32(-np.inf)
        for k in range(len(words)):
            # The part of |d - w|^2 that depends on the word.
            score = _dot(descriptor, words[k]) - half_squares[k]
            if score > best:
                nearest, best = k, score
        word, total = words[nearest], sums[nearest]
        for i in range(len(residual)):
            residual[i] = descriptor[i] - word[i]
        scale = np.float32(1) / max(np.sqrt(_dot(residual, residual)), np.float32(1e-6))
        for i in range(len(residual)):
            total[i] += residual[i] * scale


@kernel(error_model="numpy", fastmath=_FAST_MATH)
def multiply_rows(rows, vector, products):
    """Compute products[k] = rows[k] . vector."""
    for k in range(len(rows)):
        products[k] = _dot(rows[k], vector)


@kernel(error_model="numpy", fastmath=_FAST_MATH)
def max_shifted_products(rows, chosen, vector, column, max_shift, products):
    """Compute products[k], the maximum of rows[chosen[k]] . vector over shifts by up to `max_shift`
    columns of `column` numbers in both directions.

    Only columns present in both are multiplied, and the product is divided by their number.
    """
    length = len(vector)
    for k in range(len(chosen)):
        best, row = np.float32(-np.inf), rows[chosen[k]]
        for shift in range(-max_shift, max_shift + 1):
            left, right = max(shift, 0) * column, max(-shift, 0) * column
            both = length - abs(shift) * column
            product = _dot(row[left : left + both], vector[right : right + both])
            best = max(best, product * np.float32(column) / np.float32(both))
        products[k] = best
