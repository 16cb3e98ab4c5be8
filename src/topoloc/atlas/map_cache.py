"""Cache open maps by name.

Maps are opened on demand, closed if they take too much memory, and reopened if their file changes.

A map's name is its file name without `.topo`, or the tile id in an atlas. Tiles in object stores
are local files once opened. The `tile_path` of the `MapCache` fetches them. The file is checked
before each request. If it was replaced, the new one is opened, and the old one is closed after its
last request. Cached nodes have a memory budget of their own (`mapping/node_cache.py`). Here a map
counts with its file size, which bounds the memory of an open map without its nodes.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.manifest import Tile
from topoloc.atlas.place import open_place
from topoloc.atlas.store import file_stamp, store_at
from topoloc.errors import AtlasError, MapError, MapNotFoundError
from topoloc.mapping.node_cache import set_node_cache_size
from topoloc.mapping.topomap import TopoMetricMap

SUFFIX = ".topo"
RETRY_AFTER_S = 5.0
"""Seconds before a tile that could not be fetched or opened is tried again."""
TilePath = Callable[[Atlas, Tile], Path]
"""A function that returns the local map file of a tile. It raises AtlasError, or another exception
if the file is not available yet."""


@runtime_checkable
class OpenedMap(Protocol):
    """Define the content of the cache: something that holds an open map."""

    @property
    def topomap(self) -> TopoMetricMap:
        """Return the map."""
        ...


M = TypeVar("M", bound=OpenedMap)


@dataclass(eq=False)
class CachedMap(Generic[M]):
    """Hold an open map, shared by all its users. `stamp` is the file's stamp when it was opened."""

    name: str
    path: Path
    stamp: tuple[int, ...]
    content: M
    num_users: int = 0
    is_retired: bool = False

    @property
    def num_bytes(self) -> int:
        """Return the size of the map file, bytes."""
        return self.stamp[1]


@dataclass(eq=False)
class _CacheEntry(Generic[M]):
    """Hold one map of the cache.

    Its lock is held while the map is opened, so that it is opened once and other maps are not
    blocked.
    """

    lock: threading.Lock = field(default_factory=threading.Lock)
    opened: CachedMap[M] | None = None


@dataclass(frozen=True)
class _MapSource:
    """Describe the source of a map: its file, and the atlas if it is a tile."""

    where: str
    tile: tuple[Atlas, Tile] | None = field(default=None, compare=False)


class WatchedAtlas:
    """Hold the current version of an atlas, for long-running readers. It is opened again when its
    manifest changes.

    In a folder each access checks the manifest file. An object store may take a minute to respond.
    There `look` is called now and then in the background, and readers continue with the last
    version, even while the store does not respond.

    Raises:
        AtlasError: there is no atlas, or it is damaged.
        ObjectStoreError: its store does not respond.
        MissingExtraError: the extra for object stores is not installed.
    """

    def __init__(self, where: str) -> None:
        self.where, self.is_remote = where, "://" in where
        self._store, self._lock = store_at(where), threading.Lock()
        self._version, self._atlas = self._check_version(), self._open()

    def now(self) -> Atlas:
        """Return the current atlas of a folder, or the last seen version of an object store.

        Raises:
            AtlasError: the atlas cannot be read.
        """
        if not self.is_remote:
            with self._lock:
                self.look()
        return self._atlas

    def look(self) -> bool:
        """Open the atlas again if its manifest changed, and return whether it did. Only one thread
        may call it at a time.

        Raises AtlasError if the atlas is gone or damaged, ObjectStoreError if the store does not
        respond.
        """
        version = self._check_version()
        if version == self._version:
            return False
        self._version, self._atlas = version, self._open()
        return True

    def _check_version(self) -> Hashable:
        version = self._store.version()
        if version is None:
            raise AtlasError(f"{self.where} is no atlas, or not any more: it has no manifest")
        return version

    def _open(self) -> Atlas:
        atlas = Atlas.open(self.where)
        if self.is_remote:
            _ = atlas.index  # fetches the index files now, not during a query
        return atlas


