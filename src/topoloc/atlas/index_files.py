"""Store the index of an atlas as shards in the cache folder, and reuse them.

A shard holds tiles by id and checksum of their global descriptors. Opening an atlas uses the stored
shards without reading the descriptors of their tiles again. New tiles are compared exactly while
they are few. Otherwise they become a shard, together with the small shards. Tiles that were removed
or replaced stay in their shard but are ignored, until they are a quarter of it. So an index is
never older than the manifest, and the cache folder may be emptied at any time.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Float16

from topoloc.atlas.descriptor_shard import DescriptorShard, ShardTile
from topoloc.atlas.index import AtlasIndex, GlobalDescriptors
from topoloc.atlas.manifest import Tile
from topoloc.errors import AtlasError, ObjectStoreError
from topoloc.features.network_files import cache_folder
from topoloc.retrieval.shared_vocabulary import shared_vocabulary

MAX_EXACT_DESCRIPTORS, SHARD_DESCRIPTORS = 20_000, 1 << 20
"""Maximum number of descriptors outside shards that are compared exactly, and of descriptors in a
shard. A single tile may exceed the second limit."""
_MAX_STALE_SHARE, _UNUSED_S = 0.25, 86_400.0
LoadDescriptors = Callable[[Tile], GlobalDescriptors]
_Rows = tuple[ShardTile, Float16[np.ndarray, "_ _"]]


@dataclass(frozen=True, eq=False)
class _LiveShard:
    """Hold a shard and a mask of its current tiles."""

    shard: DescriptorShard
    is_live: list[bool]

    @property
    def live(self) -> list[ShardTile]:
        return [tile for tile, _ in self.rows()]

    @property
    def num_live(self) -> int:
        return sum(tile.num_rows for tile in self.live)

    def rows(self) -> list[_Rows]:
        """Return the current tiles with their vectors."""
        bounds, vectors = self.shard.bounds, self.shard.vectors
        tiles = [(k, tile) for k, tile in enumerate(self.shard.tiles) if self.is_live[k]]
        return [(tile, vectors[bounds[k] : bounds[k + 1]]) for k, tile in tiles]


def index_folder(where: str) -> Path:
    """Return the local cache folder for the shards of an atlas."""
    place = where if "://" in where else str(Path(where).resolve())
    return cache_folder() / "indexes" / hashlib.sha256(place.encode()).hexdigest()[:16]


def open_index(tiles: Sequence[Tile], read: LoadDescriptors, folder: Path) -> AtlasIndex:
    """Open the index of these tiles from the shards in `folder`. Missing shards are built, and
    stored there if it is writable.

    `read` loads the global descriptors of a tile. It raises AtlasError if they are not available,
    and ObjectStoreError, which is passed on.
    """
    work = _IndexBuilder(tiles, folder)
    live_shards = {kind: work.live_shards(kind) for kind in work.versions}
    few = work.load_missing(live_shards, read)
    for kind, vectors in few.items():
        if sum(len(rows) for _, rows in vectors) > MAX_EXACT_DESCRIPTORS:
            live_shards[kind] = work.with_new_shards(kind, live_shards[kind], vectors)
    used = {one.shard.name for of_kind in live_shards.values() for one in of_kind}
    for path in folder.glob("*.index"):
        with suppress(OSError):
            if path.name in used:
                os.utime(path)
            elif time.time() - path.stat().st_mtime > _UNUSED_S:
                path.unlink()
    ids, exact = [tile.tile_id for tile in tiles], dict[str, dict[str, np.ndarray]]()
    for kind, vectors in few.items():
        for tile, rows in vectors:
            exact.setdefault(tile.tile_id, {})[kind] = rows.astype(np.float32)
    numbers = {tile_id: number for number, tile_id in enumerate(ids)}
    shards = list[tuple[DescriptorShard, list[int]]]()
    for one in chain.from_iterable(live_shards.values()):
        live = zip(one.shard.tiles, one.is_live, strict=True)
        shards.append((one.shard, [numbers[tile.tile_id] if is_ else -1 for tile, is_ in live]))
    vectors = [exact.get(tile_id, {}) for tile_id in ids]
    return AtlasIndex(ids, vectors, shards, work.problems, work.notes)


@dataclass(eq=False)
class _IndexBuilder:
    """Build an index from stored shards and missing tiles."""

    tiles: Sequence[Tile]
    folder: Path
    notes: list[str] = field(default_factory=list)
    problems: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._checksums = {tile.tile_id: tile.places.sha256 for tile in self.tiles}
        kinds = sorted({kind for tile in self.tiles for kind in tile.places.vocabularies})
        self.versions = {kind: one.version for kind in kinds if (one := shared_vocabulary(kind))}

    @cached_property
    def stored(self) -> list[DescriptorShard]:
        """Return the shards in the folder, largest first. Damaged ones are deleted."""
        shards = list[DescriptorShard]()
        for path in sorted(self.folder.glob("*.index")):
            try:
                shards.append(DescriptorShard.open(path))
            except AtlasError as error:
                self.notes.append(f"the index is made anew: {error}")
                with suppress(OSError):
                    path.unlink()
        return sorted(shards, key=lambda shard: (-len(shard.vectors), shard.name))

    def live_shards(self, kind: str) -> list[_LiveShard]:
        """Return the shards of this feature type with at most a quarter of stale rows.

        A tile counts in the first shard that holds it.
        """
        live_shards, seen = list[_LiveShard](), set[str]()
        for shard in self.stored:
            if (shard.kind, shard.vocabulary) != (kind, self.versions[kind]):
                continue
            is_live = [
                self._checksums.get(tile.tile_id) == tile.sha256 and tile.tile_id not in seen
                for tile in shard.tiles
            ]
            one = _LiveShard(shard, is_live)
            if one.num_live >= (1.0 - _MAX_STALE_SHARE) * len(shard.vectors):
                live_shards.append(one)
                seen.update(tile.tile_id for tile in one.live)
        return live_shards

    def load_missing(
        self, live_shards: dict[str, list[_LiveShard]], read: LoadDescriptors
    ) -> dict[str, list[_Rows]]:
        """Load the global descriptors, by feature type, of tiles without a shard.

        When they fill a shard, it is built and added to `live_shards`.
        """
        known = {
            kind: {tile.tile_id for one in of_kind for tile in one.live}
            for kind, of_kind in live_shards.items()
        }
        rest = {kind: list[_Rows]() for kind in live_shards}
        num_rows = dict.fromkeys(live_shards, 0)
        for tile in self.tiles:
            versions = tile.places.vocabularies.items()
            ours = [kind for kind, version in versions if self.versions.get(kind) == version]
            lacking = [kind for kind in ours if tile.tile_id not in known[kind]]
            if ours and not lacking:
                continue
            try:
                vectors = read(tile)
            except ObjectStoreError:  # not a problem of the tile, and the next would wait as long
                raise
            except AtlasError as error:
                self.problems[tile.tile_id] = str(error)
                continue
            for kind in lacking:
                if len(rows := vectors.get(kind, np.zeros((0, 1)))) > 0:
                    entry = ShardTile(tile.tile_id, tile.places.sha256, len(rows))
                    rest[kind].append((entry, rows.astype(np.float16)))
                    num_rows[kind] += len(rows)
                if num_rows[kind] >= SHARD_DESCRIPTORS:
                    live_shards[kind].append(self._new_shard(kind, rest[kind]))
                    num_rows[kind] = sum(one.num_rows for one, _ in rest[kind])
        return rest

    def with_new_shards(
        self, kind: str, live_shards: Sequence[_LiveShard], rest: list[_Rows]
    ) -> list[_LiveShard]:
        """Return shards of all tiles. Shards less than half full are merged with `rest`, which is
        emptied."""
        full = [one for one in live_shards if one.num_live >= SHARD_DESCRIPTORS // 2]
        pending = [row for one in live_shards if one not in full for row in one.rows()] + rest
        rest.clear()
        while pending:
            full.append(self._new_shard(kind, pending))
        return full

    def _new_shard(self, kind: str, pending: list[_Rows]) -> _LiveShard:
        """Build a shard of the first tiles in `pending`, up to its capacity, and remove them
        there."""
        sizes = np.cumsum([tile.num_rows for tile, _ in pending])
        count = max(1, int(np.searchsorted(sizes, SHARD_DESCRIPTORS, "right")))
        tiles = [tile for tile, _ in pending[:count]]
        shard = DescriptorShard(kind, self.versions[kind], tiles, _take_vectors(pending, count))
        try:
            shard = DescriptorShard.open(shard.save(self.folder))  # memory-mapped
        except (OSError, AtlasError) as error:
            text = "the index stays in memory, and is made at each opening: cannot write"
            if not any(note.startswith(text) for note in self.notes):
                self.notes.append(
                    f"{text} {self.folder}: {getattr(error, 'strerror', None) or error}"
                )
        return _LiveShard(shard, [True] * count)


def _take_vectors(pending: list[_Rows], count: int) -> Float16[np.ndarray, "n d"]:
    """Stack the vectors of the first tiles.

    Each tile's vectors are freed once copied, because they take up to half a gigabyte.
    """
    num_rows = sum(tile.num_rows for tile, _ in pending[:count])
    stacked, first = np.empty((num_rows, pending[0][1].shape[1]), np.float16), 0
    for number in range(count):
        tile, rows = pending[number]
        stacked[first : first + tile.num_rows] = rows
        first += tile.num_rows
        pending[number] = tile, rows[:0].copy()
    del pending[:count]
    return stacked
