"""Maps by their names: opened when they are asked for, closed when there are too many, replaced
when their file is.

A map's name is that of its file without `.topo`; of an atlas's tile, its id. Tiles of object stores
are files of this machine when they are opened; how they come here is said by who makes the
`MapCache`. A file is looked at before each request: another one in its place is opened, and the one
before is let go of when the last request that uses it is answered. What is kept of nodes has a
budget of its own (`map/memory.py`); here a map counts by the bytes of its file, which no open map
exceeds apart from its nodes.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from topoloc.atlas.atlas import Atlas, is_atlas
from topoloc.atlas.manifest import Tile
from topoloc.atlas.watched_atlas import WatchedAtlas
from topoloc.errors import MapError, MapNotFoundError
from topoloc.localization.localizer import Localizer
from topoloc.mapping.node_cache import set_node_cache_size
from topoloc.mapping.topomap import TopoMetricMap

SUFFIX = ".topo"
OpenLocalizer = Callable[[TopoMetricMap], Localizer]
TilePath = Callable[[Atlas, Tile], Path]
"""The map file of a tile, on this machine; raises AtlasError, or whatever tells that it is not here
yet."""


@dataclass(eq=False)
class CachedMap:
    """An open map, as it is shared by all who ask it; `stamp` is that of its file when it was
    opened."""

    name: str
    path: Path
    stamp: tuple[int, ...]
    localizer: Localizer
    num_users: int = 0
    is_retired: bool = False

    @property
    def num_bytes(self) -> int:
        return self.stamp[1]


@dataclass(eq=False)
class _CacheEntry:
    """Where one map stands; its lock is held while the map is opened, so that it is opened once and
    nobody else waits."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    opened: CachedMap | None = None


@dataclass(frozen=True)
class _MapSource:
    """A map by the name of its file; of a tile, with its atlas."""

    where: str
    tile: tuple[Atlas, Tile] | None = field(default=None, compare=False)


