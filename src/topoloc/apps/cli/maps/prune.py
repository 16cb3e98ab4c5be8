"""topoloc prune MAP|ATLAS [--max-mb N]."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from topoloc import open_place, prune
from topoloc.apps.cli.output import (
    File,
    UsageError,
    check_outputs,
    option,
    print_line,
    print_waiting,
)
from topoloc.apps.cli.tile_option import TileOption, run_for_each_tile


@dataclass(frozen=True)
class Command:
    """Options of `topoloc prune`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, which is replaced. Or an atlas, whose tiles are replaced one by one."""
    max_mb: Annotated[float | None, option("N", "remove only landmarks that are gone")] = None
    """Maximum size of the map file in megabytes. In an atlas it holds for each tile. Every node
    keeps its most useful landmarks. Redundant nodes are removed before nodes keep too few."""
    tile: TileOption = None
    """Prune only this tile of an atlas."""
    json: File = None
    """Write the changes to this file (- for standard output)."""

    def run(self) -> int:
        if self.max_mb is not None and not 0.0 < self.max_mb < 1e6:
            raise UsageError(f"--max-mb must be megabytes, not {self.max_mb:g}")
        check_outputs([self.json], inputs=[self.map])
        place = open_place(self.map)

        def prune_tile(tile_id: str) -> dict[str, Any]:
            pruned = place.edit(tile_id, lambda path: prune(path, self.max_mb, print_waiting))
            if self.json != "-":
                text = describe_prune(pruned.changes, pruned.length_m / 1e3)
                print_line(f"{place.title(tile_id)}: {text}")
            return pruned.changes

        return run_for_each_tile(place, self.tile, prune_tile, self.json)


def describe_prune(changes: Mapping[str, Any], walked_km: float) -> str:
    """Return the changes as one line."""
    c = changes
    nodes = f"{c['nodes_dropped']} nodes that others hold, " if c["nodes_dropped"] else ""
    dropped = (
        f"{c['landmarks_gone']} landmarks are gone, {nodes}{c['landmarks_dropped']} more landmarks"
        " dropped"
    )
    per_km = f" ({c['bytes'] / 1e6 / walked_km:.0f} MB a km walked)" if walked_km > 0 else ""
    return f"{dropped}, {c['bytes_before'] / 1e6:.2f} to {c['bytes'] / 1e6:.2f} MB{per_km}"
