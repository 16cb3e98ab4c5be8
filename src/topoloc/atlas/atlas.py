"""Open an atlas for reading: a snapshot of its manifest, its files, and the index of all nodes."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from topoloc.atlas import editing
from topoloc.atlas.editing import NewTile
from topoloc.atlas.index import AtlasIndex, GlobalDescriptors, load_global_descriptors
from topoloc.atlas.index_files import index_folder, open_index
from topoloc.atlas.joint_worlds import Join
from topoloc.atlas.manifest import Manifest, StoredFile, Tile
from topoloc.atlas.store import MANIFEST, Store, find_store, read_manifest, sha256_of, store_at
from topoloc.errors import AtlasError, MapError, TopolocError
from topoloc.json_data import OneLine
from topoloc.mapping.edit import read_history
from topoloc.mapping.storage.kept_files import kept_path
from topoloc.recordings.atomic import temporary_folder

T = TypeVar("T")


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
        new = editing.new_tiles(maps, tile_id, world)
        return Atlas(store_at(where), editing.create_atlas(where, new))

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
        new = editing.new_tiles(maps, tile_id, world)
        return Atlas(store_at(where), editing.add_tiles(where, new, replaces))

    @staticmethod
    def add_map(
        where: str,
        tile_id: str,
        path: str | Path,
        world: str,
        recipe: str,
        replaces: bool = False,
    ) -> Tile:
        """Add a map file as a tile, and create the atlas if there is none. `recipe` is the digest
        of the map's inputs. A tile of the same id is replaced (`replaces`), or is an error, unless
        it has the same recipe.

        Raises AtlasError if the atlas has a tile of the same id or cannot be written, MapError if
        the map is damaged or empty.
        """
        new = NewTile(tile_id, Path(path), world, recipe)
        return editing.add_tiles(where, [new], replaces, creates=True).by_id[tile_id]

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
        return Atlas(store_at(where), editing.remove_tiles(where, tile_ids))

    @staticmethod
    def merge(sources: Sequence[str], where: str) -> Atlas:
        """Create an atlas of the tiles of all sources, atlases or map files, with their joins. A
        map with the same id in two sources becomes one tile. Worlds of different sources stay
        distinct, even if they have the same name.

        Raises AtlasError if there is an atlas already, two tiles of one id hold different maps, a
        tile's file is missing or wrong, or the atlas cannot be written. Raises MapError if a map is
        missing, damaged or empty.
        """
        store = store_at(where)
        if store.manifest() is not None:
            raise AtlasError(f"{where} is an atlas already; a merged one is new")
        tiles, joins = dict[str, Tile](), list[Join]()
        with editing.removing_new_files_on_failure(store) as put:
            for source in sources:
                if (of_source := find_store(source)) is None:
                    (new,) = editing.new_tiles([source])
                    added = {new.tile_id: editing.store_tile(new, put)}
                else:
                    atlas = Atlas(of_source, read_manifest(of_source)[1])
                    added = atlas.manifest.by_id
                    atlas._copy_files(put)
                    joins += atlas.manifest.joins
                editing.check_same_maps(source, tiles, added)
                tiles = editing.with_unique_worlds(tiles, added) | tiles
            after = Manifest().with_tiles(tiles, time.time(), joins)
            if not store.commit(None, after.to_bytes()):
                raise AtlasError(f"{where} became an atlas meanwhile; it stays as it is")
        return Atlas(store, after)

    def __reduce__(self) -> Any:
        return Atlas.from_manifest, (self.address, self.manifest.to_bytes())

    @property
    def kinds(self) -> tuple[str, ...]:
        """Return the feature types of all tiles."""
        return tuple(sorted({kind for tile in self.manifest.tiles for kind in tile.kinds}))

    @property
    def address(self) -> str:
        """Its address from any working directory."""
        where = self.store.where
        return where if "://" in where else os.path.abspath(where)

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
        """Edit the map of a tile in the newest version of the atlas, and return the result of
        `edit`. The tile keeps its world and its joins.

        `edit` is a function that edits the map file at a path, as `mapping/edit.py` does. It
        receives a copy, with the file before the last edit kept beside it. It is called again if
        another writer replaced the tile in the meantime. Its errors leave the atlas unchanged.

        Raises AtlasError if there is no such atlas or tile, it cannot be read or written, or other
        writers replaced the tile in each of five tries.
        """
        where, max_tries = self.store.where, 5
        for _ in range(max_tries):
            atlas = Atlas.open(where)
            before = atlas.tile(tile_id)
            with temporary_folder("topoloc-tile-") as folder:
                path = folder / f"{tile_id}.topo"
                atlas._copy_map(before.map, path)
                for last in before.previous[:1]:
                    atlas._copy_map(last, kept_path(path, before.map.sha256, last.sha256))
                try:
                    done = edit(path)
                except TopolocError as error:  # the message names the tile instead of the copy
                    text = str(error).replace(str(path), self.title(tile_id))
                    error.args = (text, *error.args[1:])
                    raise
                if sha256_of(path) == before.map.sha256:
                    return done
                new = NewTile(tile_id, path, before.world, before.recipe, before.previous[1:])
                if editing.replace_tile(where, new, before) is not None:
                    return done
        raise AtlasError(
            f"{where}: tile {tile_id} was replaced by others {max_tries} times meanwhile; it stays"
            " as they left it"
        )

    def _copy_map(self, stored: StoredFile, path: Path) -> None:
        with AtlasError.at(f"cannot copy {stored.name} of {self.store.where}", OSError):
            shutil.copyfile(self.store.local_path(stored.name, stored.sha256), path)
        if sha256_of(path) != stored.sha256:
            raise AtlasError(
                f"{stored.name} of {self.store.where} is not the file that was added: its checksum"
                " is another"
            )

    def _copy_files(self, put: Callable[[str, Path], None]) -> None:
        """Copy the files of all tiles by `put`. Raises AtlasError if one is missing or wrong."""
        for tile in self.manifest.tiles:
            if (problem := self.find_problem(tile.tile_id)) is not None:
                raise AtlasError(f"tile {tile.tile_id} of {self.store.where}: {problem}")
            for stored in tile.files:
                put(stored.name, self.store.local_path(stored.name, stored.sha256))

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
            other = editing.find_other_facts(tile, self.map_path(tile))
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
    def index(self) -> AtlasIndex:
        """Return the index of all tiles with readable global descriptors."""
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