class MapCache:
    """The maps of these files, folders and atlases, which may lie in object stores.

    Args:
        max_bytes: open maps are closed, those used longest ago first, while they have more bytes
            than this. One in use is never closed.
        tile_path: how tiles become files of this machine; by itself they are fetched while their
            caller waits.

    Raises:
        MapError: a path is missing, an atlas is damaged, or two files have one name.
        StoreError: the store of an atlas does not answer.
    """

    def __init__(
        self,
        sources: Sequence[str],
        open_localizer: OpenLocalizer,
        max_bytes: int,
        tile_path: TilePath = Atlas.map_path,
    ) -> None:
        self._open_localizer, self._max_bytes, self.tile_path = open_localizer, max_bytes, tile_path
        self._lock = threading.Lock()
        self._entries: OrderedDict[str, _CacheEntry] = (
            OrderedDict()
        )  # the one used last is the last
        for source in sources:
            if "://" not in source and not os.path.exists(source):
                raise MapError(f"{source}: no such map")
        self.atlases = [
            WatchedAtlas(source) for source in dict.fromkeys(sources) if is_atlas(source)
        ]
        self._files = [Path(source) for source in sources if not is_atlas(source)]
        self.names()

    @staticmethod
    def with_memory(
        sources: Sequence[str],
        open_localizer: OpenLocalizer,
        memory_mb: int,
        tile_path: TilePath = Atlas.map_path,
    ) -> MapCache:
        """Create a cache that uses half of the memory (megabytes) for nodes, of all maps of this
        process, and half for the rest of the open maps. Raises as the class does."""
        budget = memory_mb * 500_000
        set_node_cache_size(budget)
        return MapCache(sources, open_localizer, budget, tile_path)

    def names(self) -> list[str]:
        """Of all maps, as they are there now; no object store is asked.

        Raises:
            MapError: two files have one name.
        """
        return list(self._found())

    def _found(self) -> dict[str, _MapSource]:
        found: dict[str, _MapSource] = {}
        for name, one in self._all():
            if found.setdefault(name, one) != one:
                raise MapError(f"two maps are called {name}: {found[name].where} and {one.where}")
        return found

    def _all(self) -> Iterator[tuple[str, _MapSource]]:
        for source in self._files:
            for path in sorted(source.glob(f"*{SUFFIX}")) if source.is_dir() else [source]:
                yield path.name.removesuffix(SUFFIX), _MapSource(str(path))
        for watched in self.atlases:
            atlas = watched.now()
            for tile in atlas.manifest.tiles:
                yield (
                    tile.tile_id,
                    _MapSource(f"{atlas.store.where}/{tile.map.name}", (atlas, tile)),
                )

    @property
    def num_bytes(self) -> int:
        """Bytes of the maps that are open."""
        with self._lock:
            return sum(entry.opened.num_bytes for entry in self._entries.values() if entry.opened)

    @property
    def num_open(self) -> int:
        with self._lock:
            return sum(entry.opened is not None for entry in self._entries.values())

    @contextmanager
    def use_map(self, name: str, path: Path | None = None) -> Iterator[CachedMap]:
        """The map of this name, which stays open meanwhile; of the file `path`, where it is given.

        Raises:
            UnknownMapError: there is no such map.
            MapError: its file is missing or damaged.
        """
        opened = self.acquire_map(name, path)
        try:
            yield opened
        finally:
            self.release_map(opened)

    def acquire_map(self, name: str, path: Path | None = None) -> CachedMap:
        """As `use_map`, until it is given back."""
        path = path or self._path_of(name)
        with self._lock:
            entry = self._entries.setdefault(name, _CacheEntry())
            self._entries.move_to_end(name)
        with entry.lock:
            stamp = _file_stamp(path)
            if entry.opened is None or (entry.opened.path, entry.opened.stamp) != (path, stamp):
                before, entry.opened = entry.opened, None
                self._close_when_unused(before)
                entry.opened = CachedMap(name, path, stamp, self._opened(path))
            opened = entry.opened
            with self._lock:
                opened.num_users += 1
        self._close_oldest()
        return opened

    def release_map(self, opened: CachedMap) -> None:
        with self._lock:
            opened.num_users -= 1
            is_last = opened.is_retired and opened.num_users == 0
        if is_last:
            opened.localizer.topomap.close()

    def close(self) -> None:
        """Let go of all maps; those in use when they are given back."""
        with self._lock:
            opened = [entry.opened for entry in self._entries.values()]
            self._entries.clear()
        for one in opened:
            self._close_when_unused(one)

    def _path_of(self, name: str) -> Path:
        found = self._found().get(name)
        if found is None:
            raise MapNotFoundError(
                f"there is no map {name[:80]!r} here; GET /v1/maps names those that are"
            )
        return Path(found.where) if found.tile is None else self.tile_path(*found.tile)

    def _opened(self, path: Path) -> Localizer:
        topomap = TopoMetricMap.load(path)
        try:
            return self._open_localizer(topomap)
        except BaseException:
            topomap.close()
            raise

    def _close_oldest(self) -> None:
        with self._lock:
            total = sum(entry.opened.num_bytes for entry in self._entries.values() if entry.opened)
            closed = list[CachedMap]()
            for entry in self._entries.values():
                if total <= self._max_bytes:
                    break
                if not entry.lock.acquire(blocking=False):  # somebody opens or takes it right now
                    continue
                opened = entry.opened
                if opened is not None and opened.num_users == 0:
                    entry.opened, total = None, total - opened.num_bytes
                    closed.append(opened)
                entry.lock.release()
        for opened in closed:
            self._close_when_unused(opened)

    def _close_when_unused(self, opened: CachedMap | None) -> None:
        if opened is None:
            return
        with self._lock:
            opened.is_retired = True
            is_unused = opened.num_users == 0
        if is_unused:
            opened.localizer.topomap.close()


def _file_stamp(path: Path) -> tuple[int, ...]:
    """Of a file as it is now: another one in its place has another stamp. Raises MapError where it
    is gone."""
    with suppress(OSError):
        status = path.stat()
        return status.st_mtime_ns, status.st_size, status.st_ino
    raise MapError(f"map {path.name} is gone")
