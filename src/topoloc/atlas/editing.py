"""Add tiles to an atlas and remove them, with several concurrent writers.

Files are stored first, under names derived from their contents. Only the manifest is shared. A
writer reads it, makes the next version, and commits it if the manifest is unchanged. Otherwise it
starts again with the new manifest. So no writer loses a tile of another.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from topoloc.atlas.index import compute_global_descriptors, save_global_descriptors
from topoloc.atlas.joint_worlds import Join, geo_box
from topoloc.atlas.manifest import TILES, Manifest, PlacesFile, StoredFile, Tile, check_tile_id
from topoloc.atlas.store import Store, read_manifest, sha256_of, store_at
from topoloc.errors import AtlasError, EmptyMapError
from topoloc.mapping.storage.kept_files import find_kept_files, select_kept
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.atomic import temporary_file
from topoloc.retrieval.shared_vocabulary import shared_vocabulary

GRACE_S = 3600.0
"""Seconds for which files without a reference are kept, because readers may still use the previous
manifest."""
_MAX_TRIES = 1000
PutFile = Callable[[str, Path], None]
"""`Store.put`: stores a copy of a file under a name."""
ManifestEdit = Callable[[Manifest, float], Manifest]
"""A function from a manifest and the time (Unix seconds) to the next manifest. It may be called
several times."""


@dataclass(frozen=True)
class NewTile:
    """Describe a map file to be added as a tile of this id, in this world.

    `recipe` is the digest of the map's inputs, None if unknown. `older` are stored files of earlier
    edits, in addition to the kept files beside the map.
    """

    tile_id: str
    path: Path
    world: str
    recipe: str | None = None
    older: tuple[StoredFile, ...] = ()


def new_tiles(
    paths: Sequence[str], tile_id: str | None = None, world: str | None = None
) -> list[NewTile]:
    """Return the map files as new tiles. `tile_id` is the id of a single file's tile, by default
    the file name without `.topo`. `world` names the world that all of them share, by default each
    has its own. Raises AtlasError if two tiles have the same id, or an id is invalid."""
    ids = [tile_id or Path(path).name.removesuffix(".topo") for path in paths]
    tiles = [
        NewTile(name, Path(path), world or name) for name, path in zip(ids, paths, strict=True)
    ]
    for tile in tiles:
        check_tile_id(tile.tile_id)
        check_tile_id(tile.world)
        same = [other.path for other in tiles if other.tile_id == tile.tile_id]
        if len(same) > 1:
            raise AtlasError(f"two tiles would be called {tile.tile_id}: {same[0]} and {same[1]}")
    return tiles


def create_atlas(where: str, new: Sequence[NewTile]) -> Manifest:
    """Create an atlas of these tiles and return its manifest. Raises AtlasError if there is an
    atlas already or it cannot be written, MapError if a map is missing, damaged or empty."""
    store = store_at(where)

    def create(manifest: Manifest, added: dict[str, Tile], now: float) -> Manifest:
        if store.manifest() is not None:
            raise AtlasError(f"{where} is an atlas already; `topoloc atlas add` adds to it")
        return manifest.with_tiles(added, now)

    return _store_and_commit(store, new, create, grace_s=math.inf, creates=True)


def add_tiles(
    where: str,
    new: Sequence[NewTile],
    replaces: bool = False,
    grace_s: float = GRACE_S,
    creates: bool = False,
) -> Manifest:
    """Add tiles and return the new manifest.

    Tiles of the same ids are replaced (`replaces`). Otherwise they are an error, unless they have
    the same recipe. Unreferenced files are kept for `grace_s` seconds. If there is no atlas, it is
    created (`creates`) or AtlasError is raised. Raises MapError if a map is missing, damaged or
    empty.
    """

    def add(manifest: Manifest, added: dict[str, Tile], now: float) -> Manifest:
        taken = [
            tile.tile_id
            for tile in new
            if (there := manifest.by_id.get(tile.tile_id)) is not None
            and (tile.recipe is None or there.recipe != tile.recipe)
        ]
        if taken and not replaces:
            raise AtlasError(
                f"the atlas has a tile {taken[0]} already; --replace replaces it, --id gives the"
                " new one another id"
            )
        return manifest.with_tiles(manifest.by_id | added, now)

    return _store_and_commit(store_at(where), new, add, grace_s, creates)


def replace_tile(where: str, new: NewTile, before: Tile) -> Manifest | None:
    """Replace a tile by a new version of its map in the same world, and return the manifest. Its
    joins are kept in their current state.

    If the tile was removed or changed since `before`, nothing is changed and None is returned.
    Raises AtlasError and MapError as `add_tiles`.
    """

    def replace_map(manifest: Manifest, added: dict[str, Tile], now: float) -> Manifest:
        is_same = _is_same_map(manifest, before)
        if not is_same or manifest.by_id[before.tile_id].world != before.world:
            raise _TileChangedError
        joins = [join for join in manifest.joins if before.tile_id in join.pair]
        return manifest.with_tiles(manifest.by_id | added, now, joins)

    with suppress(_TileChangedError):
        return _store_and_commit(store_at(where), [new], replace_map)
    return None


def _store_and_commit(
    store: Store,
    new: Sequence[NewTile],
    change: Callable[[Manifest, dict[str, Tile], float], Manifest],
    grace_s: float = GRACE_S,
    creates: bool = False,
) -> Manifest:
    """Store the files of new tiles and commit the manifest that `change` makes of them, by their
    id. `change` is called before the files are stored, too, so that its errors come early."""
    change(read_manifest(store, creates)[1], {}, time.time())
    with removing_new_files_on_failure(store) as put:
        added = {tile.tile_id: store_tile(tile, put) for tile in new}
        after = _commit_change(
            store, lambda manifest, now: change(manifest, added, now), grace_s, creates
        )
    # another writer may have removed files as unreferenced before the commit
    names = set(store.ages(TILES))
    for tile in new:
        if not {stored.name for stored in added[tile.tile_id].files} <= names:
            store_tile(tile, store.put)
    return after


def remove_tiles(where: str, tile_ids: Sequence[str]) -> Manifest:
    """Remove tiles and return the new manifest.

    Raises:
        AtlasError: there is no atlas, it has no such tile, or it cannot be written.
    """
    store = store_at(where)

    def without(manifest: Manifest, now: float) -> Manifest:
        if missing := [tile_id for tile_id in tile_ids if tile_id not in manifest.by_id]:
            raise AtlasError(f"the atlas {where} has no tile {missing[0][:80]!r}")
        left = {key: tile for key, tile in manifest.by_id.items() if key not in tile_ids}
        return manifest.with_tiles(left, now)

    return _commit_change(store, without)


def add_joins(where: str, joins: Sequence[Join], between: Mapping[str, Tile]) -> Manifest:
    """Add joins and return the new manifest. `between` holds the tiles that the joins were computed
    from. Joins of tiles that were removed or changed since are dropped. Raises AtlasError if there
    is no atlas, or it cannot be written."""

    def with_joins(manifest: Manifest, now: float) -> Manifest:
        there = {name for name in between if _is_same_map(manifest, between[name])}
        kept = [join for join in joins if there.issuperset(join.pair)]
        return manifest.with_tiles(manifest.by_id, now, kept)

    return _commit_change(store_at(where), with_joins)


def _is_same_map(manifest: Manifest, tile: Tile) -> bool:
    there = manifest.by_id.get(tile.tile_id)
    return there is not None and there.map.sha256 == tile.map.sha256


@contextmanager
def removing_new_files_on_failure(store: Store) -> Iterator[PutFile]:
    """Yield `store.put`. If the body fails, the files that it has added are removed, unless another
    writer's manifest has them."""
    before, new = store.ages(TILES), list[str]()

    def put(name: str, path: Path) -> None:
        new.extend([] if name in before else [name])
        store.put(name, path)

    try:
        yield put
    except BaseException:
        with suppress(AtlasError, OSError):
            for name in set(new).difference(read_manifest(store, creates=True)[1].files):
                store.remove(name)
        raise


