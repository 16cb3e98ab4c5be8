"""topoloc history MAP|ATLAS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from topoloc import open_place
from topoloc.apps.cli.output import File, print_fields, print_line
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
                    print_line(f"tile {tile_id}")
                _print_edits(edits, f"{self.map} --tile {tile_id}" if tile_id else self.map)
            return {"edits": edits}

        return run_for_each_tile(place, None, show_history, self.json)


def _print_edits(edits: list[dict[str, Any]], where: str) -> None:
    """Print the edits, and the command that undoes the last one of `where`."""
    rows = [
        (f"{one['edit_id']} {one['date']}", f"{one['name']}{_format_changes(one['changes'] or {})}")
        for one in edits
    ]
    print_fields(rows or [("", "the edits of this map are unknown")])
    if num_undoable := sum(edit["undoable"] for edit in edits):
        more = f"; {num_undoable} can be" if num_undoable > 1 else ""
        print_line(f"`topoloc undo {where}` takes the last one back{more}")


def _format_changes(changes: dict[str, Any]) -> str:
    """Return the changes of an edit as text: each number with its name, and the recall of earlier
    nodes if it was measured."""
    texts = [
        f"{name.replace('_', ' ')} {value}"
        for name, value in changes.items()
        if value not in ([], None, "") and not name.startswith("earlier_")
    ]
    if asked := changes.get("earlier_asked"):
        before, after = changes["earlier_localized_before"], changes["earlier_localized_after"]
        nodes = f"of {asked} earlier nodes, each asked without itself"
        texts.append(f"{nodes}, {before} localized before and {after} after")
    return ": " + ", ".join(texts) if texts else ""
