"""Test systems of 6x6 blocks against NumPy's dense solution, and the size of their factors."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.slam.bundle.block_system import BlockPattern, solve_blocks


def dense_of(num: int, pairs: list[tuple[int, int]], seed: int = 0) -> np.ndarray:
    """Return a positive definite matrix. Only the blocks of these pairs are non-zero."""
    rng = np.random.default_rng(seed)
    dense = 0.1 * np.eye(6 * num)
    for i, j in pairs:
        jacobian = np.zeros((6, 6 * num))
        jacobian[:, 6 * i : 6 * i + 6], jacobian[:, 6 * j : 6 * j + 6] = rng.normal(size=(2, 6, 6))
        dense += jacobian.T @ jacobian
    return dense


def blocks_of(dense: np.ndarray, pattern: BlockPattern, pairs: list[tuple[int, int]]) -> np.ndarray:
    blocks = pattern.empty()
    for i, j in [*pairs, *((i, i) for i in range(len(pattern.elimination_idx)))]:
        block_idx, is_first_above = pattern.block_idx(i, j)
        block = dense[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
        blocks[block_idx] = block.T if is_first_above else block
    return blocks


@pytest.mark.parametrize(
    "pairs",
    [
        [],
        [(i, i + 1) for i in range(11)],
        [*((i, i + 1) for i in range(11)), (11, 0), (8, 3), (9, 2)],
        [(0, i) for i in range(1, 12)],
        [(i, j) for i in range(12) for j in range(i)],
    ],
    ids=["apart", "chain", "loops", "star", "all"],
)
def test_the_solution_is_that_of_a_dense_matrix(pairs: list[tuple[int, int]]):
    num = 12
    dense, pattern = dense_of(num, pairs), BlockPattern.from_pairs(num, pairs)
    rights = np.random.default_rng(1).normal(size=(2, num, 6))
    solved = solve_blocks(
        pattern, blocks_of(dense, pattern, pairs), rights[:, np.argsort(pattern.elimination_idx)]
    )[:, pattern.elimination_idx]
    expected = np.linalg.solve(dense, rights.reshape(2, -1).T).T.reshape(2, num, 6)
    np.testing.assert_allclose(solved, expected, rtol=1e-8, atol=1e-10)


def test_a_walk_of_several_laps_has_a_factor_that_grows_with_its_length():
    """Each pose has edges to the six before it, and on later laps to the poses at
    the same place."""

    def laps(length: int, num_laps: int) -> list[tuple[int, int]]:
        num = length * num_laps
        return [
            (i, i - back)
            for i in range(num)
            for back in (*range(1, 7), *range(length - 2, length + 3))
            if back <= i
        ]

    short, long = (
        len(BlockPattern.from_pairs(3 * length, laps(length, 3)).rows) / (3 * length)
        for length in (100, 400)
    )
    assert long < 1.5 * short
    assert long < 60