def store_tile(new: NewTile, put: PutFile) -> Tile:
    """Store the files of a map with `put` and return its manifest entry.

    Raises:
        MapError, AtlasError: the map cannot be read or is empty, or the store cannot be written.
    """
    scratch = temporary_file(Path(tempfile.gettempdir()) / "topoloc-tile.places")
    with TopoMetricMap.load(new.path) as topomap, scratch as path:
        if len(topomap.summaries) == 0:
            raise EmptyMapError(f"map {new.path} has no nodes")
        topomap.require_scale("an atlas")
        vectors = compute_global_descriptors(topomap)
        versions = {kind: one.version for kind in vectors if (one := shared_vocabulary(kind))}
        save_global_descriptors(path, vectors)
        places = structs.asdict(_store_file(put, f"{new.tile_id}.places", path))
        newest, *older = [new.path, *find_kept_files(new.path)]
        stored = _store_file(put, f"{new.tile_id}.topo", newest)
        previous = [*(_store_file(put, f"{new.tile_id}.topo", one) for one in older), *new.older]
        previous = select_kept(previous, [one.num_bytes for one in previous])
        return Tile(
            new.tile_id,
            map=stored,
            places=PlacesFile(**places, vocabularies=versions),
            world=new.world,
            atlas_from_world=None,
            recipe=new.recipe,
            previous=tuple(previous),
            **map_facts(topomap),
        )


