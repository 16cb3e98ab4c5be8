"""Iterate over the observations of a bundle adjustment in chunks of landmarks.

This bounds the memory for trajectories of any length.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int, Int32

from topoloc.slam.keyframes import KeyFrame


@dataclass(frozen=True, eq=False)
class ObservationChunk:
    """Hold the observations of the landmarks `first` to `last` of a bundle, sorted by landmark.

    Those of landmark n are `starts[n - first]` to `starts[n - first + 1] - 1`. `keyframe_idx` is
    the key frame of each one, and `sources` the row in that key frame's observations.
    """

    first: int
    last: int
    starts: Int[np.ndarray, " n1"]
    keyframe_idx: Int32[np.ndarray, " m"]
    sources: Int32[np.ndarray, " m"]
    measured: Float[np.ndarray, "m 3"]
    weights: Float[np.ndarray, "m 3"]

    @property
    def rows(self) -> Int[np.ndarray, " m"]:
        """Return the landmark of each observation, counted from `first`."""
        return np.repeat(np.arange(self.last - self.first), np.diff(self.starts))


class ObservationChunks:
    """Provide the active observations of landmarks by key frames, chunk by chunk.

    It can be iterated repeatedly. Several chunks are built anew each time, a single one is cached.

    Args:
        ids: the landmarks, ascending.
        max_observations: approximate size of a chunk.
    """

    def __init__(
        self, keyframes: Sequence[KeyFrame], ids: Int[np.ndarray, " n"], max_observations: int
    ) -> None:
        self._keyframes, self._ids = keyframes, ids
        self._observation_orders = [_sort_observations(keyframe, ids) for keyframe in keyframes]
        num_parts = -(-self.num_observations // max_observations)
        self._chunk_bounds = np.linspace(0, len(ids), num_parts + 1).astype(np.int64)
        ends = ids[self._chunk_bounds[1:] - 1] + 1 if num_parts else ids[:0]
        seen = [
            k.observations.landmark_ids[order]
            for k, order in zip(keyframes, self._observation_orders, strict=True)
        ]
        self._observation_offsets: Int[np.ndarray, "k p1"] = np.array(
            [np.searchsorted(one, np.r_[0, ends]) for one in seen]
        )

    @property
    def num_observations(self) -> int:
        """Return the number of observations in all chunks."""
        return sum(map(len, self._observation_orders))

    def __iter__(self) -> Iterator[ObservationChunk]:
        num = len(self._chunk_bounds) - 1
        yield from [self._single_chunk] if num == 1 else map(self._make_chunk, range(num))

    @cached_property
    def _single_chunk(self) -> ObservationChunk:
        return self._make_chunk(0)

    def _make_chunk(self, number: int) -> ObservationChunk:
        first, last = self._chunk_bounds[number : number + 2].tolist()
        begins, ends = self._observation_offsets[:, number : number + 2].T
        seeing = np.flatnonzero(ends > begins).tolist()
        sources = [self._observation_orders[k][begins[k] : ends[k]] for k in seeing]
        seen = [
            (one.landmark_ids[rows], one.measured[rows], one.weights[rows])
            for one, rows in zip(
                (self._keyframes[k].observations for k in seeing), sources, strict=True
            )
        ]
        ids, measured, weights = map(np.concatenate, zip(*seen, strict=True))
        rows = np.searchsorted(self._ids[first:last], ids)
        order = np.argsort(rows, kind="stable")
        measured, weights = measured[order], weights[order]
        keyframe_idx = np.repeat(np.array(seeing, np.int32), [len(rows) for rows in sources])
        return ObservationChunk(
            first,
            last,
            starts=np.searchsorted(rows[order], np.arange(last - first + 1)),
            keyframe_idx=keyframe_idx[order],
            sources=np.concatenate(sources)[order],
            measured=np.where(weights > 0.0, measured, 0.0).astype(np.float64),
            weights=weights.astype(np.float64),
        )


def _sort_observations(keyframe: KeyFrame, ids: Int[np.ndarray, " n"]) -> Int32[np.ndarray, " m"]:
    """Return the rows of a key frame's active observations of these landmarks, by landmark."""
    seen = keyframe.observations
    if not len(ids):
        return np.zeros(0, np.int32)
    place = np.searchsorted(ids, seen.landmark_ids)
    place[place == len(ids)] = 0
    rows = np.flatnonzero(seen.active & (ids[place] == seen.landmark_ids))
    return rows[np.argsort(seen.landmark_ids[rows], kind="stable")].astype(np.int32)
