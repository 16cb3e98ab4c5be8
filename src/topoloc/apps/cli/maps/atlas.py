"""topoloc atlas create | add | remove | join | info ATLAS [MAP|TILE ...]."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from topoloc import Atlas, join_tiles
from topoloc.apps.cli.output import (
    File,
    Flag,
    RayOption,
    UsageError,
    option,
    print_fields,
    print_line,
    write_json,
)
from topoloc.apps.cli.settings_file import Settings, read_settings


@dataclass(frozen=True)
class Command:
    """Options of `topoloc atlas`."""

    action: Annotated[
        tyro.conf.Positional[Literal["create", "add", "remove", "join", "info"]],
        tyro.conf.arg(metavar="ACTION"),
    ]
    """`create` makes a new atlas of maps, `add` adds maps, and `remove` removes tiles. `join` gives
    tiles that certainly overlap one world. `info` prints the content."""
    atlas: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ATLAS")]
    """The atlas: a folder. With the extra `cluster` also a prefix of an object store, such as
    s3://bucket/campus."""
    names: Annotated[tyro.conf.Positional[tuple[str, ...]], option("MAP|TILE ...")] = ()
    """`create` and `add` copy these map files. `remove` removes these tiles. `join` compares these
    tiles with the others (default: all with each other)."""
    id: Annotated[str | None, option("NAME", "the file's name without .topo")] = None
    """`create`, `add`: the id of the tile, for one map."""
    world: Annotated[str | None, option("NAME", "each its own")] = None
    """`create`, `add`: the world that all these maps share, for example the parts of one
    recording."""
    replace: Flag = False
    """`add`: replace tiles of the same ids."""
    join: Flag = False
    """`create`, `add`: then join the new tiles with overlapping ones."""
    ray: RayOption = None
    """`join`, `--join`: the Ray cluster that compares the pairs of tiles, as in `topoloc
    build`."""
    check: Flag = False
    """`info`: also compare every file with its checksum. The exit status is 1 if a file is missing
    or differs."""
    json: File = None
    """Write the content of the atlas as JSON to this file (- for standard output)."""
    config: File = None
    """TOML file with the settings of a cluster, as printed by `topoloc config atlas`."""

    def run(self) -> int:
        self._check_usage()
        if self.action == "info":
            return show_atlas(Atlas.open(self.atlas), self.check, self.json)
        settings, ids = read_settings(self.config), self.names
        if self.action != "join":
            atlas = self._write()
            if not self.join:
                return report_atlas(describe_atlas(self.atlas, atlas.manifest), self.json)
            ids = [self.id or Path(name).name.removesuffix(".topo") for name in self.names]
        joined = join_overlapping_tiles(self.atlas, ids, settings, self.json != "-", ray=self.ray)
        return report_joined(self.atlas, joined, self.json)

    def _write(self) -> Atlas:
        if self.action == "remove":
            return Atlas.remove(self.atlas, self.names)
        if self.action == "create":
            return Atlas.create(self.atlas, self.names, self.id, self.world)
        return Atlas.add(self.atlas, self.names, self.id, self.world, self.replace)

    def _check_usage(self) -> None:
        if self.action == "info" and self.names:
            raise UsageError("info takes an atlas alone")
        if self.action in ("add", "remove") and not self.names:
            one = "map" if self.action == "add" else "tile"
            raise UsageError(f"{self.action} takes an atlas and at least one {one}")
        if self.id is not None and len(self.names) != 1:
            raise UsageError("--id names the tile of one map")
        joining = ("join", "create --join", "add --join")
        action = f"{self.action}{' --join' if self.join else ''}"
        for name, actions in {
            "id": ("create", "add"),
            "world": ("create", "add"),
            "replace": ("add",),
            "join": ("create", "add"),
            "check": ("info",),
            "config": joining,
            "ray": joining,
        }.items():
            is_given = getattr(self, name) not in (None, False)
            if is_given and self.action not in actions and action not in actions:
                raise UsageError(f"--{name} belongs to {' and '.join(actions)}")


def show_atlas(atlas: Atlas, check: bool, json: str | None) -> int:
    """Print the facts of an atlas and, if `check` is set, each tile that differs from its
    checksums. Return the exit status."""
    problems = [(name, atlas.find_problem(name)) for name in atlas.select_tiles() if check]
    found = [f"tile {name}: {problem}" for name, problem in problems if problem]
    facts = describe_atlas(atlas.store.where, atlas.manifest)
    return report_atlas(facts | ({"check": found or "ok"} if check else {}), json, found)


def report_joined(where: str, joined: JoinedTiles, json: str | None) -> int:
    """Print the facts of an atlas and the pairs that could not be compared. Return the exit
    status."""
    facts = describe_atlas(where, joined.manifest) | {"tried": joined.rows}
    return report_atlas(facts, json, joined.not_compared)


def report_atlas(facts: dict[str, Any], json: str | None, problems: Sequence[str] = ()) -> int:
    """Print the facts of an atlas or write them to the file `json`, then print the problems. Return
    the exit status."""
    if json != "-":
        _print_atlas(facts)
    write_json(json, facts)
    for problem in problems:
        print_line(f"error: {problem}", sys.stderr)
    return 1 if problems else 0