def _store_file(put: PutFile, name: str, path: Path) -> StoredFile:
    """Store a file under this name and a digest of its contents."""
    sha256 = sha256_of(path)
    stem, _, suffix = name.rpartition(".")
    stored = StoredFile(f"{TILES}/{stem}-{sha256[:12]}.{suffix}", sha256, path.stat().st_size)
    put(stored.name, path)
    return stored


class _TileChangedError(Exception):
    """Signal that another writer changed the tile first."""


def _commit_change(
    store: Store, change: ManifestEdit, grace_s: float = GRACE_S, creates: bool = False
) -> Manifest:
    """Read, change and commit the manifest until no other writer interferes.

    Unreferenced files older than `grace_s` are removed afterwards.
    """
    for _ in range(_MAX_TRIES):
        before, manifest = read_manifest(store, creates)
        now, ages = time.time(), store.ages(TILES)
        after = change(manifest, now)
        retired = {
            name: when
            for name, when in after.retired.items()
            if name in ages and min(now - when, ages[name]) <= grace_s
        }
        after = replace(after, retired=retired)
        if store.commit(before, after.to_bytes()):
            known = after.files | retired.keys()
            for name, age in store.ages(TILES).items():
                if name not in known and age > grace_s:
                    store.remove(name)
            return after
    raise AtlasError(f"{store.where}: other writers came in between {_MAX_TRIES} times")


def check_same_maps(source: str, known: Mapping[str, Tile], added: Mapping[str, Tile]) -> None:
    """Check that tiles with one id hold the same map. Raises AtlasError."""
    for tile_id in known.keys() & added.keys():
        if known[tile_id].map.sha256 != added[tile_id].map.sha256:
            raise AtlasError(
                f"{source} has a tile {tile_id} too, of another map; `topoloc atlas add --id` gives"
                " a map another id"
            )


def with_unique_worlds(known: Mapping[str, Tile], added: Mapping[str, Tile]) -> dict[str, Tile]:
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
    return {
        tile_id: structs.replace(tile, world=names[tile.world]) for tile_id, tile in added.items()
    }


def find_other_facts(tile: Tile, path: Path) -> list[str]:
    """Return the names of those facts of a tile that its map at `path` contradicts. Raises
    MapError."""
    with TopoMetricMap.load(path) as topomap:
        facts = map_facts(topomap)
    if facts["georeference"] is None:
        facts["geo_box"] = tile.geo_box  # it may follow from other tiles
    entry, expected = tile.to_json(), structs.replace(tile, **facts).to_json()
    boxes = [np.array(one.pop("geo_box") or [], np.float64) for one in (entry, expected)]
    # the last digits of trigonometric functions depend on the machine
    is_same_box = boxes[0].shape == boxes[1].shape and np.allclose(*boxes, rtol=0.0, atol=1e-9)
    other = [key for key in expected if entry[key] != expected[key]]
    return other if is_same_box else [*other, "geo_box"]


def map_facts(topomap: TopoMetricMap) -> dict[str, Any]:
    """Return the entries of a tile that follow from its map."""
    centres = np.array([summary.world_from_cam.translation for summary in topomap.summaries])
    known = topomap.georeference
    return {
        "map_id": topomap.id,
        "map_version": topomap.version,
        "kinds": tuple(topomap.kinds),
        "num_nodes": len(topomap.summaries),
        "sessions": tuple(sorted({summary.recording for summary in topomap.summaries})),
        "focal_px": topomap.max_focal_length_px(),
        "box_world": np.array([centres.min(axis=0), centres.max(axis=0)]),
        "georeference": known,
        "geo_box": None if known is None else geo_box([*map(known.geopoint, centres)]),
    }
