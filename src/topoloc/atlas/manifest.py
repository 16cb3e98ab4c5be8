"""Hold the contents of `atlas.json`: the tiles and their files. Every value is checked when read.

Tiles have ids that never change. File names are derived from their contents, so a replaced tile has
another file. A reader of an older manifest can continue with the files that it lists. `serial`
grows by one with each write.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from msgspec import Meta, Struct

from topoloc.atlas.joint_worlds import ID, Join, JointPose, TileId, check_join, place_tiles
from topoloc.errors import AtlasError
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import Count, Finite, OneLine, Positive, decode_json, encode_json

FORMAT, FORMAT_VERSION = "topoloc-atlas", 1
TILES = "tiles"
FileName = Annotated[str, Meta(pattern=rf"^{TILES}/[A-Za-z0-9][A-Za-z0-9_.-]{{0,199}}\Z")]
Sha256 = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]


class StoredFile(Struct, frozen=True, rename={"name": "file", "num_bytes": "bytes"}):
    """Describe a file of the atlas: its relative name, SHA-256 and size in bytes."""

    name: FileName
    sha256: Sha256
    num_bytes: Count


class PlacesFile(StoredFile, frozen=True):
    """Describe a file of global descriptors (`index.py`), with the versions of their
    vocabularies by feature type."""

    vocabularies: dict[str, str]


class Tile(OneLine, Struct, frozen=True, eq=False, omit_defaults=True, rename={"tile_id": "id"}):
    """Describe a map of the atlas.

    Attributes:
        focal_px: focal length (pixels) of the map's finest camera.
        box_world: minimum and maximum coordinates of the nodes' cameras in the map's own world,
            metres.
        world: name of the map's world. Tiles of one world share coordinates. The default is the
            tile's id.
        georeference: georeference of the map, None if it has none.
        geo_box: minimum latitude and longitude, then the maximum ones, degrees. None if unknown.
        joint: pose of the world in its joint world (`joint_worlds.py`), None if there is none.
        atlas_from_world: transform from the map's world to the atlas world. It may come from other
            tiles. None if unknown.
        recipe: digest of the recording and settings, if the map was built for this atlas.
        previous: map files before the last edits, the newest first, to undo them.
    """

    tile_id: TileId
    map: StoredFile
    places: PlacesFile
    map_id: Annotated[str, Meta(pattern=r"^[0-9a-f]{16}\Z")]
    map_version: Count
    kinds: tuple[str, ...]
    num_nodes: Count
    sessions: tuple[str, ...]
    focal_px: Positive
    box_world: Float[np.ndarray, "2 3"]
    world: TileId
    georeference: Georeference | None
    geo_box: tuple[Finite, Finite, Finite, Finite] | None
    atlas_from_world: Rigid3 | None
    recipe: Sha256 | None = None
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
        return encode_json(self)


@dataclass(frozen=True, eq=False)
class Manifest:
    """Hold all tiles, sorted by id.

    `origin` is the point on earth of the atlas world (east, north, up), None if no tile is
    georeferenced. `retired` maps files of earlier manifests to the time at which they were dropped
    (Unix seconds). `joins` holds the relative poses of tiles, including those that contradict
    others.

    Raises:
        ValueError: two tiles have one id, or joins are invalid.
    """

    serial: Count = 0
    tiles: tuple[Tile, ...] = ()
    origin: GeoPoint | None = None
    retired: Mapping[FileName, Finite] = field(default_factory=dict)
    joins: tuple[Join, ...] = ()

    def __post_init__(self) -> None:
        if len({tile.tile_id for tile in self.tiles}) < len(self.tiles):
            raise ValueError("tiles: two of one id")
        for tile in self.tiles:
            if tile.joint is not None:
                check_join(tile.joint.joint_from_world, tile.joint.covariance, is_definite=False)
        for join in self.joins:
            if join.first >= join.second or not {*join.pair} <= self.by_id.keys():
                raise ValueError(
                    f"a join of {join.first} and {join.second}, not two tiles in order"
                )
            check_join(join.first_from_second, join.covariance, is_definite=True)
        if len({join.pair for join in self.joins}) < len(self.joins):
            raise ValueError("two joins of the same tiles")

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
        """Return the next manifest, with these tiles and further joins between them. Existing joins
        stay, unless a tile was removed or its map changed. Files that it does not list any more are
        retired at `now`."""
        known = (tile.georeference for _, tile in sorted(tiles.items()))
        origin = self.origin or next((one.origin for one in known if one is not None), None)
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
        data = {"format": FORMAT, "version": FORMAT_VERSION} | encode_json(self)
        if not self.joins:
            data.pop("joins", None)
        data["digest"] = _digest_of(data)
        return (json.dumps(data, indent=1) + "\n").encode("utf-8")

    @staticmethod
    def from_bytes(data: bytes, where: str) -> Manifest:
        """Parse the output of `to_bytes`. Manifests of earlier versions have no digest.

        Raises:
            AtlasError: the bytes are not a valid manifest. The message contains `where`.
        """
        fault = f"{where} is no manifest of an atlas, or a damaged one"
        whole = decode_json(data, dict[str, Any], AtlasError, fault)
        version = whole.get("version")
        if whole.get("format") == FORMAT and version != FORMAT_VERSION:
            raise AtlasError(
                f"{fault}: version {str(version)[:20]} of the format; this topoloc reads version"
                f" {FORMAT_VERSION}"
            )
        decode_json(whole, _Header, AtlasError, fault)
        read = decode_json(whole, Manifest, AtlasError, fault)
        if _digest_of(whole) != whole.get("digest", _digest_of(whole)):
            raise AtlasError(
                f"{fault}: its content was changed, its digest is another. Restore the file, or"
                " create the atlas again from its maps"
            )
        return replace(read, tiles=tuple(sorted(read.tiles, key=lambda tile: tile.tile_id)))


def _digest_of(data: Mapping[str, Any]) -> str:
    """Return the digest of a manifest without its entry `digest`."""
    content = {key: value for key, value in data.items() if key != "digest"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


class _Header(Struct, frozen=True):
    """Hold the format and the required keys of a manifest, which are checked first."""

    format: Literal["topoloc-atlas"]
    version: int
    serial: Any
    origin: Any
    tiles: Annotated[list[Any], Meta(max_length=1_000_000)]
    retired: Any


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
