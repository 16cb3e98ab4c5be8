"""topoloc history MAP|ATLAS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from topoloc import Atlas, is_atlas, read_history
from topoloc.apps.cli.output import File, print_fields, write_json
from topoloc.apps.cli.tile_option import run_for_each_tile


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
        facts = read_history(self.map)
        if self.json != "-":
            _print_edits(facts, "nothing is known of how this map was made")
            _print_undo(self.map, facts)
        write_json(self.json, {"map": self.map, "edits": facts})
        return 0

    def _show_tiles(self) -> int:
        atlas = Atlas.open(self.map)

        def print_tile_history(tile_id: str) -> dict[str, Any]:
            edits = atlas.history(tile_id)
            if self.json != "-":
                print(f"tile {tile_id}")
                _print_edits(edits, "nothing is known of how this tile was made")
                _print_undo(f"{self.map} --tile {tile_id}", edits)
            return {"edits": edits}

        tiles, are_all_told = run_for_each_tile(
            atlas, list(atlas.manifest.by_id), print_tile_history
        )
        write_json(self.json, {"atlas": self.map, "tiles": tiles})
        return 0 if are_all_told else 1


def _print_undo(where: str, edits: list[dict[str, Any]]) -> None:
    num_undoable = sum(edit["undoable"] for edit in edits)
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
    recall, numbers = _describe_recall_change(changes or {}), (changes or {}).items()
    shown = {
        name.replace("_", " "): value
        for name, value in numbers
        if value not in ([], None, "") and not name.startswith("earlier_")
    }
    said = [f"{name} {value}" for name, value in shown.items()] + ([recall] if recall else [])
    return "" if not said else ": " + ", ".join(said)


def _describe_recall_change(changes) -> str | None:
    """How many earlier nodes were localized before and after an edit; None if it was not
    measured."""
    if not changes.get("earlier_asked"):
        return None
    asked, before, after = (
        changes[f"earlier_{name}"] for name in ("asked", "localized_before", "localized_after")
    )
    return (
        f"of {asked} earlier nodes, each asked without itself, {before} localized before and"
        f" {after} after"
    )
