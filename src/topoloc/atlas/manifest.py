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
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.atlas.joins import Join, JointPose
from topoloc.atlas.joint_worlds import place_tiles
from topoloc.atlas.manifest_values import ID, count, matching, number, of
from topoloc.errors import AtlasError, GeoreferenceError, TrajectoryError
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3

FORMAT, FORMAT_VERSION = "topoloc-atlas", 1
TILES = "tiles"
MAX_TILES = 1_000_000
_FILE = re.compile(rf"{TILES}/[A-Za-z0-9][A-Za-z0-9_.-]{{0,199}}")
_SHA256, _MAP_ID = re.compile(r"[0-9a-f]{64}"), re.compile(r"[0-9a-f]{16}")


@dataclass(frozen=True)
class StoredFile:
    """Describe a file of the atlas: its relative name, SHA-256 and size in bytes."""

    name: str
    sha256: str
    num_bytes: int

    def to_json(self) -> dict[str, Any]:
        """Return the file as a JSON object."""
        return {"file": self.name, "sha256": self.sha256, "bytes": self.num_bytes}


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
        undo: undo log of the map's last edits (`mapping/undo_log.py`), None if there is none.
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
    undo: StoredFile | None = None

    @property
    def files(self) -> tuple[StoredFile, ...]:
        """Return all files of the tile."""
        return (self.map, self.places) if self.undo is None else (self.map, self.places, self.undo)

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
        if self.undo is not None:
            made_of["undo"] = self.undo.to_json()
        return made_of | {
            "id": self.tile_id,
            "map": self.map.to_json(),
            "places": self.places.to_json() | {"vocabularies": dict(self.vocabularies)},
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
            "origin": (
                None if origin is None else {"lat": origin.lat, "lon": origin.lon, "h": origin.h}
            ),
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
        try:
            return _parse_manifest(json.loads(data))
        except (
            ValueError,
            TypeError,
            KeyError,
            RecursionError,
            OverflowError,
            GeoreferenceError,
            TrajectoryError,
        ) as error:
            what = (
                f"{error.args[0]!r} is missing"
                if isinstance(error, KeyError)
                else " ".join(str(error).split())[:200]
            )
            raise AtlasError(
                f"{where} is no manifest of an atlas, or a damaged one: {what}"
            ) from None


def check_tile_id(tile_id: str) -> None:
    """Check a tile id.

    Raises:
        AtlasError: the id is invalid.
    """
    if not ID.fullmatch(tile_id):
        raise AtlasError(
            f"no tile can be called {tile_id[:80]!r}: at most 100 letters, digits, `_`, `-` and"
            " `.`, a letter or digit first"
        )


def _parse_manifest(data: Any) -> Manifest:
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise ValueError(f"'format' is not {FORMAT!r}")
    if data.get("version") != FORMAT_VERSION:
        raise ValueError(
            f"version {str(data.get('version'))[:20]} of the format; this topoloc reads version"
            f" {FORMAT_VERSION}"
        )
    rows = of(list, data["tiles"], "tiles")
    tiles = [_parse_tile(of(dict, row, "a tile")) for row in rows[: MAX_TILES + 1]]
    if len(tiles) > MAX_TILES or len({tile.tile_id for tile in tiles}) < len(tiles):
        raise ValueError("too many tiles, or two of one id")
    origin, retired = data["origin"], of(dict, data["retired"], "retired")
    for name in retired:
        matching(_FILE, name, "a retired file")
    place = (
        None
        if origin is None
        else GeoPoint(*(number(origin[name], name) for name in ("lat", "lon", "h")))
    )
    ordered = tuple(sorted(tiles, key=lambda tile: tile.tile_id))
    joins = [
        Join.from_json(of(dict, row, "a join")) for row in of(list, data.get("joins", []), "joins")
    ]
    _check_joins(joins, {tile.tile_id for tile in tiles})
    given_up = {name: number(when, "retired") for name, when in retired.items()}
    return Manifest(count(data["serial"], "serial"), ordered, place, given_up, tuple(joins))


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


def _parse_tile(row: dict[str, Any]) -> Tile:
    box = np.array(row["box_world"], np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all():
        raise ValueError("box_world is no two points")
    geo_box, georeference, pose, recipe = (
        row["geo_box"],
        row["georeference"],
        row["atlas_from_world"],
        row.get("recipe"),
    )
    joint, undo = row.get("joint"), row.get("undo")
    focal = number(row["focal_px"], "focal_px")
    if focal <= 0.0:
        raise ValueError("focal_px is not above 0")
    vocabularies = of(dict, row["places"]["vocabularies"], "vocabularies")
    corners = (
        None
        if geo_box is None
        else [number(value, "geo_box") for value in of(list, geo_box, "geo_box")]
    )
    if corners is not None and len(corners) != 4:
        raise ValueError("geo_box is no four degrees")
    return Tile(
        tile_id=matching(ID, row["id"], "id"),
        map=_parse_file(row["map"]),
        places=_parse_file(row["places"]),
        vocabularies={
            kind: of(str, version, "vocabularies") for kind, version in vocabularies.items()
        },
        map_id=matching(_MAP_ID, row["map_id"], "map_id"),
        map_version=count(row["map_version"], "map_version"),
        kinds=tuple(of(str, kind, "kinds") for kind in of(list, row["kinds"], "kinds")),
        num_nodes=count(row["num_nodes"], "num_nodes"),
        sessions=tuple(of(str, name, "sessions") for name in of(list, row["sessions"], "sessions")),
        focal_px=focal,
        box_world=box,
        world=matching(ID, row["world"], "world"),
        georeference=None if georeference is None else Georeference.from_json(georeference),
        geo_box=None if corners is None else (corners[0], corners[1], corners[2], corners[3]),
        atlas_from_world=None if pose is None else Rigid3.from_matrix(np.array(pose, np.float64)),
        recipe=None if recipe is None else matching(_SHA256, recipe, "recipe"),
        joint=None if joint is None else JointPose.from_json(of(dict, joint, "joint")),
        undo=None if undo is None else _parse_file(of(dict, undo, "undo")),
    )


def _parse_file(row: Any) -> StoredFile:
    name, sha256 = matching(_FILE, row["file"], "file"), matching(_SHA256, row["sha256"], "sha256")
    return StoredFile(name, sha256, count(row["bytes"], "bytes"))
