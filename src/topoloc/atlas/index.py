"""Which tiles is this picture of? One index over the place vectors of all tiles, by each kind of features."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float32, Int

from topoloc.atlas.place_vectors import PlaceVectors
from topoloc.places.coarse import NodeScore
from topoloc.places.neighbours import PlaceIndex
from topoloc.places.place_kernels import multiply_rows

MAX_EXACT_VECTORS = 100_000


class AtlasIndex:
    """Ranks tiles by the likeness of their most similar place; exact up to 10^5 places, by an inverted file beyond.

    Args:
        vectors: the place vectors of each tile; `tile_ids` says which.
    """

    def __init__(self, tile_ids: Sequence[str], vectors: Sequence[PlaceVectors]) -> None:
        self._tile_ids = list(tile_ids)
        self._by_kind: dict[str, _ExactTiles | PlaceIndex] = {}
        for kind in sorted({kind for one in vectors for kind in one}):
            rows = [number for number, one in enumerate(vectors) if kind in one and len(one[kind]) > 0]
            stacked = np.concatenate([vectors[row][kind] for row in rows])
            of_tile = np.repeat(rows, [len(vectors[row][kind]) for row in rows])
            is_few = len(stacked) <= MAX_EXACT_VECTORS
            self._by_kind[kind] = _ExactTiles(stacked, of_tile) if is_few else PlaceIndex(stacked, of_tile, MAX_EXACT_VECTORS)

    @property
    def kinds(self) -> list[str]:
        """The kinds of features that tiles can be ranked by."""
        return list(self._by_kind)

    def rank(self, by_kind: Mapping[str, Float32[np.ndarray, " _"]], num_tiles: int) -> list[tuple[str, float]]:
        """Up to `num_tiles` tiles, the likeliest first, each with the likeness (at most 1) of its best place.

        Where the picture was described with several kinds of features, the last one counts that a tile has; how far a tile stays behind the
        best one by another kind is how far it is taken to be behind by the last.

        Args:
            by_kind: the picture's place vector by each kind that it was described with, the one that tells most the last.
        """
        likeness: dict[int, float] = {}
        for kind, vector in by_kind.items():
            if kind not in self._by_kind:
                continue
            found = self._by_kind[kind].rank_nodes(vector, num_tiles)
            shift = found[0].score - max(likeness.values(), default=found[0].score)
            likeness = {row: before + shift for row, before in likeness.items()} | {tile.node_id: tile.score for tile in found}
        ranked = sorted(((value, -row) for row, value in likeness.items()), reverse=True)
        return [(self._tile_ids[-row], value) for value, row in ranked[:num_tiles]]


class _ExactTiles:
    """The best place of each tile: all are compared, those of a tile stand one after the other."""

    def __init__(self, vectors: Float32[np.ndarray, "n d"], of_tile: Int[np.ndarray, " n"]) -> None:
        self._vectors = np.ascontiguousarray(vectors)
        self._tiles, self._firsts = np.unique(of_tile, return_index=True)

    def rank_nodes(self, vector: Float32[np.ndarray, " d"], num_candidates: int) -> list[NodeScore]:
        """As `PlaceIndex.rank_nodes`, of tiles."""
        similarities = np.empty(len(self._vectors), np.float32)
        multiply_rows(self._vectors, np.ascontiguousarray(vector), similarities)
        best = np.maximum.reduceat(similarities, self._firsts)
        order = np.argsort(-best, kind="stable")[:num_candidates]
        return [NodeScore(int(self._tiles[k]), float(best[k])) for k in order]
