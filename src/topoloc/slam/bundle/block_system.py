"""Solve sparse symmetric positive definite systems of 6x6 blocks, for connected poses.

The Cholesky factor has more blocks than the matrix, because eliminating an unknown connects all of
its neighbours. The unknown with the fewest neighbours is eliminated first (George & Liu, *The
evolution of the minimum degree ordering algorithm*, 1989). Time and memory then grow linearly with
the length of a trajectory, also with loops.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from heapq import heapify, heappop, heappush

import numpy as np
from jaxtyping import Float, Int

from topoloc.slam.bundle.block_kernels import factor_blocks, find_block_idx, solve_factored


@dataclass(frozen=True, eq=False)
class BlockPattern:
    """Hold the pattern of nonzero blocks of the factor.

    The rows of column p are `rows[starts[p]]`, which is p, to `rows[starts[p + 1] - 1]`. Rows and
    columns are in elimination order. `elimination_idx[i]` is the position of unknown i in it.
    """

    elimination_idx: Int[np.ndarray, " n"]
    starts: Int[np.ndarray, " n1"]
    rows: Int[np.ndarray, " b"]

    @staticmethod
    def from_pairs(num: int, pairs: Iterable[tuple[int, int]]) -> BlockPattern:
        """Compute the pattern for `num` unknowns, of which these pairs are connected."""
        tied: list[set[int]] = [set() for _ in range(num)]
        for a, b in pairs:
            if a != b:
                tied[a].add(b)
                tied[b].add(a)
        elimination_idx = np.full(num, -1)
        columns: list[set[int]] = []
        waiting = [(len(others), i) for i, others in enumerate(tied)]
        heapify(waiting)
        while waiting:
            degree, i = heappop(waiting)
            if elimination_idx[i] >= 0 or degree != len(tied[i]):
                continue
            elimination_idx[i] = len(columns)
            columns.append(tied[i])
            for other in tied[i]:
                tied[other] |= tied[i]
                tied[other] -= {i, other}
                heappush(waiting, (len(tied[other]), other))
        starts = np.cumsum([0, *(1 + len(column) for column in columns)])
        rows = [np.sort(elimination_idx[np.array([*column], np.int64)]) for column in columns]
        nothing = np.zeros(0, np.int64)
        of_columns = [np.r_[p, r] for p, r in enumerate(rows)]
        return BlockPattern(elimination_idx, starts, np.concatenate([nothing, *of_columns]))

    def empty(self) -> Float[np.ndarray, "b 6 6"]:
        """Return zero blocks for a matrix of this pattern."""
        return np.zeros((len(self.rows), 6, 6))

    @property
    def diagonal(self) -> Int[np.ndarray, " n"]:
        """Return the indices of the diagonal blocks, in elimination order."""
        return self.starts[:-1]

    def block_idx(self, i: int, j: int) -> tuple[int, bool]:
        """Return the index of the block of two connected unknowns, and whether i is its column.

        If i is its column, i is the row in the upper half.
        """
        own, other = int(self.elimination_idx[i]), int(self.elimination_idx[j])
        block_idx = find_block_idx(self.starts, self.rows, max(own, other), min(own, other))
        return int(block_idx), own <= other


def solve_blocks(
    pattern: BlockPattern,
    blocks: Float[np.ndarray, "b 6 6"],
    right_hand_sides: Float[np.ndarray, "k n 6"],
) -> Float[np.ndarray, "k n 6"]:
    """Solve ``H x = right`` for each right-hand side, all in elimination order.

    `blocks` holds the lower half of H and is replaced by its factor.
    """
    factor_blocks(pattern.starts, pattern.rows, blocks)
    solved = np.array(right_hand_sides)
    for right in solved:
        solve_factored(pattern.starts, pattern.rows, blocks, right)
    return solved
