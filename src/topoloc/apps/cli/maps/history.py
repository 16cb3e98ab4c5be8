"""topoloc history MAP|ATLAS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from topoloc import open_place
from topoloc.apps.cli.output import File, print_fields
from topoloc.apps.cli.tile_option import run_for_each_tile


@dataclass(frozen=True)
class Command:
    """Options of `topoloc history`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, or an atlas."""
    json: File = None
    """Write the history to this file (- for standard output)."""

    def run(self) -> int:
        place = open_place(self.map)

        def show_history(tile_id: str) -> dict[str, Any]:
            edits = place.history(tile_id)
            if self.json != "-":
                if tile_id:
                    print(f"tile {tile_id}")
                _print_edits(edits)
                _print_undo(f"{self.map} --tile {tile_id}" if tile_id else self.map, edits)
            return {"edits": edits}

        return run_for_each_tile(place, None, show_history, self.json)


def _print_undo(where: str, edits: list[dict[str, Any]]) -> None:
    num_undoable = sum(edit["undoable"] for edit in edits)
    if num_undoable:
        print(
            f"`topoloc undo {where}` takes the last one back"
            + (f"; {num_undoable} can be" if num_undoable > 1 else "")
        )


def _print_edits(edits: list[dict[str, Any]]) -> None:
    print_fields(
        [
            (
                f"{edit['edit_id']} {edit['date']}",
                f"{edit['name']}{_format_changes(edit['changes'])}",
            )
            for edit in edits
        ]
        or [("", "the edits of this map are unknown")]
    )


def _format_changes(changes) -> str:
    """Return the changes of an edit as text: each number with its name."""
    recall, numbers = _describe_recall_change(changes or {}), (changes or {}).items()
    shown = {
        name.replace("_", " "): value
        for name, value in numbers
        if value not in ([], None, "") and not name.startswith("earlier_")
    }
    texts = [f"{name} {value}" for name, value in shown.items()] + ([recall] if recall else [])
    return ": " + ", ".join(texts) if texts else ""


def _describe_recall_change(changes) -> str | None:
    """Return how many earlier nodes were localized before and after an edit, None if it was not
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
