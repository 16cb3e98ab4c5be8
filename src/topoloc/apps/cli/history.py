"""topoloc history MAP|ATLAS."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from topoloc import Atlas, TopoMetricMap, is_atlas
from topoloc.apps.cli.output import File, print_fields, write_json
from topoloc.apps.cli.tile_option import run_for_each_tile
from topoloc.atlas.manifest import Tile
from topoloc.lifelong.recall_change import describe_recall_change
from topoloc.mapping.edit import count_undoable_edits


@dataclass(frozen=True)
class Command:
    """What `topoloc history` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, or an atlas."""
    json: File = None
    """Write the history to this file (- for standard output)."""

    def run(self) -> int:
        if is_atlas(self.map):
            return self._show_tiles()
        facts, num_undoable = _read_edits(self.map)
        if self.json != "-":
            _print_edits(facts, "nothing is known of how this map was made")
            _print_undo(self.map, num_undoable)
        write_json(self.json, {"map": self.map, "edits": facts})
        return 0

    def _show_tiles(self) -> int:
        atlas = Atlas.open(self.map)

        def print_tile_history(tile_id: str) -> dict[str, Any]:
            edits, num_undoable = _read_tile_edits(atlas, atlas.tile(tile_id))
            if self.json != "-":
                print(f"tile {tile_id}")
                _print_edits(edits, "nothing is known of how this tile was made")
                _print_undo(f"{self.map} --tile {tile_id}", num_undoable)
            return {"edits": edits}

        tiles, are_all_told = run_for_each_tile(
            atlas, list(atlas.manifest.by_id), print_tile_history
        )
        write_json(self.json, {"atlas": self.map, "tiles": tiles})
        return 0 if are_all_told else 1


def _read_tile_edits(atlas: Atlas, tile: Tile) -> tuple[list[dict[str, Any]], int]:
    """As `_read_edits`. Raises MapError."""
    log = None if tile.undo is None else atlas.store.local_path(tile.undo.name, tile.undo.sha256)
    return _read_edits(atlas.map_path(tile), log)


def _read_edits(path: str | Path, log: Path | None = None) -> tuple[list[dict[str, Any]], int]:
    """The edits of a map file, the first one first, and how many of the last ones can be taken
    back, by the undo file beside it or another one. Raises MapError."""
    num_undoable = count_undoable_edits(path, log)
    with TopoMetricMap.load(path) as topomap:
        edits = [asdict(edit) for edit in topomap.edits]
    return [
        edit | {"undoable": number > len(edits) - num_undoable}
        for number, edit in enumerate(edits, start=1)
    ], num_undoable


def _print_undo(where: str, num_undoable: int) -> None:
    if num_undoable:
        print(
            f"`topoloc undo {where}` takes the last one back"
            + (f"; {num_undoable} can be" if num_undoable > 1 else "")
        )


def _print_edits(edits: list[dict[str, Any]], without: str) -> None:
    print_fields(
        [
            (
                f"{edit['edit_id']} {edit['date']}",
                f"{edit['name']}{_format_changes(edit['changes'])}",
            )
            for edit in edits
        ]
        or [("", without)]
    )


def _format_changes(changes) -> str:
    """What an edit changed, in the words of its numbers."""
    recall, numbers = describe_recall_change(changes or {}), (changes or {}).items()
    shown = {
        name.replace("_", " "): value
        for name, value in numbers
        if value not in ([], None, "") and not name.startswith("earlier_")
    }
    said = [f"{name} {value}" for name, value in shown.items()] + ([recall] if recall else [])
    return "" if not said else ": " + ", ".join(said)
