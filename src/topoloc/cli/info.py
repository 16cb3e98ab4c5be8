"""topoloc info MAP."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from topoloc.cli.output import File, Flag, check_outputs, print_facts, write_json
from topoloc.errors import EmptyMapError, MapError

MAX_DAMAGES = 20


@dataclass(frozen=True)
class Command:
    """What `topoloc info` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """The map file."""
    json: File = None
    """Write the same as JSON to this file (- for standard output)."""

    check: Flag = False
    """Also look at every byte of the map, and whether its nodes agree with their neighbours; exit status 1 where something is wrong."""

    def run(self) -> int:
        from topoloc.map.topomap import TopoMetricMap

        check_outputs([self.json], inputs=[self.map])
        with TopoMetricMap.load(self.map) as topomap:
            found = _damages(topomap, Path(self.map)) if self.check else []
            if found:
                print("\n".join(found[:MAX_DAMAGES]))
                raise MapError(f"map {self.map} is damaged: {len(found)} things are wrong, the first: {found[0]}")
            info = describe_map(topomap, Path(self.map)) | ({"check": "ok"} if self.check else {})
        if self.json != "-":
            _print(info)
        write_json(self.json, info)
        return 0


def _damages(topomap: Any, path: Path) -> list[str]:
    """What is wrong with the bytes of the file, or, where nothing is, with what they say."""
    from topoloc.localization.map_facts.contradictions import contradictions
    from topoloc.map.checking import damages

    found = damages(path)
    return found or [str(contradiction) for contradiction in contradictions(topomap)]


def describe_map(topomap: Any, path: Path) -> dict[str, Any]:
    """The facts of a map that evaluations and `info` print: counts, bytes, extent, configuration.

    Raises:
        EmptyMapError: the map has no node.
    """
    import numpy as np

    from topoloc.map.checking import list_coarse
    from topoloc.map.contents import map_id_of

    if len(topomap.summaries) == 0:
        raise EmptyMapError(f"map {path} has no nodes")
    centres = np.array([s.world_from_cam.translation for s in topomap.summaries])
    return {
        "path": str(path),
        "map": map_id_of(topomap),
        "version": topomap.version,
        "georeference": None if topomap.georeference is None else topomap.georeference.to_json(),
        "bytes": path.stat().st_size,
        "num_nodes": len(topomap.summaries),
        "num_points": sum(s.num_points for s in topomap.summaries),
        "num_side_nodes": len(topomap.sides.summaries) if topomap.sides else 0,
        "num_place_images": len(topomap.place_images),
        "length_m": round(topomap.length_m, 3),
        "extent_m": np.ptp(centres, axis=0).round(3).tolist(),
        "recordings": sorted({s.recording for s in topomap.summaries}),
        "sessions": [_session_facts(session) for session in topomap.sessions],
        "edits": [asdict(edit) for edit in topomap.edits],
        "coarse": sorted(topomap.coarse_models),
        "default_coarse": topomap.default_coarse,
        "kinds": topomap.kinds,
        "coarse_models": list_coarse(path),
        "config": topomap.config.to_json(),
    }


def _session_facts(session: Any) -> dict[str, Any]:
    camera = None if session.camera is None else session.camera.to_json()
    return asdict(session) | {"camera": camera, "start_date": session.start_date, "end_date": session.end_date}


def _print(info: dict[str, Any]) -> None:
    nodes, normalization = info["config"].get("nodes", {}), info["config"].get("features", {}).get("normalization")
    nan = float("nan")
    print_facts(
        [
            ("map", info["path"]),
            ("id", f"{info['map']}, version {info['version']}"),
            ("size", f"{info['bytes'] / 1e6:.2f} MB"),
            ("nodes", f"{info['num_nodes']}, {info['num_points']} points with 3-D position"),
            ("side nodes", str(info["num_side_nodes"])),
            ("place images", str(info["num_place_images"])),
            ("mapped", f"{info['length_m']:.1f} m, extent {' x '.join(f'{e:.1f}' for e in info['extent_m'])} m"),
            ("recordings", ", ".join(info["recordings"])),
            ("on earth", _place_line(info["georeference"])),
            *(("coarse localizer", _coarse_line(facts, info["default_coarse"])) for facts in info["coarse_models"]),
            ("Eq. 1", f"D_thresh {nodes.get('d_thresh', nan):.3g} m, lambda {nodes.get('lambda_rot', nan):.3g} m/rad"),
            ("features", ", ".join(info["kinds"]) + (f", normalization {normalization}" if normalization else "")),
            *([("check", info["check"])] if "check" in info else []),
        ]
    )


def _place_line(facts: dict[str, Any] | None) -> str:
    from topoloc.cli.georeference import place_line
    from topoloc.geometry.geodesy import Georeference

    return "unknown (topoloc georeference says where)" if facts is None else place_line(Georeference.from_json(facts))


def _coarse_line(facts: dict[str, Any], default: str) -> str:
    weights = facts.get("weights")
    source = f"{weights['file']}, SHA-256 {weights['sha256'][:12]}" if weights else "from random weights"
    network = f", {facts['backbone']} ({source})" if "backbone" in facts else ""
    return f"{facts['name']}{' (default)' if facts['name'] == default else ''}{network}, {facts['bytes'] / 1e6:.2f} MB"
