"""Hold the contents of `atlas.json`: the tiles and their files. Every value is checked when read.

Tiles have ids that never change. File names are derived from their contents, so a replaced tile has
another file. A reader of an older manifest can continue with the files that it lists. `serial`
grows by one with each write.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from msgspec import Meta, Struct, to_builtins

from topoloc.atlas.joins import ID, Join, JoinJson, JointPose, JointPoseJson, TileId
from topoloc.atlas.joint_worlds import place_tiles
from topoloc.errors import AtlasError, GeoreferenceError, TrajectoryError
from topoloc.geometry.geodesy import GeoPoint, Georeference, GeoreferenceJson
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import Count, Finite, Matrix34, Positive, decode_json

FORMAT, FORMAT_VERSION = "topoloc-atlas", 1
TILES = "tiles"
FileName = Annotated[str, Meta(pattern=rf"^{TILES}/[A-Za-z0-9][A-Za-z0-9_.-]{{0,199}}\Z")]
Sha256 = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]
_Point = tuple[Finite, Finite, Finite]


class StoredFile(Struct, frozen=True, rename={"name": "file", "num_bytes": "bytes"}):
    """Describe a file of the atlas: its relative name, SHA-256 and size in bytes."""

    name: FileName
    sha256: Sha256
    num_bytes: Count


@dataclass(frozen=True, eq=False)
class Tile:
    """Describe a map of the atlas.

    Attributes:
        places: file of the global descriptors (`global_descriptors.py`).
        vocabularies: versions of their vocabularies, by feature type.
        focal_px: focal length (pixels) of the map's finest camera.
        box_world: minimum and maximum coordinates of the nodes' cameras in the map's own world,
            metres.
        world: name of the map's world. Tiles of one world share coordinates. The default is the
            tile's id.
        georeference: georeference of the map, None if it has none.
        geo_box: minimum latitude and longitude, then the maximum ones, degrees. None if unknown.
        joint: pose of the world in its joint world (`joins.py`), None if there is none.
        atlas_from_world: transform from the map's world to the atlas world. It may come from other
            tiles. None if unknown.
        recipe: digest of the recording and settings, if the map was built for this atlas.
        previous: map files before the last edits, the newest first, to undo them.
    """

    tile_id: str
    map: StoredFile
    places: StoredFile
    vocabularies: Mapping[str, str]
    map_id: str
    map_version: int
    kinds: tuple[str, ...]
    num_nodes: int
    sessions: tuple[str, ...]
    focal_px: float
    box_world: Float[np.ndarray, "2 3"]
    world: str
    georeference: Georeference | None = None
    geo_box: tuple[float, float, float, float] | None = None
    atlas_from_world: Rigid3 | None = None
    recipe: str | None = None
    joint: JointPose | None = None
    previous: tuple[StoredFile, ...] = ()

    @property
    def files(self) -> tuple[StoredFile, ...]:
        """Return all files of the tile."""
        return (self.map, self.places, *self.previous)

    @property
    def in_joint_world(self) -> JointPose:
        """Return the pose of the tile's world in its joint world. Without joins it is the
        identity."""
        return self.joint or JointPose(self.world, Rigid3.identity())

    def from_world_of(self, other: Tile) -> Rigid3 | None:
        """Return the transform from the world of another tile's map into this one's, None if
        unknown."""
        if self.world == other.world:
            return Rigid3.identity()
        here, there = self.in_joint_world, other.in_joint_world
        if here.joint == there.joint:
            return here.joint_from_world.inverse() @ there.joint_from_world
        if self.atlas_from_world is None or other.atlas_from_world is None:
            return None
        return self.atlas_from_world.inverse() @ other.atlas_from_world

    def to_json(self) -> dict[str, Any]:
        """Return the tile as a JSON object."""
        known = self.georeference
        made_of: dict[str, Any] = {} if self.recipe is None else {"recipe": self.recipe}
        if self.joint is not None:
            made_of["joint"] = self.joint.to_json()
        if self.previous:
            made_of["previous"] = to_builtins(self.previous)
        return made_of | {
            "id": self.tile_id,
            "map": to_builtins(self.map),
            "places": to_builtins(self.places) | {"vocabularies": dict(self.vocabularies)},
            "map_id": self.map_id,
            "map_version": self.map_version,
            "kinds": list(self.kinds),
            "num_nodes": self.num_nodes,
            "sessions": list(self.sessions),
            "focal_px": self.focal_px,
            "world": self.world,
            "box_world": self.box_world.tolist(),
            "georeference": None if known is None else known.to_json(),
            "geo_box": None if self.geo_box is None else list(self.geo_box),
            "atlas_from_world": (
                None
                if self.atlas_from_world is None
                else self.atlas_from_world.matrix()[:3].tolist()
            ),
        }


@dataclass(frozen=True, eq=False)
class Manifest:
    """Hold all tiles, sorted by id.

    `origin` is the point on earth of the atlas world (east, north, up), None if no tile is
    georeferenced. `retired` maps files of earlier manifests to the time at which they were dropped
    (Unix seconds). `joins` holds the relative poses of tiles, including those that contradict
    others.
    """

    serial: int = 0
    tiles: tuple[Tile, ...] = ()
    origin: GeoPoint | None = None
    retired: Mapping[str, float] = field(default_factory=dict)
    joins: tuple[Join, ...] = ()

    @cached_property
    def by_id(self) -> dict[str, Tile]:
        """Return the tiles by id."""
        return {tile.tile_id: tile for tile in self.tiles}

    @cached_property
    def geo_boxes(self) -> Float[np.ndarray, "t 4"]:
        """Return the `geo_box` of each tile, NaN if it has none."""
        unknown = (math.nan,) * 4
        return np.array([tile.geo_box or unknown for tile in self.tiles], np.float64).reshape(-1, 4)

    @cached_property
    def world_boxes(self) -> Float[np.ndarray, "t 2 3"]:
        """Return the `box_world` of each tile."""
        return np.array([tile.box_world for tile in self.tiles], np.float64).reshape(-1, 2, 3)

    def georeference_of(self, tile: Tile) -> Georeference | None:
        """Return the georeference of a tile: its map's own, or the one that follows from other
        tiles."""
        if tile.georeference is not None or tile.atlas_from_world is None or self.origin is None:
            return tile.georeference
        return Georeference(self.origin, tile.atlas_from_world, "joined")

    @property
    def files(self) -> set[str]:
        """Return the names of all files of the tiles."""
        return {stored.name for tile in self.tiles for stored in tile.files}

    def with_tiles(
        self, tiles: Mapping[str, Tile], now: float, joins: Sequence[Join] = ()
    ) -> Manifest:
        """Return the next manifest, with these tiles.

        Files that it does not list any more are retired at `now`.

        Args:
            joins: further joins between these tiles. Existing joins stay, unless a tile was removed
                or its map changed.
        """
        origin = self.origin
        if origin is None:
            origin = next(
                (
                    tile.georeference.origin
                    for _, tile in sorted(tiles.items())
                    if tile.georeference is not None
                ),
                None,
            )
        placed, adjusted_joins = place_tiles(tiles, self._select_joins(tiles, joins), origin)
        after = Manifest(self.serial + 1, placed, origin, {}, adjusted_joins)
        retired = dict.fromkeys(self.files, now) | dict(self.retired)
        return replace(
            after,
            retired={
                name: when for name, when in sorted(retired.items()) if name not in after.files
            },
        )

    def _select_joins(self, tiles: Mapping[str, Tile], further: Sequence[Join]) -> list[Join]:
        """Return the joins between these tiles. Of two joins of the same pair the last one
        counts."""
        same = {
            name
            for name, tile in tiles.items()
            if name in self.by_id and self.by_id[name].map.sha256 == tile.map.sha256
        }
        known = {join.pair: join for join in self.joins if same.issuperset(join.pair)}
        known |= {join.pair: join for join in further if tiles.keys() >= set(join.pair)}
        return [
            join for join in known.values() if tiles[join.first].world != tiles[join.second].world
        ]

    def to_bytes(self) -> bytes:
        """Return the contents of `atlas.json`."""
        origin = self.origin
        data = {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "serial": self.serial,
            "origin": None if origin is None else asdict(origin),
            "tiles": [tile.to_json() for tile in self.tiles],
            "retired": dict(self.retired),
            **({"joins": [join.to_json() for join in self.joins]} if self.joins else {}),
        }
        return (json.dumps(data, indent=1) + "\n").encode("utf-8")

    @staticmethod
    def from_bytes(data: bytes, where: str) -> Manifest:
        """Parse the output of `to_bytes`.

        Raises:
            AtlasError: the bytes are not a valid manifest. The message contains `where`.
        """
        fault = f"{where} is no manifest of an atlas, or a damaged one"
        whole = decode_json(data, dict[str, Any], AtlasError, fault)
        written = decode_json(whole, _Header, AtlasError, fault).version
        if written != FORMAT_VERSION:
            raise AtlasError(
                f"{fault}: version {written} of the format; this topoloc reads version"
                f" {FORMAT_VERSION}"
            )
        try:
            return decode_json(whole, _ManifestJson, AtlasError, fault).manifest()
        except (ValueError, GeoreferenceError, TrajectoryError) as error:
            raise AtlasError(f"{fault}: {error}") from None


def check_tile_id(tile_id: str) -> None:
    """Check a tile id.

    Raises:
        AtlasError: the id is invalid.
    """
    if not re.match(ID, tile_id):
        raise AtlasError(
            f"no tile can be called {tile_id[:80]!r}: at most 100 letters, digits, `_`, `-` and"
            " `.`, a letter or digit first"
        )


class _PlacesJson(StoredFile, frozen=True):
    """Hold the JSON of the file of the global descriptors."""

    vocabularies: dict[str, str]


class _TileJson(Struct, frozen=True):
    """Hold the JSON of a `Tile`."""

    id: TileId
    map: StoredFile
    places: _PlacesJson
    map_id: Annotated[str, Meta(pattern=r"^[0-9a-f]{16}\Z")]
    map_version: Count
    kinds: tuple[str, ...]
    num_nodes: Count
    sessions: tuple[str, ...]
    focal_px: Positive
    world: TileId
    box_world: tuple[_Point, _Point]
    georeference: GeoreferenceJson | None
    geo_box: tuple[Finite, Finite, Finite, Finite] | None
    atlas_from_world: Matrix34 | None
    recipe: Sha256 | None = None
    joint: JointPoseJson | None = None
    previous: tuple[StoredFile, ...] = ()

    def tile(self) -> Tile:
        """Return the tile. Raises ValueError, GeoreferenceError or TrajectoryError."""
        places, pose = self.places, self.atlas_from_world
        return Tile(
            tile_id=self.id,
            map=self.map,
            places=StoredFile(places.name, places.sha256, places.num_bytes),
            vocabularies=places.vocabularies,
            map_id=self.map_id,
            map_version=self.map_version,
            kinds=self.kinds,
            num_nodes=self.num_nodes,
            sessions=self.sessions,
            focal_px=self.focal_px,
            box_world=np.array(self.box_world),
            world=self.world,
            georeference=None if self.georeference is None else self.georeference.georeference(),
            geo_box=self.geo_box,
            atlas_from_world=None if pose is None else Rigid3.from_matrix(pose),
            recipe=self.recipe,
            joint=None if self.joint is None else self.joint.pose(),
            previous=self.previous,
        )


class _Header(Struct, frozen=True):
    """Hold the format of a manifest, which is checked before its other keys."""

    format: Literal["topoloc-atlas"]
    version: int


class _ManifestJson(Struct, frozen=True):
    """Hold the JSON of a `Manifest`."""

    serial: Count
    origin: GeoPoint | None
    tiles: Annotated[list[_TileJson], Meta(max_length=1_000_000)]
    retired: dict[FileName, Finite]
    joins: tuple[JoinJson, ...] = ()

    def manifest(self) -> Manifest:
        """Return the manifest. Raises ValueError, GeoreferenceError or TrajectoryError."""
        tiles = sorted((row.tile() for row in self.tiles), key=lambda tile: tile.tile_id)
        if len({tile.tile_id for tile in tiles}) < len(tiles):
            raise ValueError("tiles: two of one id")
        joins = tuple(row.join() for row in self.joins)
        _check_joins(joins, {tile.tile_id for tile in tiles})
        return Manifest(self.serial, tuple(tiles), self.origin, self.retired, joins)


def _check_joins(joins: Sequence[Join], known: set[str]) -> None:
    for join in joins:
        if not known.issuperset(join.pair):
            raise ValueError(f"a join of {join.first} and {join.second}, which are not both tiles")
        if join.first >= join.second:
            raise ValueError(
                f"a join of {join.first} and {join.second}, which are not two in their order"
            )
    if len({join.pair for join in joins}) < len(joins):
        raise ValueError("two joins of the same tiles")
