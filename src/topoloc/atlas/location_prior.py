"""Restrict the search in an atlas by an approximate position. Tiles out of reach are skipped."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from topoloc.atlas.manifest import Manifest
from topoloc.errors import AtlasError, GeoreferenceError
from topoloc.geometry.geodesy import GeoPoint
from topoloc.geometry.rigid import Rigid3


@dataclass(frozen=True)
class GeoPositionPrior:
    """Hold a position prior: within `radius_m` metres of a latitude and longitude (degrees).

    Tiles without a georeference are always in reach.

    Raises:
        AtlasError: the position or the radius is invalid.
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
    def parse(text: str) -> GeoPositionPrior:
        """Parse `LAT,LON,RADIUS_M`.

        Raises:
            AtlasError: the text is invalid.
        """
        try:
            lat, lon, radius_m = (float(part) for part in text.split(","))
        except ValueError:
            raise AtlasError(
                f"{text[:80]!r} is no latitude, longitude (degrees) and radius (metres), such as"
                " 50.8775,4.7043,200"
            ) from None
        return GeoPositionPrior(lat, lon, radius_m)

    def __str__(self) -> str:
        return f"within {self.radius_m:g} m of {self.lat:g}, {self.lon:g}"


@dataclass(frozen=True, eq=False)
class WorldPositionPrior:
    """Hold a pose prior: within `radius_m` metres of a pose in the named world.

    Tiles of worlds without a known transform to it are out of reach.

    Raises:
        AtlasError: the radius is invalid.
    """

    world: str
    world_from_cam: Rigid3
    radius_m: float

    def __post_init__(self) -> None:
        _check_radius(self.radius_m)

    def __str__(self) -> str:
        x, y, z = self.world_from_cam.translation
        return f"within {self.radius_m:g} m of {x:g}, {y:g}, {z:g} in the world {self.world}"


LocationPrior = GeoPositionPrior | WorldPositionPrior


def tiles_in_reach(
    manifest: Manifest, near: LocationPrior | None, georeferenced_only: bool = False
) -> dict[str, Rigid3 | None]:
    """Return the tiles in reach by id, with the prior pose in the tile's own world or None. A tile
    is in reach if the box of its nodes is. With `georeferenced_only`, tiles without a known
    position on earth are skipped.

    Raises AtlasError if no tile belongs to the prior's world.
    """
    is_placed = ~np.isnan(manifest.geo_boxes[:, 0])
    is_candidate = is_placed if georeferenced_only else np.ones_like(is_placed)
    if isinstance(near, WorldPositionPrior):
        return _tiles_near_pose(manifest, near, is_candidate)
    if near is not None:
        is_candidate = is_candidate & (
            distances_to_boxes(near, manifest.geo_boxes) <= near.radius_m
        )
    return dict.fromkeys(manifest.tiles[number].tile_id for number in np.flatnonzero(is_candidate))


def distances_to_boxes(
    near: GeoPositionPrior, boxes: Float[np.ndarray, "t 4"]
) -> Float[np.ndarray, " t"]:
    """Return the ground distances (metres) from a position to boxes of latitude and longitude.

    Each box holds the minimum latitude and longitude, then the maximum ones, in degrees. The
    distance to a NaN box is 0.
    """
    lat = np.clip(near.lat, boxes[:, 0], boxes[:, 2])
    # boxes on either side of 180 degrees
    turned = near.lon + np.array([[-360.0], [0.0], [360.0]])
    lon = np.abs(np.clip(turned, boxes[:, 1], boxes[:, 3]) - turned).min(axis=0)
    up, across = np.sin(np.radians(lat - near.lat) / 2.0), np.sin(np.radians(lon) / 2.0)
    along = up**2 + np.cos(np.radians(lat)) * math.cos(math.radians(near.lat)) * across**2
    return np.nan_to_num(2.0 * _EARTH_RADIUS_M * np.arcsin(np.minimum(1.0, np.sqrt(along))))


_EARTH_RADIUS_M = 6_371_000.0


def _tiles_near_pose(
    manifest: Manifest, near: WorldPositionPrior, is_candidate: Bool[np.ndarray, " t"]
) -> dict[str, Rigid3 | None]:
    of_world = np.array([tile.world == near.world for tile in manifest.tiles], bool)
    if not of_world.any():
        worlds = ", ".join(sorted({tile.world for tile in manifest.tiles})[:8])
        raise AtlasError(f"the atlas has no world {near.world[:80]!r} (it has: {worlds})")
    centre, boxes = near.world_from_cam.translation, manifest.world_boxes
    apart = np.linalg.norm(np.clip(centre, boxes[:, 0], boxes[:, 1]) - centre, axis=1)
    in_reach = np.flatnonzero(is_candidate & of_world & (apart <= near.radius_m))
    reached: dict[str, Rigid3 | None] = {
        manifest.tiles[number].tile_id: near.world_from_cam for number in in_reach
    }
    one = manifest.tiles[int(of_world.argmax())]
    for number in np.flatnonzero(is_candidate & ~of_world):
        tile = manifest.tiles[number]
        world_from_one = tile.from_world_of(one)
        if world_from_one is not None:
            pose = world_from_one @ near.world_from_cam
            nearest = np.clip(pose.translation, *tile.box_world)
            if np.linalg.norm(nearest - pose.translation) <= near.radius_m:
                reached[tile.tile_id] = pose
    return reached


def _check_radius(radius_m: float) -> None:
    if not 0.0 < radius_m < math.inf:
        raise AtlasError(f"a radius of {radius_m:g} m: it must be above 0")
