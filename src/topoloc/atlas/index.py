"""Rank the tiles of an atlas for a query image.

One index for each feature type holds the global descriptors of all tiles.
"""

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
        """Return the numbers of the tiles with the most similar nodes, and the similarities.

        `is_selected` masks the tiles that may be returned.
        """
        ...


class AtlasIndex:
    """Rank tiles by the similarity of their most similar node.

    Nodes in shards are searched by codes, all others exactly.

    Args:
        tile_ids: ids of the tiles.
        vectors: the global descriptors of each tile that are compared exactly.
        shards: further descriptors of these tiles (`descriptor_shard.py`). Each shard comes with
            the index in `tile_ids` of each of its tiles, -1 for tiles that are never returned.
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
        """Return the feature types that can rank tiles."""
        return sorted(self._by_kind)

    def rank(
        self,
        by_kind: Mapping[str, Float32[np.ndarray, " _"]],
        num_tiles: int,
        among: Collection[str] | None = None,
    ) -> list[tuple[str, float]]:
        """Return up to `num_tiles` tiles, likeliest first, with the similarity (at most 1) of the
        best node.

        With several feature types, the last one that a tile has counts. A tile without the last
        type keeps its margin to the best tile by an earlier type.

        Args:
            by_kind: the image's global descriptor by feature type, the most distinctive type last.
            num_tiles: maximum number of returned tiles.
            among: ids of the tiles that may be returned. None: all.
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
        """Return the similarity of the likeliest tiles by one feature type.

        Each tile is in exactly one part of the index.
        """
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
    """Compare all nodes of some tiles exactly. The nodes of a tile are consecutive."""

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
    """Wrap a shard to use the tile numbers of the index. Tiles numbered -1 are never returned."""

    def __init__(self, shard: DescriptorShard, numbers: Int[np.ndarray, " s"]) -> None:
        self._shard, self._numbers = shard, numbers

    def rank(
        self, vector: Float32[np.ndarray, " d"], num_tiles: int, is_selected: Bool[np.ndarray, " t"]
    ) -> tuple[Int[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
        tiles, similarities = self._shard.rank(
            vector, num_tiles, (self._numbers >= 0) & is_selected[self._numbers]
        )
        return self._numbers[tiles], similarities
