"""Open an atlas for reading: a snapshot of its manifest, its files, and the index of all nodes."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from topoloc.atlas.index import AtlasIndex, GlobalDescriptors, load_global_descriptors
from topoloc.atlas.index_files import OpenedIndex, index_folder, open_index
from topoloc.atlas.manifest import Manifest, Tile
from topoloc.atlas.store import MANIFEST, FolderStore, Store, sha256_of
from topoloc.atlas.tile_facts import find_other_facts
from topoloc.errors import AtlasError, MapError
from topoloc.json_data import OneLine
from topoloc.mapping.edit import read_history

_OBJECT_STORES = "topoloc.apps.stores.object_store"
"""Module of `ObjectStore`. It is imported by name, because obstore is an optional extra and the
module belongs to the apps."""
T = TypeVar("T")


def store_at(where: str) -> Store:
    """Return the store of an atlas: a folder, or an object store if the address contains `://`.

    Raises:
        AtlasError: the store cannot be opened.
        MissingExtraError: the extra for object stores is not installed.
    """
    if "://" in where:
        return importlib.import_module(_OBJECT_STORES).ObjectStore(where)
    return FolderStore(Path(where))


def read_manifest(store: Store, creates: bool = False) -> tuple[bytes | None, Manifest]:
    """Return the manifest of a store, as bytes and parsed. If there is none and `creates` is set,
    it is an empty one.

    Raises:
        AtlasError: there is no atlas, or it is damaged.
    """
    data = store.manifest()
    if data is not None:
        return data, Manifest.from_bytes(data, f"{store.where}/{MANIFEST}")
    if creates:
        return None, Manifest()
    raise AtlasError(
        f"{store.where} is no atlas: it has no {MANIFEST}; `topoloc atlas create` makes one"
    )


def absolute_address(where: str) -> str:
    """Return the address of an atlas as an absolute path, or unchanged for an object store."""
    return where if "://" in where else os.path.abspath(where)


@dataclass(frozen=True, eq=False, repr=False)
class Atlas(OneLine):
    """Hold a snapshot of an atlas. Later writes do not change it.

    The files of its tiles are kept for a while after they are replaced (`GRACE_S` in `editing.py`).
    """

    store: Store
    manifest: Manifest

    @staticmethod
    def open(where: str) -> Atlas:
        """Read the manifest of an atlas.

        Raises:
            AtlasError: there is no atlas, or it is damaged.
        """
        store = store_at(where)
        return Atlas(store, read_manifest(store)[1])

    @staticmethod
    def from_manifest(where: str, data: bytes) -> Atlas:
        """Return the atlas there as these bytes of a manifest describe it, which need not be its
        newest one. Raises AtlasError."""
        return Atlas(store_at(where), Manifest.from_bytes(data, where))

    @staticmethod
    def create(
        where: str, maps: Sequence[str], tile_id: str | None = None, world: str | None = None
    ) -> Atlas:
        """Create an atlas of map files, which are copied.

        Args:
            where: a folder, or a prefix of an object store such as s3://bucket/campus.
            maps: paths of map files. Each becomes a tile, with the name of its file without .topo.
            tile_id: the name of the tile, for one map.
            world: the name of the world that all maps share; by default each has its own.

        Raises:
            AtlasError: an atlas exists there, two tiles get one name, or it cannot be written.
            MapError: a map is missing, damaged or empty.
        """
        from topoloc.atlas.editing import create_atlas, new_tiles

        return Atlas(store_at(where), create_atlas(where, new_tiles(maps, tile_id, world)))

    @staticmethod
    def add(
        where: str,
        maps: Sequence[str],
        tile_id: str | None = None,
        world: str | None = None,
        replaces: bool = False,
    ) -> Atlas:
        """Add map files to the atlas there, as `create`; with `replaces` tiles of the same names
        are replaced. Raises AtlasError, MapError."""
        from topoloc.atlas.editing import add_tiles, new_tiles

        return Atlas(store_at(where), add_tiles(where, new_tiles(maps, tile_id, world), replaces))

    @staticmethod
    def add_map(
        where: str, tile_id: str, path: Path, world: str, recipe: str, replaces: bool = False
    ) -> Tile:
        """Add a map file as a tile, and create the atlas if there is none. `recipe` is the digest
        of the map's inputs. A tile of the same id is replaced (`replaces`), or is an error, unless
        it has the same recipe.

        Raises AtlasError if the atlas has a tile of the same id or cannot be written, MapError if
        the map is damaged or empty.
        """
        from topoloc.atlas.editing import NewTile, add_tiles

        new = NewTile(tile_id, path, world, recipe)
        return add_tiles(where, [new], replaces, creates=True).by_id[tile_id]

    @staticmethod
    def read_manifest(where: str) -> Manifest:
        """Return the current manifest of an atlas, an empty one if there is no atlas yet.

        Raises:
            AtlasError: the manifest is damaged, or the store does not answer.
            MissingExtraError: the store needs an extra that is not installed.
        """
        return read_manifest(store_at(where), creates=True)[1]

    @staticmethod
    def remove(where: str, tile_ids: Sequence[str]) -> Atlas:
        """Remove tiles from the atlas there. Raises AtlasError."""
        from topoloc.atlas.editing import remove_tiles

        return Atlas(store_at(where), remove_tiles(where, tile_ids))

    @staticmethod
    def merge(sources: Sequence[str], where: str) -> Atlas:
        """Create an atlas of the tiles of all sources, atlases or map files, with their joins.
        Raises AtlasError, MapError."""
        from topoloc.atlas.place import merge_atlases

        return Atlas(store_at(where), merge_atlases(sources, where))

    def __reduce__(self) -> Any:
        return Atlas.from_manifest, (self.address, self.manifest.to_bytes())

    @property
    def kinds(self) -> tuple[str, ...]:
        """Return the feature types of all tiles."""
        return tuple(sorted({kind for tile in self.manifest.tiles for kind in tile.kinds}))

    @property
    def address(self) -> str:
        """Its address from any working directory."""
        return absolute_address(self.store.where)

    @property
    def name(self) -> str:
        """Return the last part of its address."""
        return self.store.where.rstrip("/").rpartition("/")[2] or "atlas"

    def select_tiles(self, tile_id: str | None = None) -> list[str]:
        """Return the id of the named tile, or the ids of all tiles. Raises AtlasError: there is no
        such tile."""
        return list(self.manifest.by_id) if tile_id is None else [self.tile(tile_id).tile_id]

    def title(self, tile_id: str) -> str:
        """Return the address of the atlas with the id of a tile."""
        return f"{self.store.where}, tile {tile_id}"

    def edit(self, tile_id: str, edit: Callable[[Path], T]) -> T:
        """Edit the map of a tile and return the result of `edit`. Raises as `edit_tile`."""
        from topoloc.atlas.place import edit_tile

        return edit_tile(self.store.where, tile_id, edit)

    def report(self, facts: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
        """Return facts of tiles, by id, as one JSON object."""
        tiles = [{"tile_id": tile_id} | one for tile_id, one in facts.items()]
        return {"atlas": self.store.where, "tiles": tiles}

    def visit(self, on_map: Callable[[str], T], on_atlas: Callable[[Atlas], T]) -> T:
        """Return the result of `on_atlas`, called with this atlas. See `SingleMap.visit`."""
        return on_atlas(self)

    def find_problem(self, tile_id: str) -> str | None:
        """Return the first difference between a tile's files and their checksums, or between its
        map and its entry in the manifest, None if there is none. Raises AtlasError: the atlas has
        no such tile."""
        tile = self.tile(tile_id)
        for stored in tile.files:
            try:
                path = self.store.local_path(stored.name, stored.sha256)
                if path.stat().st_size != stored.num_bytes or sha256_of(path) != stored.sha256:
                    return f"{stored.name} is not the file that was added: its checksum is another"
            except AtlasError as error:
                return str(error)
        try:
            other = find_other_facts(tile, self.map_path(tile))
        except MapError as error:
            return str(error)
        return f"{MANIFEST} differs from its map: {', '.join(other)}" if other else None

    def tile(self, tile_id: str) -> Tile:
        """Return the tile with this id.

        Raises:
            AtlasError: there is no such tile.
        """
        tile = self.manifest.by_id.get(tile_id)
        if tile is None:
            known = ", ".join(list(self.manifest.by_id)[:8]) or "none"
            raise AtlasError(
                f"the atlas {self.store.where} has no tile {tile_id[:80]!r} (it has: {known})"
            )
        return tile

    def map_path(self, tile: Tile) -> Path:
        """Return the local path of the tile's map file.

        Raises:
            AtlasError: the file is missing.
        """
        return self.store.local_path(tile.map.name, tile.map.sha256)

    def history(self, tile_id: str) -> list[dict[str, Any]]:
        """Return the edits of a tile's map, as `read_history` does. Raises AtlasError, MapError."""
        tile = self.tile(tile_id)
        return read_history(self.map_path(tile), len(tile.previous))

    @cached_property
    def _opened(self) -> OpenedIndex:
        return open_index(self.manifest.tiles, self.places_of, index_folder(self.store.where))

    def places_of(self, tile: Tile) -> GlobalDescriptors:
        """Return the global descriptors of a tile's nodes.

        Raises:
            AtlasError: the file is missing or damaged.
        """
        path = self.store.local_path(tile.places.name, tile.places.sha256)
        if sha256_of(path) != tile.places.sha256:
            raise AtlasError(f"{path} is not the file that was added: its checksum is another")
        vectors = load_global_descriptors(path, tile.places.vocabularies)
        if any(len(rows) != tile.num_nodes for rows in vectors.values()):
            raise AtlasError(f"{path} is damaged: the tile has {tile.num_nodes} nodes")
        return vectors

    @property
    def problems(self) -> dict[str, str]:
        """Return the reason for each tile (by id) that cannot be ranked. These tiles are queried
        last."""
        return self._opened.problems

    @property
    def notes(self) -> list[str]:
        """Return problems with the index files. The index works without these files."""
        return self._opened.notes

    @property
    def index(self) -> AtlasIndex:
        """Return the index of all tiles with readable global descriptors."""
        return self._opened.index