def describe_atlas(where: str, manifest: Any) -> dict[str, Any]:
    """Return the facts of an atlas: those of its tiles, and their sums."""
    tiles, origin, worlds = list[dict[str, Any]](), manifest.origin, dict[str, list[str]]()
    for tile in manifest.tiles:
        tiles.append(tile.to_json())
        worlds.setdefault(tile.in_joint_world.joint, []).append(tile.tile_id)
    return {
        "path": where,
        "serial": manifest.serial,
        "num_tiles": len(tiles),
        "num_nodes": sum(tile.num_nodes for tile in manifest.tiles),
        "bytes": sum(stored.num_bytes for tile in manifest.tiles for stored in tile.files),
        "origin": None if origin is None else {"lat": origin.lat, "lon": origin.lon, "h": origin.h},
        "worlds": worlds,
        "joins": [_describe_join(join, manifest) for join in manifest.joins],
        "tiles": tiles,
    }


def _describe_join(join: Any, manifest: Any) -> dict[str, Any]:
    """Return a join as JSON, with the standard deviation of its pose at the middle of the second
    tile (metres, degrees)."""
    middle = manifest.by_id[join.second].box_world.mean(axis=0)
    metres, radians = join.sigmas_at(middle)
    return join.to_json() | {"sigma_m": metres, "sigma_deg": math.degrees(radians)}


def _print_atlas(facts: dict[str, Any]) -> None:
    """Print the facts of an atlas, with one line for each tile."""
    width, check = max((len(tile["id"]) for tile in facts["tiles"]), default=0), facts.get("check")
    if isinstance(check, list):
        check = f"{len(check)} tiles are damaged"
    size = f"{facts['num_tiles']}, {facts['num_nodes']} nodes, {facts['bytes'] / 1e6:.2f} MB"
    shared = {name: ", ".join(ids) for name, ids in facts["worlds"].items() if len(ids) > 1}
    print_fields(
        [
            ("atlas", f"{facts['path']}, serial {facts['serial']}"),
            ("tiles", size),
            *(("", f"{tile['id']:<{width}}  {_format_tile(tile)}") for tile in facts["tiles"]),
            *(("world", f"{name}: {ids}") for name, ids in shared.items()),
            *(("join", _format_join(join)) for join in facts["joins"]),
            *([("check", check)] if check else []),
        ]
    )


def _format_join(join: dict[str, Any]) -> str:
    text = f"{join['first']} and {join['second']}: {join['num_agreeing']} pictures agree"
    if join["residual"] is None:
        return f"{text}, but other joins contradict them; not used"
    return f"{text}, {100 * join['sigma_m']:.1f} cm, {join['sigma_deg']:.2f} deg"


def _format_tile(tile: dict[str, Any]) -> str:
    least, most = tile["box_world"]
    extent = " x ".join(f"{high - low:.1f}" for low, high in zip(least, most, strict=True))
    box, size = tile["geo_box"], f"{tile['map']['bytes'] / 1e6:.1f} MB"
    place = "" if box is None else f"  {box[0]:.6f} {box[1]:.6f} to {box[2]:.6f} {box[3]:.6f}"
    return f"{tile['num_nodes']} nodes  {extent} m  {size}  {', '.join(tile['kinds'])}{place}"


@dataclass(frozen=True, eq=False)
class JoinedTiles:
    """The new manifest of the atlas, the result of each pair as JSON, and one line for each pair
    that could not be compared."""

    manifest: Any
    rows: list[dict[str, Any]]
    not_compared: list[str]


def join_overlapping_tiles(
    where: str,
    tile_ids: Sequence[str],
    settings: Settings,
    is_verbose: bool,
    pairs: Sequence[tuple[str, str]] | None = None,
    ray: str | None = None,
) -> JoinedTiles:
    """Join these tiles with overlapping ones, or only these `pairs`, on the cluster `ray` if it is
    given. Raises TopolocError: from `join_tiles` and `run_on_ray`."""

    def report_pair(one: Any) -> None:
        if is_verbose and one.problem is None:
            print_line(f"{one.first} and {one.second}: {one}", sys.stderr)

    run_jobs = None if ray is None else _run_jobs_on(ray, settings, report_pair)
    done = join_tiles(where, tile_ids, report_pair, pairs, run_jobs)
    lost = [
        f"{one.first} and {one.second}: {one.problem}"
        for one in done.pair_results
        if one.problem is not None
    ]
    return JoinedTiles(done.manifest, [one.to_json() for one in done.pair_results], lost)


def _run_jobs_on(
    ray: str, settings: Settings, report_pair: Callable[[Any], None]
) -> Callable[[Sequence[Any]], list[Any]]:
    """Return a function that runs one task for each pair and reports pairs as they finish."""
    from topoloc.apps.cluster.config import ClusterConfig
    from topoloc.apps.cluster.tasks import JobProgress, run_on_ray

    def show(number: int, state: Any) -> None:
        if not isinstance(state, JobProgress):
            report_pair(state)

    return lambda jobs: run_on_ray(jobs, ray, settings.get(ClusterConfig), show)
