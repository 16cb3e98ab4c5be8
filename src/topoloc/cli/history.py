"""topoloc history MAP."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

import tyro

from topoloc.cli.output import File, print_facts, write_json
from topoloc.lifelong.earlier_recall import described
from topoloc.map.edit import undoable_edits
from topoloc.map.topomap import TopoMetricMap


@dataclass(frozen=True)
class Command:
    """What `topoloc history` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """The map file."""
    json: File = None
    """Write the history to this file (- for standard output)."""

    def run(self) -> int:
        with TopoMetricMap.load(self.map) as topomap:
            edits = list(topomap.edits)
        num_undoable = undoable_edits(self.map)
        first_undoable = len(edits) - num_undoable
        facts = [asdict(edit) | {"undoable": k >= first_undoable} for k, edit in enumerate(edits)]
        if self.json != "-":
            rows = [(f"{edit.edit_id} {edit.date}", f"{edit.name}{_said(edit.changes)}") for edit in edits]
            print_facts(rows or [("", "nothing is known of how this map was made")])
            if num_undoable:
                print(f"`topoloc undo {self.map}` takes the last one back" + (f"; {num_undoable} can be" if num_undoable > 1 else ""))
        write_json(self.json, {"map": self.map, "edits": facts})
        return 0


def _said(changes) -> str:
    """What an edit changed, in the words of its numbers."""
    recall, numbers = described(changes or {}), (changes or {}).items()
    shown = {name.replace("_", " "): value for name, value in numbers if value not in ([], None, "") and not name.startswith("earlier_")}
    said = [f"{name} {value}" for name, value in shown.items()] + ([recall] if recall else [])
    return "" if not said else ": " + ", ".join(said)
