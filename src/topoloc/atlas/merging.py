"""Merge atlases and maps into one atlas, with all tiles and joins unchanged."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

from msgspec.structs import replace

from topoloc.atlas.atlas import Atlas, store_at
from topoloc.atlas.editing import new_tiles, store_tile
from topoloc.atlas.joins import Join
from topoloc.atlas.manifest import Manifest, Tile
from topoloc.atlas.place import open_place
from topoloc.atlas.store import Store
from topoloc.errors import AtlasError


def merge_atlases(sources: Sequence[str], where: str) -> Manifest:
    """Create an atlas at `where` from the tiles of all sources (atlases or map files).

    A map with the same id in two sources becomes one tile. Worlds of different sources stay
    distinct, even if they have the same name.

    Raises:
        AtlasError: there is an atlas already, two tiles of one id hold different maps, a tile's
            file is missing or wrong, or the atlas cannot be written.
        MapError: a map is missing, damaged or empty.
    """
    store = store_at(where)
    if store.manifest() is not None:
        raise AtlasError(f"{where} is an atlas already; a merged one is new")
    tiles, joins = dict[str, Tile](), list[Join]()

    def store_map(path: str) -> dict[str, Tile]:
        (new,) = new_tiles([path])
        added = {new.tile_id: store_tile(new, store)}
        _check_same(path, tiles, added)
        return added

    def store_atlas(atlas: Atlas) -> dict[str, Tile]:
        _check_same(atlas.store.where, tiles, atlas.manifest.by_id)
        for tile in atlas.manifest.tiles:
            _copy_files(atlas, tile, store)
        joins.extend(atlas.manifest.joins)
        return atlas.manifest.by_id

    for source in sources:
        added = open_place(source).visit(store_map, store_atlas)
        tiles = _with_unique_worlds(tiles, added) | tiles
    after = Manifest().with_tiles(tiles, time.time(), joins)
    if not store.commit(None, after.to_bytes()):
        raise AtlasError(f"{where} became an atlas meanwhile; it stays as it is")
    return after


def _copy_files(atlas: Atlas, tile: Tile, store: Store) -> None:
    problem = atlas.find_problem(tile.tile_id)
    if problem is not None:
        raise AtlasError(f"tile {tile.tile_id} of {atlas.store.where}: {problem}")
    for stored in tile.files:
        store.put(stored.name, atlas.store.local_path(stored.name, stored.sha256))


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
