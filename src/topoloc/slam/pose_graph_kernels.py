"""Numba kernel: the linear system of a pose graph, by conjugate gradients.

Most edges join a key frame with the one before it: that part of the matrix is block tridiagonal and is solved exactly as the
preconditioner; what is left to iterate over are the loops.
"""

from __future__ import annotations

import numpy as np

from topoloc.compiled import kernel

_OPTIONS = {"error_model": "numpy"}


@kernel(**_OPTIONS)
def _cholesky(matrix, factor):
    size = len(matrix)
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = np.sqrt(max(total, 1e-12)) if i == j else total / factor[j, j]


@kernel(**_OPTIONS)
def _solve_lower(factor, vector):
    for i in range(len(vector)):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]


@kernel(**_OPTIONS)
def _solve_upper(factor, vector):
    """With the transpose of `factor`."""
    for i in range(len(vector) - 1, -1, -1):
        for k in range(i + 1, len(vector)):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


@kernel(**_OPTIONS)
def _factor_chain(diagonal, chain, factors, lowers):
    """Block Cholesky of the tridiagonal part: `chain[n]` is the block (n, n + 1)."""
    size = diagonal.shape[1]
    block = diagonal[0].copy()
    for n in range(len(diagonal)):
        _cholesky(block, factors[n])
        if n + 1 == len(diagonal):
            break
        for column in range(size):  # lowers[n] = chain[n]' factors[n]'^-1
            row = chain[n][:, column].copy()
            _solve_lower(factors[n], row)
            lowers[n, column] = row
        block = diagonal[n + 1] - lowers[n] @ lowers[n].T


@kernel(**_OPTIONS)
def _solve_chain(factors, lowers, vector, out):
    out[:] = vector
    for n in range(len(factors)):
        if n > 0:
            out[n] -= lowers[n - 1] @ out[n - 1]
        _solve_lower(factors[n], out[n])
    for n in range(len(factors) - 1, -1, -1):
        if n + 1 < len(factors):
            out[n] -= lowers[n].T @ out[n + 1]
        _solve_upper(factors[n], out[n])


@kernel(**_OPTIONS)
def _multiply(diagonal, firsts, seconds, blocks, vector, out):
    for n in range(len(diagonal)):
        out[n] = diagonal[n] @ vector[n]
    for e in range(len(firsts)):
        out[firsts[e]] += blocks[e] @ vector[seconds[e]]
        out[seconds[e]] += blocks[e].T @ vector[firsts[e]]


@kernel(**_OPTIONS)
def solve_graph(diagonal, firsts, seconds, blocks, right, max_iterations, tolerance):
    """x (n, 6) with ``H x = right``; H has these diagonal blocks and the block `blocks[e]` at (firsts[e], seconds[e]), and mirrored."""
    num, size = right.shape
    chain = np.zeros((num, size, size))
    for e in range(len(firsts)):
        if seconds[e] == firsts[e] + 1:
            chain[firsts[e]] += blocks[e]
        elif firsts[e] == seconds[e] + 1:
            chain[seconds[e]] += blocks[e].T
    factors, lowers = np.zeros((num, size, size)), np.zeros((num, size, size))
    _factor_chain(diagonal, chain, factors, lowers)
    x, rest, product, direction = np.zeros((num, size)), right.copy(), np.empty((num, size)), np.empty((num, size))
    _solve_chain(factors, lowers, rest, direction)
    preconditioned = direction.copy()
    energy = np.sum(rest * preconditioned)
    goal = tolerance * tolerance * energy
    for _ in range(max_iterations):
        if energy <= goal:
            break
        _multiply(diagonal, firsts, seconds, blocks, direction, product)
        step = energy / np.sum(direction * product)
        x += step * direction
        rest -= step * product
        _solve_chain(factors, lowers, rest, preconditioned)
        new_energy = np.sum(rest * preconditioned)
        direction = preconditioned + new_energy / energy * direction
        energy = new_energy
    return x
