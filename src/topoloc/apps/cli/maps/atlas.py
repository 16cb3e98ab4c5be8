"""topoloc atlas create | add | remove | join | info ATLAS [MAP|TILE ...]."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from topoloc.apps.cli.maps.tile_joining import join_overlapping_tiles
from topoloc.apps.cli.output import File, Flag, RayOption, UsageError, print_fields, write_json
from topoloc.apps.cli.settings_file import read_settings

Names = Annotated[
    tyro.conf.Positional[tuple[str, ...]],
    tyro.conf.arg(metavar="MAP|TILE ...", help_behavior_hint=""),
]


@dataclass(frozen=True)
class Command:
    """What `topoloc atlas` takes."""

    action: Annotated[
        tyro.conf.Positional[Literal["create", "add", "remove", "join", "info"]],
        tyro.conf.arg(metavar="ACTION"),
    ]
    """`create`: a new atlas of maps. `add`: more maps. `remove`: tiles by their ids. `join`: tiles
    that overlap get one world, as far as what they see is beyond doubt the same. `info`: what it
    holds."""
    atlas: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ATLAS")]
    """The atlas: a folder; or, with the extra `cluster`, a prefix of an object store, such as
    s3://bucket/campus."""
    names: Names = ()
    """Of `create` and `add`: map files, which are copied. Of `remove`: ids of tiles. Of `join`: ids
    of tiles that others are compared with (none: all with each other)."""
    id: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="NAME", help_behavior_hint="(default: the file's name without .topo)"
        ),
    ] = None
    """Of `create` and `add`, for one map: what the tile is called."""
    world: Annotated[
        str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: each its own)")
    ] = None
    """Of `create` and `add`: maps of one world, so that poses in one are poses in the other, too
    (maps of one recording split, or of recordings whose poses are in one world)."""
    replace: Flag = False
    """Of `add`: a tile of the same id is replaced by the new map."""
    join: Flag = False
    """Of `create` and `add`: then the new tiles are joined with those that they overlap with."""
    ray: RayOption = None
    """Of `join` and `--join`: a Ray cluster on which each pair of tiles is compared, as in `topoloc
    build`."""
    check: Flag = False
    """Of `info`: also compare every file with its checksum; exit status 1 where one is missing or
    another."""
    json: File = None
    """Write what the atlas holds afterwards as JSON to this file (- for standard output)."""
    config: File = None
    """Settings of the cluster of `join`: a TOML file, as `topoloc config atlas` prints it."""

    def run(self) -> int:
        self._check_usage()
        found, joined = [], None
        if self.action == "info":
            from topoloc import Atlas

            atlas = Atlas.open(self.atlas)
            manifest = atlas.manifest
            if self.check:
                found = [
                    f"tile {tile.tile_id}: {problem}"
                    for tile in manifest.tiles
                    if (problem := atlas.find_problem(tile.tile_id))
                ]
        else:
            settings = read_settings(self.config)
            manifest = None if self.action == "join" else self._write()
            if manifest is None or self.join:
                ids = self._new_ids() if self.join else self.names
                joined = join_overlapping_tiles(
                    self.atlas, ids, settings, self.json != "-", ray=self.ray
                )
                manifest, found = joined.manifest, joined.not_compared
        facts = describe(self.atlas, manifest) | ({"check": found or "ok"} if self.check else {})
        facts |= {} if joined is None else {"tried": joined.rows}
        if self.json != "-":
            print_atlas(facts)
        write_json(self.json, facts)
        for problem in found:
            print(f"error: {problem}", file=sys.stderr)
        return 1 if found else 0

    def _write(self) -> Any:
        from topoloc import Atlas

        if self.action == "remove":
            return Atlas.remove(self.atlas, self.names).manifest
        if self.action == "create":
            return Atlas.create(self.atlas, self.names, self.id, self.world).manifest
        return Atlas.add(self.atlas, self.names, self.id, self.world, self.replace).manifest

    def _new_ids(self) -> list[str]:
        """The ids of the tiles that `create` and `add` write."""
        return [self.id or Path(name).name.removesuffix(".topo") for name in self.names]

    def _check_usage(self) -> None:
        if self.action == "info" and self.names:
            raise UsageError("info takes an atlas alone")
        if self.action in ("add", "remove") and not self.names:
            raise UsageError(
                f"{self.action} takes an atlas and at least one"
                f" {'map' if self.action == 'add' else 'tile'}"
            )
        if self.id is not None and (self.action not in ("create", "add") or len(self.names) != 1):
            raise UsageError("--id is of one map that is added")
        if self.world is not None and self.action not in ("create", "add"):
            raise UsageError("--world is of maps that are added")
        if self.replace and self.action != "add":
            raise UsageError("--replace belongs to add")
        if self.join and self.action not in ("create", "add"):
            raise UsageError(
                "--join belongs to create and add; `topoloc atlas join` joins what is there"
            )
        if self.config is not None and self.action != "join" and not self.join:
            raise UsageError("--config sets the cluster on which tiles are joined")
        if self.ray is not None and self.action != "join" and not self.join:
            raise UsageError("--ray is of tiles that are joined")
        if self.check and self.action != "info":
            raise UsageError("--check belongs to info")


