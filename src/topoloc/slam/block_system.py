"""Symmetric positive definite systems of 6x6 blocks, most of which are zero: what poses that are
tied together are solved by.

Cholesky's factor has more blocks than the matrix: whoever is eliminated ties all of its neighbours
to each other. Where the one with the fewest neighbours goes first (George & Liu, *The evolution of
the minimum degree ordering algorithm*, 1989), a walk costs time and memory by its length, loops and
laps included.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from heapq import heapify, heappop, heappush

import numpy as np
from jaxtyping import Float, Int

from topoloc.slam.block_kernels import factor_blocks, find_block_idx, solve_factored


@dataclass(frozen=True, eq=False)
class BlockPattern:
    """Which blocks of the factor are other than zero: of its column p the rows `rows[starts[p]]`,
    which is p, to `rows[starts[p + 1] - 1]`.

    Rows and columns are in the order of elimination; `ranks[i]` is the place of unknown i in it.
    """

    elimination_idx: Int[np.ndarray, " n"]
    starts: Int[np.ndarray, " n1"]
    rows: Int[np.ndarray, " b"]

    @staticmethod
    def from_pairs(num: int, pairs: Iterable[tuple[int, int]]) -> BlockPattern:
        """That of so many unknowns, these pairs of which are tied together."""
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
        rows = [
            np.sort(elimination_idx[[*column]]) if column else np.zeros(0, np.int64)
            for column in columns
        ]
        return BlockPattern(
            elimination_idx,
            starts,
            np.concatenate([np.r_[p, r] for p, r in enumerate(rows)])
            if rows
            else np.zeros(0, np.int64),
        )

    def empty(self) -> Float[np.ndarray, "b 6 6"]:
        """The blocks of a matrix of this pattern, all zero."""
        return np.zeros((len(self.rows), 6, 6))

    @property
    def diagonal(self) -> Int[np.ndarray, " n"]:
        """Where the diagonal's blocks lie, in the order of elimination."""
        return self.starts[:-1]

    def block_idx(self, i: int, j: int) -> tuple[int, bool]:
        """Where the block of unknowns i and j lies, which must be tied, and whether i is its column
        (its row in the upper half)."""
        low, high = sorted((int(self.elimination_idx[i]), int(self.elimination_idx[j])))
        return int(find_block_idx(self.starts, self.rows, high, low)), bool(
            low == self.elimination_idx[i]
        )


def solve_blocks(
    pattern: BlockPattern,
    blocks: Float[np.ndarray, "b 6 6"],
    right_hand_sides: Float[np.ndarray, "k n 6"],
) -> Float[np.ndarray, "k n 6"]:
    """x with ``H x = right`` for each right-hand side, all in the order of elimination; `blocks`,
    H's lower half, become its factor."""
    factor_blocks(pattern.starts, pattern.rows, blocks)
    solved = np.array(right_hand_sides)
    for right in solved:
        solve_factored(pattern.starts, pattern.rows, blocks, right)
    return solved
