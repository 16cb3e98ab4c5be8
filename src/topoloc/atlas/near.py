"""Where a picture was taken, as far as somebody knows: tiles that are out of reach need not be asked."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from topoloc.atlas.manifest import Manifest, Tile
from topoloc.errors import AtlasError, GeoreferenceError
from topoloc.geometry.geodesy import GeoPoint
from topoloc.geometry.rigid import Rigid3


@dataclass(frozen=True)
class NearPlace:
    """Within `radius_m` metres of a latitude and longitude (degrees). Tiles that do not know where on earth they lie are never out of
    reach.

    Raises:
        AtlasError: no such place, or no radius.
    """

    lat: float
    lon: float
    radius_m: float

    def __post_init__(self) -> None:
        try:
            GeoPoint(self.lat, self.lon, 0.0)
        except GeoreferenceError as error:
            raise AtlasError(str(error)) from None
        _check_radius(self.radius_m)

    @staticmethod
    def parse(text: str) -> NearPlace:
        """Of `LAT,LON,RADIUS_M`. Raises AtlasError."""
        try:
            lat, lon, radius_m = (float(part) for part in text.split(","))
        except ValueError:
            raise AtlasError(f"{text[:80]!r} is no latitude, longitude (degrees) and radius (metres), such as 50.8775,4.7043,200") from None
        return NearPlace(lat, lon, radius_m)

    def __str__(self) -> str:
        return f"within {self.radius_m:g} m of {self.lat:g}, {self.lon:g}"


@dataclass(frozen=True, eq=False)
class NearPose:
    """A camera within `radius_m` metres of this pose in the world of this name. Tiles of worlds that lie in no known way to it are out of
    reach.

    Raises:
        AtlasError: no radius.
    """

    world: str
    world_from_cam: Rigid3
    radius_m: float

    def __post_init__(self) -> None:
        _check_radius(self.radius_m)

    def __str__(self) -> str:
        x, y, z = self.world_from_cam.translation
        return f"within {self.radius_m:g} m of {x:g}, {y:g}, {z:g} in the world {self.world}"


Near = NearPlace | NearPose


def tiles_in_reach(manifest: Manifest, near: Near | None, placed_only: bool = False) -> dict[str, Rigid3 | None]:
    """The ids of the tiles whose nodes' box is in reach, each with the pose that is near in the tile's own world, where one is given.

    Args:
        placed_only: without tiles that do not know where on earth they lie.

    Raises:
        AtlasError: no tile is of the world that is named.
    """
    tiles = [tile for tile in manifest.tiles if tile.geo_box is not None or not placed_only]
    if near is None:
        return dict.fromkeys((tile.tile_id for tile in tiles), None)
    if isinstance(near, NearPlace):
        return dict.fromkeys((tile.tile_id for tile in tiles if metres_to_box(near, tile) <= near.radius_m), None)
    return _near_pose(manifest, near, tiles)


def metres_to_box(near: NearPlace, tile: Tile) -> float:
    """From a place to the tile's box of latitudes and longitudes, along the ground; 0 of a tile that has none."""
    if tile.geo_box is None:
        return 0.0
    least_lat, least_lon, most_lat, most_lon = tile.geo_box
    lat = min(max(near.lat, least_lat), most_lat)
    beside = [near.lon + turn for turn in (-360.0, 0.0, 360.0)]  # the same meridian, on either side of 180 degrees
    lon = min((min(max(one, least_lon), most_lon) - one for one in beside), key=abs)
    up = math.sin(math.radians(lat - near.lat) / 2.0)
    across = math.sin(math.radians(lon) / 2.0)
    along = up * up + math.cos(math.radians(lat)) * math.cos(math.radians(near.lat)) * across * across
    return 2.0 * _EARTH_RADIUS_M * math.asin(min(1.0, math.sqrt(along)))


_EARTH_RADIUS_M = 6_371_000.0


def _near_pose(manifest: Manifest, near: NearPose, tiles: list[Tile]) -> dict[str, Rigid3 | None]:
    of_world = [tile for tile in manifest.tiles if tile.world == near.world]
    if not of_world:
        worlds = ", ".join(sorted({tile.world for tile in manifest.tiles})[:8])
        raise AtlasError(f"the atlas has no world {near.world[:80]!r} (it has: {worlds})")
    atlas_from_world = next((tile.atlas_from_world for tile in of_world if tile.atlas_from_world is not None), None)
    reached = dict[str, Rigid3 | None]()
    for tile in tiles:
        if tile.world == near.world:
            pose = near.world_from_cam
        elif atlas_from_world is not None and tile.atlas_from_world is not None:
            pose = tile.atlas_from_world.inverse() @ atlas_from_world @ near.world_from_cam
        else:
            continue
        nearest = np.clip(pose.translation, tile.box_world[0], tile.box_world[1])
        if np.linalg.norm(nearest - pose.translation) <= near.radius_m:
            reached[tile.tile_id] = pose
    return reached


def _check_radius(radius_m: float) -> None:
    if not 0.0 < radius_m < math.inf:
        raise AtlasError(f"a radius of {radius_m:g} m: it must be above 0")