class MapCache(Generic[M]):
    """Cache the maps of files, folders and atlases. Atlases may be in object stores.

    Args:
        max_bytes: memory limit. Open maps that are not in use are closed above it, least recently
            used first.
        tile_path: returns the local file of a tile. The default fetches it while the caller waits.

    Raises:
        MapError: a path is missing, an atlas is damaged, or two files have the same name.
        ObjectStoreError: the store of an atlas does not respond.
    """

    def __init__(
        self,
        sources: Sequence[str],
        open_map: Callable[[TopoMetricMap], M],
        max_bytes: int,
        tile_path: TilePath = Atlas.map_path,
    ) -> None:
        self._open_map, self._max_bytes, self.tile_path = open_map, max_bytes, tile_path
        self._lock = threading.Lock()
        self._entries: OrderedDict[str, _CacheEntry[M]] = OrderedDict()  # least recently used first
        for source in sources:
            if "://" not in source and not os.path.exists(source):
                raise MapError(f"{source}: no such map")
        self.atlases, self._files = list[WatchedAtlas](), list[Path]()
        for source in dict.fromkeys(sources):
            open_place(source).visit(
                lambda path: self._files.append(Path(path)),
                lambda atlas: self.atlases.append(WatchedAtlas(atlas.store.where)),
            )
        self.names()

    @staticmethod
    def with_memory(
        sources: Sequence[str],
        open_map: Callable[[TopoMetricMap], M],
        memory_mb: int,
        tile_path: TilePath = Atlas.map_path,
    ) -> MapCache[M]:
        """Create a cache that uses half of the memory (megabytes) for nodes, of all maps of this
        process, and half for the rest of the open maps. Raises as the class does."""
        budget = memory_mb * 500_000
        set_node_cache_size(budget)
        return MapCache(sources, open_map, budget, tile_path)

    def names(self) -> list[str]:
        """Return the names of all current maps. No object store is queried.

        Raises:
            MapError: two files have the same name.
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
        for atlas in [watched.now() for watched in self.atlases]:
            for tile in atlas.manifest.tiles:
                where = f"{atlas.store.where}/{tile.map.name}"
                yield tile.tile_id, _MapSource(where, (atlas, tile))

    @property
    def num_bytes(self) -> int:
        """Return the total bytes of the open maps."""
        with self._lock:
            return sum(opened.num_bytes for opened in self._opened_maps())

    @property
    def num_open(self) -> int:
        """Return the number of open maps."""
        with self._lock:
            return len(self._opened_maps())

    def _opened_maps(self) -> list[CachedMap[M]]:
        return [entry.opened for entry in self._entries.values() if entry.opened is not None]

    @contextmanager
    def use_map(self, name: str, path: str | Path | None = None) -> Iterator[CachedMap[M]]:
        """Open the map of this name for the context, from the file `path` if it is given.

        Raises:
            MapNotFoundError: there is no such map.
            MapError: its file is missing or damaged.
        """
        opened = self.acquire_map(name, path)
        try:
            yield opened
        finally:
            self.release_map(opened)

    def acquire_map(self, name: str, path: str | Path | None = None) -> CachedMap[M]:
        """Open a map as `use_map` does. It stays open until `release_map`."""
        path = Path(path or self._path_of(name))
        with self._lock:
            entry = self._entries.setdefault(name, _CacheEntry())
            self._entries.move_to_end(name)
        with entry.lock:
            if (stamp := file_stamp(path)) is None:
                raise MapError(f"map {path.name} is gone")
            if entry.opened is None or (entry.opened.path, entry.opened.stamp) != (path, stamp):
                before, entry.opened = entry.opened, None
                if before is not None:
                    self._close_when_unused(before)
                entry.opened = CachedMap(name, path, stamp, self._opened(path))
            opened = entry.opened
            with self._lock:
                opened.num_users += 1
        self._close_oldest()
        return opened

    def release_map(self, opened: CachedMap[M]) -> None:
        """Release a map from `acquire_map`. A retired map is closed after its last user."""
        with self._lock:
            opened.num_users -= 1
            is_last = opened.is_retired and opened.num_users == 0
        if is_last:
            opened.content.topomap.close()

    def close(self) -> None:
        """Close all maps. Maps in use are closed when they are released."""
        with self._lock:
            opened = self._opened_maps()
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

    def _opened(self, path: Path) -> M:
        topomap = TopoMetricMap.load(path)
        try:
            return self._open_map(topomap)
        except BaseException:
            topomap.close()
            raise

    def _close_oldest(self) -> None:
        with self._lock:
            total = sum(opened.num_bytes for opened in self._opened_maps())
            closed = list[CachedMap[M]]()
            for entry in self._entries.values():
                if total <= self._max_bytes:
                    break
                if not entry.lock.acquire(blocking=False):  # another thread is opening it
                    continue
                opened = entry.opened
                if opened is not None and opened.num_users == 0:
                    entry.opened, total = None, total - opened.num_bytes
                    closed.append(opened)
                entry.lock.release()
        for opened in closed:
            self._close_when_unused(opened)

    def _close_when_unused(self, opened: CachedMap[M]) -> None:
        with self._lock:
            opened.is_retired = True
            is_unused = opened.num_users == 0
        if is_unused:
            opened.content.topomap.close()
