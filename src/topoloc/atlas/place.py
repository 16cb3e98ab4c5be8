"""Open a map file or an atlas. Both are places of tiles, with the same methods. Merge them into one
atlas, with all tiles and joins unchanged. Group the tiles of an atlas by common world."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from msgspec.structs import replace

from topoloc.atlas.atlas import Atlas, store_at
from topoloc.atlas.editing import (
    NewTile,
    new_tiles,
    removing_new_files_on_failure,
    replace_tile,
    store_tile,
)
from topoloc.atlas.joins import Join
from topoloc.atlas.manifest import Manifest, StoredFile, Tile
from topoloc.atlas.store import MANIFEST, sha256_of
from topoloc.errors import AtlasError, MapError, ObjectStoreError, TopolocError
from topoloc.geometry.geodesy import Georeference
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import OneLine
from topoloc.mapping.edit import kept_path, read_history
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.atomic import temporary_folder


@dataclass(frozen=True, eq=False)
class PlacedTile:
    """Hold a tile and the transform from its map's world to the shared one."""

    tile: Tile
    world_from_map: Rigid3


@dataclass(frozen=True, eq=False, repr=False)
class SharedWorld(OneLine):
    """Hold the tiles of one world, sorted by id.

    For georeferenced tiles it is the atlas world (east-north-up). Otherwise it is a joint world, or
    a world that several tiles share. `georeference` is None if it is unknown.
    """

    tiles: tuple[PlacedTile, ...]
    georeference: Georeference | None

    @staticmethod
    def group(manifest: Manifest) -> list[SharedWorld]:
        """Group all tiles by the worlds that they share, the world with most nodes first."""
        groups: dict[str | None, list[PlacedTile]] = {}
        for tile in manifest.tiles:
            joint, pose = tile.in_joint_world, tile.atlas_from_world
            key, pose = (joint.joint, joint.joint_from_world) if pose is None else (None, pose)
            groups.setdefault(key, []).append(PlacedTile(tile, pose))
        origin = manifest.origin
        on_earth = None if origin is None else Georeference(origin, Rigid3.identity(), "atlas")
        worlds = [
            SharedWorld(tuple(group), on_earth if key is None else None)
            for key, group in groups.items()
        ]
        return sorted(worlds, key=lambda world: -world.num_nodes)

    @staticmethod
    def of_tile(manifest: Manifest, tile: Tile) -> SharedWorld:
        """Return a tile alone, in the world of its map."""
        return SharedWorld((PlacedTile(tile, Rigid3.identity()),), manifest.georeference_of(tile))

    @property
    def num_nodes(self) -> int:
        """Return the number of nodes of all tiles."""
        return sum(placed.tile.num_nodes for placed in self.tiles)

    def world_from_map_of(self, tile_id: str | None) -> Rigid3 | None:
        """Return the transform from a tile's map to this world, None for a tile of another
        world."""
        return next(
            (placed.world_from_map for placed in self.tiles if placed.tile.tile_id == tile_id), None
        )

    def open_tiles(
        self, atlas: Atlas, warn: Callable[[str], None]
    ) -> Iterator[tuple[PlacedTile, TopoMetricMap]]:
        """Iterate over tiles with their maps. Each map is open during its iteration. A tile that
        cannot be read is skipped with a warning.

        Raises AtlasError if no tile can be read, ObjectStoreError if the store does not respond.
        """
        num_opened = 0
        for one in self.tiles:
            try:
                topomap = TopoMetricMap.load(atlas.map_path(one.tile))
            except ObjectStoreError:
                raise
            except MapError as error:
                warn(f"tile {one.tile.tile_id} is left out: {error}")
                continue
            num_opened += 1
            with topomap:
                yield one, topomap
        if num_opened == 0:
            raise AtlasError(f"no tile of the atlas {atlas.store.where} can be read")


_MAX_TRIES = 5
T = TypeVar("T")


