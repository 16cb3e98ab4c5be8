"""topoloc info MAP."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from topoloc import MapError, check_map, is_atlas
from topoloc.apps.cli.maps import atlas
from topoloc.apps.cli.output import File, Flag, UsageError, check_outputs, print_fields, write_json

MAX_PROBLEMS = 20


@dataclass(frozen=True)
class Command:
    """What `topoloc info` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, or an atlas."""
    json: File = None
    """Write the same as JSON to this file (- for standard output)."""

    check: Flag = False
    """Also look at every byte of the map, and whether its nodes agree with their neighbours; exit
    status 1 where something is wrong."""

    graph: Annotated[
        str | None, tyro.conf.arg(metavar="FILE.graphml|FILE.geojson", help_behavior_hint="")
    ] = None
    """Write nodes, junctions and the ways between them to this file; GeoJSON of a map that knows
    its place on earth."""

    def run(self) -> int:
        from topoloc import TopoMetricMap

        if is_atlas(self.map) and self.graph:
            raise UsageError("--graph is of one map; name a tile's file")
        if is_atlas(self.map):
            return atlas.Command("info", self.map, check=self.check, json=self.json).run()
        check_outputs([self.json, self.graph], inputs=[self.map])
        with TopoMetricMap.load(self.map) as topomap:
            found = check_map(self.map) if self.check else []
            if found:
                print("\n".join(found[:MAX_PROBLEMS]))
                raise MapError(
                    f"map {self.map} is damaged: {len(found)} things are wrong, the first:"
                    f" {found[0]}"
                )
            if self.graph:
                from topoloc.apps.export.map_graph import write_graph

                write_graph(topomap, Path(self.graph))
            info = topomap.describe(self.map) | ({"check": "ok"} if self.check else {})
        if self.json != "-":
            _print(info)
        write_json(self.json, info)
        return 0


def _print(info: dict[str, Any]) -> None:
    nodes, normalization = (
        info["config"].get("nodes", {}),
        info["config"].get("features", {}).get("normalization"),
    )
    nan = float("nan")
    print_fields(
        [
            ("map", info["path"]),
            ("id", f"{info['map']}, version {info['version']}"),
            ("size", f"{info['bytes'] / 1e6:.2f} MB"),
            ("nodes", f"{info['num_nodes']}, {info['num_points']} points with 3-D position"),
            ("side nodes", str(info["num_side_nodes"])),
            ("place images", str(info["num_place_images"])),
            (
                "mapped",
                (
                    f"{info['length_m']:.1f} m, extent"
                    f" {' x '.join(f'{e:.1f}' for e in info['extent_m'])} m"
                ),
            ),
            ("recordings", ", ".join(info["recordings"])),
            ("on earth", _format_place(info["georeference"])),
            *(
                ("coarse localizer", _format_coarse(facts, info["default_coarse"]))
                for facts in info["coarse_models"]
            ),
            (
                "Eq. 1",
                (
                    f"D_thresh {nodes.get('d_thresh', nan):.3g} m, lambda"
                    f" {nodes.get('lambda_rot', nan):.3g} m/rad"
                ),
            ),
            (
                "features",
                ", ".join(info["kinds"])
                + (f", normalization {normalization}" if normalization else ""),
            ),
            *([("check", info["check"])] if "check" in info else []),
        ]
    )


def _format_place(facts: dict[str, Any] | None) -> str:
    from topoloc import Georeference
    from topoloc.apps.cli.maps.georeference import format_georeference

    return (
        "unknown (topoloc georeference says where)"
        if facts is None
        else format_georeference(Georeference.from_json(facts))
    )


def _format_coarse(facts: dict[str, Any], default: str) -> str:
    weights = facts.get("weights")
    source = (
        f"{weights['file']}, SHA-256 {weights['sha256'][:12]}" if weights else "from random weights"
    )
    network = f", {facts['backbone']} ({source})" if "backbone" in facts else ""
    return (
        f"{facts['name']}{' (default)' if facts['name'] == default else ''}{network},"
        f" {facts['bytes'] / 1e6:.2f} MB"
    )
