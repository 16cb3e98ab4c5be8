"""topoloc info MAP."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from topoloc.cli.output import write_json


@dataclass(frozen=True)
class Command:
    """What `topoloc info` takes."""

    map: tyro.conf.Positional[str]
    """The map file."""
    json: str | None = None
    """Write the same as JSON to this file (- for standard output)."""

    def run(self) -> int:
        from topoloc.mapping.topomap import TopoMetricMap

        info = describe_map(TopoMetricMap.load(self.map), Path(self.map))
        if self.json != "-":
            _print(info)
        write_json(self.json, info)
        return 0


def describe_map(topomap: Any, path: Path) -> dict[str, Any]:
    """The facts of a map that evaluations and `info` print: counts, bytes, extent, configuration."""
    import numpy as np

    centres = np.array([s.world_from_cam.translation for s in topomap.summaries])
    return {
        "path": str(path),
        "bytes": path.stat().st_size,
        "num_nodes": len(topomap.summaries),
        "num_points": sum(s.num_points for s in topomap.summaries),
        "num_place_images": len(topomap.place_images),
        "length_m": round(topomap.length_m, 3),
        "extent_m": np.ptp(centres, axis=0).round(3).tolist(),
        "recordings": sorted({s.recording for s in topomap.summaries}),
        "coarse": sorted(topomap.coarse_models),
        "config": dict(topomap.config),
    }


def _print(info: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None)
    table.add_row("map", info["path"])
    table.add_row("size", f"{info['bytes'] / 1e6:.2f} MB")
    table.add_row("nodes", f"{info['num_nodes']}, {info['num_points']} points with 3-D position")
    table.add_row("place images", str(info["num_place_images"]))
    table.add_row("mapped", f"{info['length_m']:.1f} m, extent {' x '.join(f'{e:.1f}' for e in info['extent_m'])} m")
    table.add_row("recordings", ", ".join(info["recordings"]))
    table.add_row("coarse localizers", ", ".join(info["coarse"]))
    nodes, features = info["config"].get("nodes", {}), info["config"].get("features", {})
    table.add_row(
        "Eq. 1", f"D_thresh {nodes.get('d_thresh', float('nan')):.3g} m, lambda {nodes.get('lambda_rot', float('nan')):.3g} m/rad"
    )
    table.add_row("features", ", ".join(f"{key} {value}" for key, value in features.items() if isinstance(value, str)))
    Console().print(table)