@dataclass(frozen=True)
class SingleMap:
    """A map file with the methods of an atlas. It is one tile with the id "".

    The file need not exist: the methods that read it raise MapError then.
    """

    where: str

    @property
    def name(self) -> str:
        """Return the name of the file without .topo."""
        return Path(self.where).name.removesuffix(".topo")

    def select_tiles(self, tile_id: str | None = None) -> list[str]:
        """Return [""]. Raises AtlasError: a tile is named."""
        if tile_id is not None:
            raise AtlasError(
                f"{self.where} is a map file and has no tile {tile_id[:80]!r}; omit the tile"
            )
        return [""]

    def title(self, tile_id: str) -> str:
        """Return the path of the file."""
        return self.where

    def history(self, tile_id: str) -> list[dict[str, Any]]:
        """Return the edits of the map, as `read_history` does. Raises MapError."""
        return read_history(self.where)

    def edit(self, tile_id: str, edit: Callable[[Path], T]) -> T:
        """Return the result of `edit`, called with the path of the file. Raises as `edit`."""
        return edit(Path(self.where))

    def report(self, facts: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
        """Return the facts of the map as one JSON object."""
        return {"map": self.where} | facts[""]

    def visit(self, on_map: Callable[[str], T], on_atlas: Callable[[Atlas], T]) -> T:
        """Return the result of `on_map`, called with the path of the file."""
        return on_map(self.where)


def open_place(where: str) -> SingleMap | Atlas:
    """Open the atlas in a folder or an object store. Any other path is a map file, which is not
    opened yet.

    Raises:
        AtlasError: the atlas is damaged.
        ObjectStoreError, MissingExtraError: an object store does not respond, or its extra is not
            installed.
    """
    if "://" in where or os.path.isfile(Path(where) / MANIFEST):
        return Atlas.open(where)
    return SingleMap(where)


def edit_tile(where: str, tile_id: str, edit: Callable[[Path], T]) -> T:
    """Edit the map of a tile and return the result of `edit`. The tile keeps its world and its
    joins.

    `edit` is a function that edits the map file at a path, as `mapping/edit.py` does. It receives a
    copy, with the file before the last edit kept beside it. It is called again if another writer
    replaced the tile in the meantime. Its errors leave the atlas unchanged.

    Raises AtlasError if there is no such atlas or tile, it cannot be read or written, or other
    writers replaced the tile in each of five tries.
    """
    for _ in range(_MAX_TRIES):
        atlas = Atlas.open(where)
        before = atlas.tile(tile_id)
        with temporary_folder("topoloc-tile-") as folder:
            path = folder / f"{tile_id}.topo"
            _copy_map(atlas, before.map, path)
            for last in before.previous[:1]:
                _copy_map(atlas, last, kept_path(path, before.map.sha256, last.sha256))
            try:
                done = edit(path)
            except TopolocError as error:  # the message names the tile instead of the copy
                text = str(error).replace(str(path), f"{where}, tile {tile_id}")
                error.args = (text, *error.args[1:])
                raise
            if sha256_of(path) == before.map.sha256:
                return done
            new = NewTile(tile_id, path, before.world, before.recipe, before.previous[1:])
            after = replace_tile(where, new, before)
        if after is not None:
            return done
    raise AtlasError(
        f"{where}: tile {tile_id} was replaced by others {_MAX_TRIES} times meanwhile; it stays as"
        " they left it"
    )


def _copy_map(atlas: Atlas, stored: StoredFile, path: Path) -> None:
    with AtlasError.at(f"cannot copy {stored.name} of {atlas.store.where}", OSError):
        shutil.copyfile(atlas.store.local_path(stored.name, stored.sha256), path)
    if sha256_of(path) != stored.sha256:
        raise AtlasError(
            f"{stored.name} of {atlas.store.where} is not the file that was added: its checksum is"
            " another"
        )


def merge_atlases(sources: Sequence[str], where: str) -> Manifest:
    """Create an atlas at `where` from the tiles of all sources (atlases or map files). A map with
    the same id in two sources becomes one tile. Worlds of different sources stay distinct, even if
    they have the same name.

    Raises AtlasError if there is an atlas already, two tiles of one id hold different maps, a
    tile's file is missing or wrong, or the atlas cannot be written. Raises MapError if a map is
    missing, damaged or empty.
    """
    store = store_at(where)
    if store.manifest() is not None:
        raise AtlasError(f"{where} is an atlas already; a merged one is new")
    tiles, joins = dict[str, Tile](), list[Join]()

    def store_map(path: str) -> dict[str, Tile]:
        (new,) = new_tiles([path])
        added = {new.tile_id: store_tile(new, put)}
        _check_same(path, tiles, added)
        return added

    def store_atlas(atlas: Atlas) -> dict[str, Tile]:
        _check_same(atlas.store.where, tiles, atlas.manifest.by_id)
        for tile in atlas.manifest.tiles:
            if (problem := atlas.find_problem(tile.tile_id)) is not None:
                raise AtlasError(f"tile {tile.tile_id} of {atlas.store.where}: {problem}")
            for stored in tile.files:
                put(stored.name, atlas.store.local_path(stored.name, stored.sha256))
        joins.extend(atlas.manifest.joins)
        return atlas.manifest.by_id

    with removing_new_files_on_failure(store) as put:
        for source in sources:
            added = open_place(source).visit(store_map, store_atlas)
            tiles = _with_unique_worlds(tiles, added) | tiles
        after = Manifest().with_tiles(tiles, time.time(), joins)
        if not store.commit(None, after.to_bytes()):
            raise AtlasError(f"{where} became an atlas meanwhile; it stays as it is")
    return after


def _check_same(source: str, known: Mapping[str, Tile], added: Mapping[str, Tile]) -> None:
    for tile_id in known.keys() & added.keys():
        if known[tile_id].map.sha256 != added[tile_id].map.sha256:
            raise AtlasError(
                f"{source} has a tile {tile_id} too, of another map; `topoloc atlas add --id` gives"
                " a map another id"
            )


def _with_unique_worlds(known: Mapping[str, Tile], added: Mapping[str, Tile]) -> dict[str, Tile]:
    """Rename the worlds of added tiles so that they differ from the known ones.

    A world with a tile in both is the same world and gets the known name.
    """
    same = {added[tile_id].world: known[tile_id].world for tile_id in known.keys() & added.keys()}
    taken = {tile.world for tile in known.values()}
    names = dict[str, str]()
    for world in sorted({tile.world for tile in added.values()}):
        number, name = 2, same.get(world, world)
        while world not in same and name in taken:
            number, name = number + 1, f"{world[:90]}-{number}"
        taken.add(name)
        names[world] = name
    return {tile_id: replace(tile, world=names[tile.world]) for tile_id, tile in added.items()}