def describe(where: str, manifest: Any) -> dict[str, Any]:
    """The facts of an atlas: those of its tiles, and their sums."""
    tiles = [tile.to_json() for tile in manifest.tiles]
    origin = manifest.origin
    return {
        "path": where,
        "serial": manifest.serial,
        "num_tiles": len(tiles),
        "num_nodes": sum(tile.num_nodes for tile in manifest.tiles),
        "bytes": sum(stored.num_bytes for tile in manifest.tiles for stored in tile.files),
        "origin": None if origin is None else {"lat": origin.lat, "lon": origin.lon, "h": origin.h},
        "worlds": group_tiles_by_world(manifest),
        "joins": [_describe_join(join, manifest) for join in manifest.joins],
        "tiles": tiles,
    }


def group_tiles_by_world(manifest: Any) -> dict[str, list[str]]:
    """The ids of the tiles of each world, those that joins make one together."""
    worlds: dict[str, list[str]] = {}
    for tile in manifest.tiles:
        worlds.setdefault(tile.in_joint_world.joint, []).append(tile.tile_id)
    return worlds


def _describe_join(join: Any, manifest: Any) -> dict[str, Any]:
    """What the manifest says of it, and one sigma of where the second tile's middle lies in the
    first's world."""
    middle = manifest.by_id[join.second].box_world.mean(axis=0)
    metres, radians = join.sigmas_at(middle)
    return join.to_json() | {"sigma_m": metres, "sigma_deg": math.degrees(radians)}


def print_atlas(facts: dict[str, Any]) -> None:
    """For people: a line each tile."""
    width = max((len(tile["id"]) for tile in facts["tiles"]), default=0)
    print_fields(
        [
            ("atlas", f"{facts['path']}, serial {facts['serial']}"),
            (
                "tiles",
                f"{facts['num_tiles']}, {facts['num_nodes']} nodes, {facts['bytes'] / 1e6:.2f} MB",
            ),
            *(("", f"{tile['id']:<{width}}  {_format_tile(tile)}") for tile in facts["tiles"]),
            *(
                ("world", f"{name}: {', '.join(ids)}")
                for name, ids in facts["worlds"].items()
                if len(ids) > 1
            ),
            *(("join", _format_join(join)) for join in facts["joins"]),
            *(
                [
                    (
                        "check",
                        (
                            "ok"
                            if facts["check"] == "ok"
                            else f"{len(facts['check'])} tiles are damaged"
                        ),
                    )
                ]
                if "check" in facts
                else []
            ),
        ]
    )


def _format_join(join: dict[str, Any]) -> str:
    said = f"{join['first']} and {join['second']}: {join['num_agreeing']} pictures agree"
    if join["residual"] is None:
        return f"{said}, but other joins contradict them; not used"
    return f"{said}, {100 * join['sigma_m']:.1f} cm, {join['sigma_deg']:.2f} deg"


def _format_tile(tile: dict[str, Any]) -> str:
    least, most = tile["box_world"]
    extent = " x ".join(f"{high - low:.1f}" for low, high in zip(least, most, strict=True))
    box = tile["geo_box"]
    place = "" if box is None else f"  {box[0]:.6f} {box[1]:.6f} to {box[2]:.6f} {box[3]:.6f}"
    return (
        f"{tile['num_nodes']} nodes  {extent} m  {tile['map']['bytes'] / 1e6:.1f} MB "
        f" {', '.join(tile['kinds'])}{place}"
    )
