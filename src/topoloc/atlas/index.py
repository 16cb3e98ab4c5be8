"""Rank the tiles of an atlas for a query image.

The global descriptors of a tile's nodes are computed from their stored features by the shared
vocabularies. One index for each feature type holds those of all tiles.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int

from topoloc.atlas.descriptor_shard import DescriptorShard
from topoloc.errors import AtlasError
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.mapping.validation import CorruptDataError, arrays_from_npz
from topoloc.retrieval.descriptor_index import multiply_rows
from topoloc.retrieval.shared_vocabulary import shared_vocabulary

GlobalDescriptors = Mapping[str, Float32[np.ndarray, "_ _"]]
"""Unit vectors of a tile's nodes, by feature type."""


def compute_global_descriptors(topomap: TopoMetricMap) -> dict[str, Float32[np.ndarray, "_ _"]]:
    """Compute the global descriptors of all nodes of a map, in order, by feature type.

    Feature types without a shared vocabulary are skipped.

    Raises:
        AtlasError: no feature type of the map has one.
    """
    vectors = {}
    for kind, layer in topomap.layers.items():
        if (vocabulary := shared_vocabulary(kind)) is not None:
            rows = [
                vocabulary.global_descriptor(node.features, node.camera.width, node.camera.height)
                for node in layer.nodes
            ]
            vectors[kind] = np.stack(rows)
    if not vectors:
        raise AtlasError(
            f"there is no shared vocabulary for features {', '.join(topomap.kinds)}, so that no"
            " place of the map can be ranked"
        )
    return vectors


def save_global_descriptors(path: Path, vectors: GlobalDescriptors) -> None:
    """Write the descriptors as half floats, one array for each feature type.

    Raises:
        OSError: the file cannot be written.
    """
    arrays: dict[str, Any] = {kind: rows.astype(np.float16) for kind, rows in vectors.items()}
    with path.open("wb") as file:
        np.savez(file, **arrays)


def load_global_descriptors(
    path: Path, versions: Mapping[str, str]
) -> dict[str, Float32[np.ndarray, "_ _"]]:
    """Read the output of `save_global_descriptors`. Vectors of other vocabulary versions than the
    installed ones are skipped (`versions`, by feature type). Raises AtlasError if the file is
    missing or damaged, or no version matches."""
    vectors = {}
    try:
        stored = arrays_from_npz(path.read_bytes(), "global descriptors")
    except (OSError, CorruptDataError) as error:
        raise AtlasError(
            f"{path} is missing or damaged: {' '.join(str(error).split())[:120]}"
        ) from None
    for kind, rows in stored.items():
        vocabulary = shared_vocabulary(kind)
        if rows.ndim != 2 or rows.dtype != np.float16 or not np.isfinite(rows).all():
            raise AtlasError(f"{path} is damaged: the vectors of {kind} are none")
        if (
            vocabulary is not None
            and vocabulary.version == versions.get(kind)
            and rows.shape[1] == vocabulary.dimension
        ):
            vectors[kind] = rows.astype(np.float32)
    if not vectors:
        raise AtlasError(
            f"{path} holds place vectors of another version of topoloc: `topoloc atlas add"
            " --replace` makes them anew"
        )
    return vectors


_Ranking = tuple[Int[np.ndarray, " k"], Float32[np.ndarray, " k"]]
_Rank = Callable[[Float32[np.ndarray, " d"], int, Bool[np.ndarray, " t"]], _Ranking]
"""Return the numbers of the tiles with the most similar nodes to a vector, up to a number of tiles
and of those of a mask, and their similarities."""


class AtlasIndex:
    """Rank tiles by the similarity of their most similar node.

    Nodes in shards are searched by codes, all others exactly.

    Args:
        tile_ids: ids of the tiles.
        vectors: the global descriptors of each tile that are compared exactly.
        shards: further descriptors of these tiles (`descriptor_shard.py`). Each shard comes with
            the index in `tile_ids` of each of its tiles, -1 for tiles that are never returned.
        problems: the reason for each tile (by id) that cannot be ranked. These tiles are queried
            last.
        notes: problems with the index files. The index works without these files.
    """

    def __init__(
        self,
        tile_ids: Sequence[str],
        vectors: Sequence[GlobalDescriptors],
        shards: Sequence[tuple[DescriptorShard, Sequence[int]]] = (),
        problems: Mapping[str, str] = MappingProxyType({}),
        notes: Sequence[str] = (),
    ) -> None:
        self._tile_ids, self.problems, self.notes = list(tile_ids), problems, notes
        self._by_kind: dict[str, list[_Rank]] = {}
        for kind in {kind for one in vectors for kind in one}:
            rows = [row for row, one in enumerate(vectors) if len(one.get(kind, ())) > 0]
            if rows:
                stacked = np.ascontiguousarray(np.concatenate([vectors[row][kind] for row in rows]))
                firsts = np.cumsum([0, *(len(vectors[row][kind]) for row in rows[:-1])])
                exact = partial(_rank_exactly, stacked, np.array(rows), firsts)
                self._by_kind.setdefault(kind, []).append(exact)
        for shard, numbers in shards:
            in_shard = partial(_rank_in_shard, shard, np.array(numbers))
            self._by_kind.setdefault(shard.kind, []).append(in_shard)

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
        is_selected = np.ones(len(self._tile_ids), bool)
        if among is not None:
            is_selected = np.array([tile_id in among for tile_id in self._tile_ids], bool)
        similarity: dict[int, float] = {}
        for kind, vector in by_kind.items():
            query = np.ascontiguousarray(vector, np.float32)
            pairs = [
                (float(value), -int(row))
                for rank in self._by_kind.get(kind, ())  # each tile is in exactly one part
                for row, value in zip(*rank(query, num_tiles, is_selected), strict=True)
            ]
            if pairs:
                found = {-row: value for value, row in sorted(pairs, reverse=True)[:num_tiles]}
                best = max(found.values())
                shift = best - max(similarity.values(), default=best)
                similarity = {row: before + shift for row, before in similarity.items()} | found
        ranked = sorted(((value, -row) for row, value in similarity.items()), reverse=True)
        return [(self._tile_ids[-row], value) for value, row in ranked[:num_tiles]]


def _rank_exactly(
    vectors: Float32[np.ndarray, "n d"],
    tiles: Int[np.ndarray, " s"],
    firsts: Int[np.ndarray, " s"],
    vector: Float32[np.ndarray, " d"],
    num_tiles: int,
    is_selected: Bool[np.ndarray, " t"],
) -> _Ranking:
    """Compare all nodes of some tiles. The nodes of a tile are consecutive from its `firsts`."""
    similarities = np.empty(len(vectors), np.float32)
    multiply_rows(vectors, vector, similarities)
    best = np.maximum.reduceat(similarities, firsts)
    order = np.argsort(-best, kind="stable")
    order = order[is_selected[tiles[order]]][:num_tiles]
    return tiles[order], best[order]


def _rank_in_shard(
    shard: DescriptorShard,
    numbers: Int[np.ndarray, " s"],
    vector: Float32[np.ndarray, " d"],
    num_tiles: int,
    is_selected: Bool[np.ndarray, " t"],
) -> _Ranking:
    """Rank the tiles of a shard by their numbers in the index. Those numbered -1 are left out."""
    tiles, similarities = shard.rank(vector, num_tiles, (numbers >= 0) & is_selected[numbers])
    return numbers[tiles], similarities
