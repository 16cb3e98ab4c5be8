"""Maps by their names: opened when they are asked for, closed when there are too many, replaced when their file is.

A map's name is that of its file without `.topo`; of an atlas's tile, its id. A file is looked at before each request: another one in its
place is opened, and the one before is let go of when the last request that uses it is answered. What is kept of nodes has a budget of its
own (`map/memory.py`); here a map counts by the bytes of its file, which no open map exceeds apart from its nodes.
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
from topoloc.atlas.store import MANIFEST
from topoloc.errors import MapError, UnknownMapError
from topoloc.localization.localizer import Localizer
from topoloc.map.topomap import TopoMetricMap

SUFFIX = ".topo"
OpenLocalizer = Callable[[TopoMetricMap], Localizer]


@dataclass(eq=False)
class OpenedMap:
    """An open map, as it is shared by all who ask it; `stamp` is that of its file when it was opened."""

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
class _Place:
    """Where one map stands; its lock is held while the map is opened, so that it is opened once and nobody else waits."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    opened: OpenedMap | None = None


class Maps:
    """The maps of these files, folders and atlases.

    Args:
        max_bytes: open maps are closed, those used longest ago first, while they have more bytes than this. One in use is never closed.

    Raises:
        MapError: a path is missing, an atlas is damaged, or two files have one name.
    """

    def __init__(self, sources: Sequence[Path], open_localizer: OpenLocalizer, max_bytes: int) -> None:
        self._sources, self._open_localizer, self._max_bytes = list(sources), open_localizer, max_bytes
        self._lock = threading.Lock()
        self._places: OrderedDict[str, _Place] = OrderedDict()  # the one used last is the last
        self._atlas_paths = dict[Path, tuple[tuple[int, ...], dict[str, Path]]]()
        for source in self._sources:
            if not os.path.exists(source):
                raise MapError(f"{source}: no such map")
        self.paths()

    def paths(self) -> dict[str, Path]:
        """The files by their names, as they are there now.

        Raises:
            MapError: two files have one name.
        """
        found: dict[str, Path] = {}
        for source in self._sources:
            for name, path in self._paths_in(source).items():
                if found.setdefault(name, path) != path:
                    raise MapError(f"two maps are called {name}: {found[name]} and {path}")
        return found

    @property
    def atlases(self) -> list[Path]:
        """Those of the sources that are atlases."""
        return [source for source in self._sources if is_atlas(str(source))]

    def _paths_in(self, source: Path) -> dict[str, Path]:
        if is_atlas(str(source)):
            return self._tiles_of(source)
        paths = sorted(source.glob(f"*{SUFFIX}")) if source.is_dir() else [source]
        return {path.name.removesuffix(SUFFIX): path for path in paths}

    def _tiles_of(self, source: Path) -> dict[str, Path]:
        """The tiles of an atlas, as its manifest names them now."""
        stamp = _stamp_of(source / MANIFEST)
        known = self._atlas_paths.get(source)
        if known is None or known[0] != stamp:
            tiles = Atlas.open(str(source)).manifest.tiles
            self._atlas_paths[source] = known = stamp, {tile.tile_id: source / tile.map.name for tile in tiles}
        return known[1]

    @property
    def num_bytes(self) -> int:
        """Bytes of the maps that are open."""
        with self._lock:
            return sum(place.opened.num_bytes for place in self._places.values() if place.opened)

    @property
    def num_open(self) -> int:
        with self._lock:
            return sum(place.opened is not None for place in self._places.values())

    @contextmanager
    def lent(self, name: str, path: Path | None = None) -> Iterator[OpenedMap]:
        """The map of this name, which stays open meanwhile; of the file `path`, where it is given.

        Raises:
            UnknownMapError: there is no such map.
            MapError: its file is missing or damaged.
        """
        opened = self.lend(name, path)
        try:
            yield opened
        finally:
            self.give_back(opened)

    def lend(self, name: str, path: Path | None = None) -> OpenedMap:
        """As `lent`, until it is given back."""
        path = path or self._path_of(name)
        with self._lock:
            place = self._places.setdefault(name, _Place())
            self._places.move_to_end(name)
        with place.lock:
            stamp = _stamp_of(path)
            if place.opened is None or (place.opened.path, place.opened.stamp) != (path, stamp):
                before, place.opened = place.opened, None
                self._retire(before)
                place.opened = OpenedMap(name, path, stamp, self._opened(path))
            opened = place.opened
            with self._lock:
                opened.num_users += 1
        self._close_oldest()
        return opened

    def give_back(self, opened: OpenedMap) -> None:
        with self._lock:
            opened.num_users -= 1
            is_last = opened.is_retired and opened.num_users == 0
        if is_last:
            opened.localizer.topomap.close()

    def close(self) -> None:
        """Let go of all maps; those in use when they are given back."""
        with self._lock:
            opened = [place.opened for place in self._places.values()]
            self._places.clear()
        for one in opened:
            self._retire(one)

    def _path_of(self, name: str) -> Path:
        path = self.paths().get(name)
        if path is None:
            raise UnknownMapError(f"there is no map {name[:80]!r} here; GET /v1/maps names those that are")
        return path

    def _opened(self, path: Path) -> Localizer:
        topomap = TopoMetricMap.load(path)
        try:
            return self._open_localizer(topomap)
        except BaseException:
            topomap.close()
            raise

    def _close_oldest(self) -> None:
        with self._lock:
            total = sum(place.opened.num_bytes for place in self._places.values() if place.opened)
            closed = list[OpenedMap]()
            for place in self._places.values():
                if total <= self._max_bytes:
                    break
                if not place.lock.acquire(blocking=False):  # somebody opens or takes it right now
                    continue
                opened = place.opened
                if opened is not None and opened.num_users == 0:
                    place.opened, total = None, total - opened.num_bytes
                    closed.append(opened)
                place.lock.release()
        for opened in closed:
            self._retire(opened)

    def _retire(self, opened: OpenedMap | None) -> None:
        if opened is None:
            return
        with self._lock:
            opened.is_retired = True
            is_unused = opened.num_users == 0
        if is_unused:
            opened.localizer.topomap.close()


def _stamp_of(path: Path) -> tuple[int, ...]:
    """Of a file as it is now: another one in its place has another stamp. Raises MapError where it is gone."""
    with suppress(OSError):
        status = path.stat()
        return status.st_mtime_ns, status.st_size, status.st_ino
    raise MapError(f"map {path.name} is gone")
