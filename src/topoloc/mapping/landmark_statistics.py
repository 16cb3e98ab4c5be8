"""Store each session's statistics of a node's points as sums that can be added and removed later.

A point's position is the least squares estimate of all its measurements. Let p be the position
stored in the node. Every session contributes its information A = sum of J' W J and its pull g = sum
of J' W r. These are normal equations in the node's camera frame. W holds inverse variances and
robust weights. The pulls of all sessions sum to zero, because p is the optimum. Without one session
the point moves by -A^-1 g of the remaining sums, and its covariance is A^-1. The information vector
is b = A p - g.

`expected` counts the session's images that have the point in view. `seen` counts the images that
observed it. Vanished points are expected but not seen.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from jaxtyping import Float, Float16, Int, Int16, UInt16

from topoloc.mapping.validation import CorruptDataError, array_from_bytes, decompress_bytes

PULL_SCALE = 1024.0
"""Pulls are stored as L^-1 g with A = L L', in steps of 1 / PULL_SCALE. They have no unit and are
about 1."""
MAX_COUNT = 65535
# 1 / square metres; added to the diagonal, so that the Cholesky root of zero information exists
_MIN_INFORMATION = 1e-6
_MAX_EMPTY_ROOT = 1.01 * _MIN_INFORMATION**0.5
_COLUMNS = (
    ("rows", "<u2", 1),
    ("roots", "<f2", 6),
    ("pulls", "<i2", 3),
    ("expected", "<u2", 1),
    ("seen", "<u2", 1),
)
"""The arrays in the file: name, type and width."""


@dataclass(frozen=True, eq=False)
class LandmarkStatistics:
    """Hold one session's sums for the points `rows` of a node, as stored in the file.

    `roots` are the lower triangles (xx, yx, yy, zx, zy, zz, in 1 / metres) of the Cholesky roots L
    of the information. `pulls` are L^-1 g times `PULL_SCALE`.
    """

    session_id: int
    rows: Int[np.ndarray, " m"]
    roots: Float16[np.ndarray, "m 6"]
    pulls: Int16[np.ndarray, "m 3"]
    expected: UInt16[np.ndarray, " m"]
    seen: UInt16[np.ndarray, " m"]

    @staticmethod
    def from_equations(
        session_id: int,
        rows: Int[np.ndarray, " m"],
        information: Float[np.ndarray, "m 3 3"],
        pulls: Float[np.ndarray, "m 3"],
        expected: Int[np.ndarray, " m"],
        seen: Int[np.ndarray, " m"],
    ) -> LandmarkStatistics:
        """Create the statistics from information (1 / square metres) and pulls (1 / metres). The
        information is 0 for points the session did not measure."""
        # a small value on the diagonal keeps the root defined without adding real information
        scale = np.einsum("mii->m", information) / 3.0
        lower = np.linalg.cholesky(
            information + (1e-9 * scale + _MIN_INFORMATION)[:, None, None] * np.eye(3)
        )
        whitened = np.linalg.solve(lower, pulls[:, :, None])[:, :, 0]
        return LandmarkStatistics(
            session_id,
            rows,
            np.clip(lower[:, *np.tril_indices(3)], -6e4, 6e4).astype(np.float16),
            np.clip(np.rint(whitened * PULL_SCALE), -32767, 32767).astype(np.int16),
            np.minimum(expected, MAX_COUNT).astype(np.uint16),
            np.minimum(seen, MAX_COUNT).astype(np.uint16),
        )

    @staticmethod
    def of_counts(
        session_id: int, expected: Int[np.ndarray, " n"], seen: Int[np.ndarray, " n"]
    ) -> LandmarkStatistics:
        """Create the statistics of a session that only counted, from the counts of all points of a
        node. Points that it did not expect are left out."""
        rows = np.flatnonzero(expected > 0)
        nothing = np.zeros((len(rows), 3, 3)), np.zeros((len(rows), 3))
        return LandmarkStatistics.from_equations(
            session_id, rows, *nothing, expected[rows], seen[rows]
        )

    @property
    def is_count_only(self) -> bool:
        """Return whether the session contains only counts and no information on positions."""
        is_empty = not self.pulls.any() and bool((np.abs(self.roots) <= _MAX_EMPTY_ROOT).all())
        return len(self.rows) > 0 and is_empty

    def is_whole_information(self, sqrt_covs: Float[np.ndarray, "n 6"]) -> bool:
        """Return whether no other session located the points: the information is the inverse of
        their covariances, whose roots are `sqrt_covs` (metres), within 5 %."""
        lower, roots = _lower_triangles(self.roots), _lower_triangles(sqrt_covs[self.rows])
        identity = np.swapaxes(roots, 1, 2) @ lower
        identity = identity @ np.swapaxes(identity, 1, 2)
        return bool(np.all(np.abs(identity - np.eye(3)) < 0.05))

    def with_whole_information(self, sqrt_covs: Float[np.ndarray, "n 6"]) -> LandmarkStatistics:
        """Return the statistics of the only session that located the points: with the inverse of
        their covariances. Raises CorruptDataError."""
        roots = _lower_triangles(sqrt_covs[self.rows])
        try:
            information = np.linalg.inv(roots @ np.swapaxes(roots, 1, 2))
            counts = self.expected.astype(np.int64), self.seen.astype(np.int64)
            pulls = np.zeros((len(roots), 3))
            return LandmarkStatistics.from_equations(
                self.session_id, self.rows, information, pulls, *counts
            )
        except np.linalg.LinAlgError as error:
            raise CorruptDataError(f"sums of session {self.session_id}: no covariances") from error

    def scaled(self, factor: float) -> LandmarkStatistics:
        """Return the statistics in a world whose lengths are this many times as long. Pulls have no
        unit."""
        roots = self.roots.astype(np.float64)
        is_empty = (np.abs(roots) <= _MAX_EMPTY_ROOT).all(axis=1, keepdims=True)
        roots = np.where(is_empty, roots, np.clip(roots / factor, -6e4, 6e4))
        return replace(self, roots=roots.astype(np.float16))

    def with_counts(self, counted: LandmarkStatistics) -> LandmarkStatistics:
        """Return the statistics with the counts of further images, of the same session or not."""
        rows = np.union1d(self.rows, counted.rows)
        roots = np.zeros((len(rows), 6), np.float16)
        roots[:, [0, 2, 5]] = _MIN_INFORMATION**0.5
        pulls, counts = np.zeros((len(rows), 3), np.int16), np.zeros((2, len(rows)), np.int64)
        own = np.searchsorted(rows, self.rows)
        roots[own], pulls[own] = self.roots, self.pulls
        for part in (self, counted):
            counts[:, np.searchsorted(rows, part.rows)] += [part.expected, part.seen]
        expected, seen = np.minimum(counts, MAX_COUNT).astype(np.uint16)
        return LandmarkStatistics(self.session_id, rows, roots, pulls, expected, seen)

    def is_reobserved(self) -> bool:
        """Return whether the session saw at least 0.3 of its expected observations. A session in
        other light may see none of them."""
        seen, expected = (counts.sum(dtype=np.int64) for counts in (self.seen, self.expected))
        return bool(seen >= 0.3 * expected)


def _lower_triangles(numbers: Float[np.ndarray, "m 6"]) -> Float[np.ndarray, "m 3 3"]:
    lower = np.zeros((len(numbers), 3, 3))
    lower[:, *np.tril_indices(3)] = numbers
    return lower


def merge_count_statistics(statistics: Iterable[LandmarkStatistics]) -> list[LandmarkStatistics]:
    """Merge the count-only sessions into at most two, each with the id of its last session.

    One holds the sessions that observed the node again (`is_reobserved`). The
    other holds the rest (other light). So a node's size does not grow with the number of sessions.
    """
    kept, counted = list[LandmarkStatistics](), dict[bool, list[LandmarkStatistics]]()
    for of_session in statistics:
        if of_session.is_count_only:
            counted.setdefault(of_session.is_reobserved(), []).append(of_session)
        else:
            kept.append(of_session)
    return sorted([*kept, *map(_add_counts, counted.values())], key=lambda part: part.session_id)


def _add_counts(parts: Sequence[LandmarkStatistics]) -> LandmarkStatistics:
    """Add up the counts of several sessions under the id of the last one."""
    *others, last = sorted(parts, key=lambda part: part.session_id)
    return reduce(LandmarkStatistics.with_counts, others, last)


def encode_statistics(statistics: LandmarkStatistics, sqrt_covs: Float[np.ndarray, "n 6"]) -> bytes:
    """Encode rows, roots, pulls and counts as 16-bit words, with all low bytes before all high
    bytes, compressed by zlib. Roots and pulls are 0 if they follow from the covariances."""
    if statistics.is_whole_information(sqrt_covs):
        roots, pulls = np.zeros_like(statistics.roots), np.zeros_like(statistics.pulls)
        statistics = replace(statistics, roots=roots, pulls=pulls)
    parts = (getattr(statistics, name).astype(dtype) for name, dtype, _ in _COLUMNS)
    words = np.frombuffer(b"".join(part.tobytes() for part in parts), np.uint8)
    return zlib.compress(np.ascontiguousarray(words.reshape(-1, 2).T).tobytes(), 6)


def decode_statistics(
    session_id: int, data: bytes, num_rows: int, sqrt_covs: Float[np.ndarray, "n 6"]
) -> LandmarkStatistics:
    """Decode the bytes of `encode_statistics`. Raises CorruptDataError."""
    what = f"sums of session {session_id}"
    planes = array_from_bytes(
        decompress_bytes(data, 24 * num_rows, what), "u1", (2, 12 * num_rows), what
    )
    words = np.ascontiguousarray(planes.T).tobytes()
    m, parts = num_rows, []
    for _, dtype, width in _COLUMNS:
        data, words = words[: 2 * m * width], words[2 * m * width :]
        parts.append(array_from_bytes(data, dtype, (m, width) if width > 1 else (m,), what))
    rows = parts[0].astype(np.int64)
    if m and (int(rows[-1]) >= len(sqrt_covs) or (np.diff(rows) <= 0).any()):
        raise CorruptDataError(f"{what}: of points that are not there")
    statistics = LandmarkStatistics(session_id, rows, *parts[1:])
    if m and not statistics.roots.any():
        return statistics.with_whole_information(sqrt_covs)
    return statistics
