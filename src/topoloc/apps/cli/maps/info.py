"""topoloc info MAP|ATLAS."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from topoloc import Atlas, MapError, TopoMetricMap, check_map, open_place
from topoloc.apps.cli.maps.atlas import show_atlas
from topoloc.apps.cli.output import File, Flag, UsageError, check_outputs, print_fields, write_json

MAX_PROBLEMS = 20


@dataclass(frozen=True)
class Command:
    """Options of `topoloc info`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, or an atlas."""
    json: File = None
    """Write the facts as JSON to this file (- for standard output)."""

    check: Flag = False
    """Also check all data of the map, and that its nodes agree with their neighbours. In an atlas,
    compare every file with its checksum. The exit status is 1 if there is a fault."""

    graph: Annotated[
        str | None, tyro.conf.arg(metavar="FILE.graphml|FILE.geojson", help_behavior_hint="")
    ] = None
    """Write nodes, junctions and the paths between them to this file. GeoJSON needs a georeferenced
    map."""

    def run(self) -> int:
        return open_place(self.map).visit(self._show_map, self._show_atlas)

    def _show_atlas(self, atlas: Atlas) -> int:
        if self.graph:
            raise UsageError("--graph needs one map file, not an atlas")
        return show_atlas(atlas, self.check, self.json)

    def _show_map(self, path: str) -> int:
        check_outputs([self.json, self.graph], inputs=[path])
        with TopoMetricMap.load(path) as topomap:
            found = check_map(path) if self.check else []
            if found:
                print("\n".join(found[:MAX_PROBLEMS]))
                raise MapError(f"map {path} is damaged: {len(found)} faults, the first: {found[0]}")
            if self.graph:
                from topoloc.apps.export.map_graph import write_graph

                write_graph(topomap, Path(self.graph))
            info = topomap.describe(path) | ({"check": "ok"} if self.check else {})
        if self.json != "-":
            _print(info)
        write_json(self.json, info)
        return 0


def _print(info: dict[str, Any]) -> None:
    nodes, features = (info["config"].get(name, {}) for name in ("nodes", "features"))
    normalization, nan = features.get("normalization"), float("nan")
    extent = " x ".join(f"{e:.1f}" for e in info["extent_m"])
    print_fields(
        [
            ("map", info["path"]),
            ("id", f"{info['map']}, version {info['version']}"),
            ("size", f"{info['bytes'] / 1e6:.2f} MB"),
            ("nodes", f"{info['num_nodes']}, {info['num_points']} points with 3-D position"),
            ("side nodes", str(info["num_side_nodes"])),
            ("place images", str(info["num_place_images"])),
            ("mapped", f"{info['length_m']:.1f} m, extent {extent} m"),
            ("recordings", ", ".join(info["recordings"])),
            ("on earth", _format_place(info["georeference"])),
            *(
                ("coarse localizer", _format_coarse(facts, info["default_coarse"]))
                for facts in info["coarse_models"]
            ),
            (
                "Eq. 1",
                f"D_thresh {nodes.get('d_thresh', nan):.3g} m, lambda"
                f" {nodes.get('lambda_rot', nan):.3g} m/rad",
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
    if facts is None:
        return "unknown (topoloc georeference sets it)"
    from topoloc import Georeference
    from topoloc.apps.cli.maps.georeference import format_georeference

    return format_georeference(Georeference.from_json(facts))


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
