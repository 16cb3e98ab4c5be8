"""Open a map file or an atlas. Both are places of tiles, with the same methods. Group the tiles of
an atlas by common world."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.manifest import Manifest, Tile
from topoloc.atlas.store import find_store, read_manifest
from topoloc.errors import AtlasError, MapError, ObjectStoreError
from topoloc.geometry.geodesy import Georeference
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import OneLine
from topoloc.mapping.edit import read_history
from topoloc.mapping.topomap import TopoMetricMap


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
    store = find_store(where)
    return SingleMap(where) if store is None else Atlas(store, read_manifest(store)[1])
