"""topoloc undo MAP."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

import tyro

from topoloc.cli.output import File, write_json
from topoloc.cli.waiting import say_waiting
from topoloc.map.edit import undo_edit


@dataclass(frozen=True)
class Command:
    """What `topoloc undo` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """The map file; it becomes what it was before its last edit, to the byte."""
    json: File = None
    """Write which edit was taken back to this file (- for standard output)."""

    def run(self) -> int:
        undone = undo_edit(self.map, say_waiting)
        if self.json != "-":
            print(f"{self.map}: {undone.name!r} of {undone.date} is taken back")
        write_json(self.json, {"map": self.map, "undone": asdict(undone)})
        return 0
