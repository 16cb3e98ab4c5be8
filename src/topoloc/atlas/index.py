"""Which tiles is this picture of? One index over the place vectors of all tiles, by each kind of
features."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float32, Int

from topoloc.atlas.descriptor_shard import DescriptorShard
from topoloc.atlas.global_descriptors import GlobalDescriptors
from topoloc.retrieval.descriptor_kernels import multiply_rows


class _TileRanker(Protocol):
    def rank(
        self, vector: Float32[np.ndarray, " d"], num_tiles: int, is_selected: Bool[np.ndarray, " t"]
    ) -> tuple[Int[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
        """The numbers of the tiles with the most similar places, and how similar these are;
        `is_selected` says of each tile whether it may be named."""
        ...


class AtlasIndex:
    """Ranks tiles by the likeness of their most similar place: those of shards by codes, all others
    exactly.

    Args:
        vectors: the place vectors of each tile that are compared exactly; `tile_ids` says which.
        shards: further places of these tiles (`descriptor_shard.py`); each with the number in
            `tile_ids` of each of its tiles, -1 of one that is never named.
    """

    def __init__(
        self,
        tile_ids: Sequence[str],
        vectors: Sequence[GlobalDescriptors],
        shards: Sequence[tuple[DescriptorShard, Sequence[int]]] = (),
    ) -> None:
        self._tile_ids, self._all = list(tile_ids), np.ones(len(tile_ids), bool)
        self._by_kind: dict[str, list[_TileRanker]] = {}
        for kind in {kind for one in vectors for kind in one}:
            rows = [
                number for number, one in enumerate(vectors) if kind in one and len(one[kind]) > 0
            ]
            of_tile = np.repeat(rows, [len(vectors[row][kind]) for row in rows])
            if len(rows) > 0:
                self._by_kind.setdefault(kind, []).append(
                    _ExactTiles(np.concatenate([vectors[row][kind] for row in rows]), of_tile)
                )
        for shard, numbers in shards:
            self._by_kind.setdefault(shard.kind, []).append(
                _NumberedShard(shard, np.array(numbers))
            )

    @property
    def kinds(self) -> list[str]:
        """The kinds of features that tiles can be ranked by."""
        return sorted(self._by_kind)

    def rank(
        self,
        by_kind: Mapping[str, Float32[np.ndarray, " _"]],
        num_tiles: int,
        among: Collection[str] | None = None,
    ) -> list[tuple[str, float]]:
        """Up to `num_tiles` tiles, the likeliest first, each with the likeness (at most 1) of its
        best place.

        Where the picture was described with several kinds of features, the last one counts that a
        tile has; how far a tile stays behind the best one by another kind is how far it is taken to
        be behind by the last.

        Args:
            by_kind: the picture's place vector by each kind that it was described with, the one
                that tells most the last.
            among: only these tiles are named; None: all.
        """
        is_selected = (
            self._all
            if among is None
            else np.array([tile_id in among for tile_id in self._tile_ids], bool)
        )
        similarity: dict[int, float] = {}
        for kind, vector in by_kind.items():
            found = self._found(
                kind, np.ascontiguousarray(vector, np.float32), num_tiles, is_selected
            )
            if not found:
                continue
            best = max(found.values())
            shift = best - max(similarity.values(), default=best)
            similarity = {row: before + shift for row, before in similarity.items()} | found
        ranked = sorted(((value, -row) for row, value in similarity.items()), reverse=True)
        return [(self._tile_ids[-row], value) for value, row in ranked[:num_tiles]]

    def _found(
        self,
        kind: str,
        vector: Float32[np.ndarray, " d"],
        num_tiles: int,
        is_selected: Bool[np.ndarray, " t"],
    ) -> dict[int, float]:
        """The likeness of the likeliest tiles by one kind of features; a tile lies in one part of
        the index."""
        pairs = [part.rank(vector, num_tiles, is_selected) for part in self._by_kind.get(kind, ())]
        found = sorted(
            (
                (float(value), -int(row))
                for rows, values in pairs
                for row, value in zip(rows, values, strict=True)
            ),
            reverse=True,
        )
        return {-row: value for value, row in found[:num_tiles]}


class _ExactTiles:
    """The best place of each tile: all are compared, those of a tile stand one after the other."""

    def __init__(self, vectors: Float32[np.ndarray, "n d"], of_tile: Int[np.ndarray, " n"]) -> None:
        self._vectors = np.ascontiguousarray(vectors)
        self._tiles, self._firsts = np.unique(of_tile, return_index=True)

    def rank(
        self, vector: Float32[np.ndarray, " d"], num_tiles: int, is_selected: Bool[np.ndarray, " t"]
    ) -> tuple[Int[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
        similarities = np.empty(len(self._vectors), np.float32)
        multiply_rows(self._vectors, vector, similarities)
        best = np.maximum.reduceat(similarities, self._firsts)
        order = np.argsort(-best, kind="stable")
        order = order[is_selected[self._tiles[order]]][:num_tiles]
        return self._tiles[order], best[order]


class _NumberedShard:
    """A shard whose tiles go by the numbers of the index; those of none are never named."""

    def __init__(self, shard: DescriptorShard, numbers: Int[np.ndarray, " s"]) -> None:
        self._shard, self._numbers = shard, numbers

    def rank(
        self, vector: Float32[np.ndarray, " d"], num_tiles: int, is_selected: Bool[np.ndarray, " t"]
    ) -> tuple[Int[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
        tiles, similarities = self._shard.rank(
            vector, num_tiles, (self._numbers >= 0) & is_selected[self._numbers]
        )
        return self._numbers[tiles], similarities
