"""Tiles that lie in one world, and where: those whose places to each other the atlas knows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.manifest import Manifest, Tile
from topoloc.errors import AtlasError, MapError, ObjectStoreError
from topoloc.geometry.geodesy import Georeference
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.topomap import TopoMetricMap


@dataclass(frozen=True, eq=False)
class PlacedTile:
    """A tile, and the way from its map's world into the one that it shares."""

    tile: Tile
    world_from_map: Rigid3


@dataclass(frozen=True, eq=False)
class SharedWorld:
    """Tiles in the order of their ids. The world is the atlas's own, east-north-up, of tiles that
    know where on earth they lie; else the joint world of joined ones, or what tiles of one world
    share. `georeference` is None where no place on earth is known."""

    tiles: tuple[PlacedTile, ...]
    georeference: Georeference | None

    @property
    def num_nodes(self) -> int:
        return sum(placed.tile.num_nodes for placed in self.tiles)

    def world_from_map_of(self, tile_id: str | None) -> Rigid3 | None:
        """None of a tile that lies in no such world, or in another one."""
        return next(
            (placed.world_from_map for placed in self.tiles if placed.tile.tile_id == tile_id), None
        )

    def open_tiles(
        self, atlas: Atlas, warn: Callable[[str], None]
    ) -> Iterator[tuple[PlacedTile, TopoMetricMap]]:
        """Tiles with their maps, each open for its turn. One that cannot be read is left out, and
        `warn` told of it.

        Raises:
            AtlasError: none can be read.
            ObjectStoreError: the store does not answer.
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


def group_shared_worlds(manifest: Manifest) -> list[SharedWorld]:
    """All tiles by the worlds that they share, the one of most nodes first."""
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


def world_of_tile(manifest: Manifest, tile: Tile) -> SharedWorld:
    """A tile alone, in the world of its map."""
    return SharedWorld((PlacedTile(tile, Rigid3.identity()),), manifest.georeference_of(tile))
