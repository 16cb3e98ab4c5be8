"""topoloc prune MAP|ATLAS [--max-mb N] [--descriptors coarse]."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from topoloc import Atlas, is_atlas, prune
from topoloc.apps.cli.output import File, UsageError, check_outputs, print_waiting, write_json
from topoloc.apps.cli.tile_option import (
    TileOption,
    check_tile_option,
    edit_map_or_tile,
    run_for_each_tile,
)


@dataclass(frozen=True)
class Command:
    """What `topoloc prune` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, which is replaced; or an atlas, whose tiles are, one after the other."""
    max_mb: Annotated[
        float | None,
        tyro.conf.arg(metavar="N", help_behavior_hint="(default: only what is gone is dropped)"),
    ] = None
    """Megabytes that the file may have, of an atlas that of each tile: every node keeps the
    landmarks that add most, and nodes that others hold go before it keeps few."""
    descriptors: Literal["fine", "coarse"] = "fine"
    """With `coarse` descriptors are rounded, to a third of their bytes, before anything goes that
    may be there."""
    tile: TileOption = None
    """Of an atlas: only this tile is pruned."""
    json: File = None
    """Write what was dropped to this file (- for standard output)."""

    def run(self) -> int:
        if self.max_mb is not None and not 0.0 < self.max_mb < 1e6:
            raise UsageError(f"--max-mb must be megabytes, not {self.max_mb:g}")
        check_outputs([self.json], inputs=[self.map])
        check_tile_option(self.map, self.tile)
        if not is_atlas(self.map):
            changes = self._prune_map(Path(self.map), self.map)
            write_json(self.json, {"map": self.map} | changes)
            return 0
        atlas = Atlas.open(self.map)
        ids = list(atlas.manifest.by_id) if self.tile is None else [atlas.tile(self.tile).tile_id]
        tiles, are_all_pruned = run_for_each_tile(
            atlas,
            ids,
            lambda name: edit_map_or_tile(
                self.map,
                name,
                lambda path: self._prune_map(path, f"{self.map}, tile {name}"),
            ),
        )
        write_json(self.json, {"atlas": self.map, "tiles": tiles})
        return 0 if are_all_pruned else 1

    def _prune_map(self, path: Path, name: str) -> dict[str, Any]:
        """What was dropped from a map file, which is said of it by its name."""
        pruned = prune(path, self.max_mb, self.descriptors, print_waiting)
        changes = pruned.changes
        if self.json != "-":
            print(f"{name}: {describe_prune(changes, pruned.length_m / 1e3)}")
        return changes


def describe_prune(changes: Mapping[str, Any], walked_km: float) -> str:
    """What was dropped, in one line."""
    c = changes
    nodes = f"{c['nodes_dropped']} nodes that others hold, " if c["nodes_dropped"] else ""
    dropped = (
        f"{c['landmarks_gone']} landmarks are gone, {nodes}{c['landmarks_dropped']} more landmarks"
        " dropped"
    )
    per_km = f" ({c['bytes'] / 1e6 / walked_km:.0f} MB a km walked)" if walked_km > 0 else ""
    return f"{dropped}, {c['bytes_before'] / 1e6:.2f} to {c['bytes'] / 1e6:.2f} MB{per_km}"
