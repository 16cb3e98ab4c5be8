"""topoloc undo MAP|ATLAS."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

import tyro

from topoloc import undo_edit
from topoloc.apps.cli.output import File, print_waiting, write_json
from topoloc.apps.cli.tile_option import TileOption, edit_map_or_tile


@dataclass(frozen=True)
class Command:
    """What `topoloc undo` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file; it becomes what it was before its last edit, to the byte. Or an atlas, with
    `--tile`."""
    tile: TileOption = None
    """Of an atlas: the tile whose last edit is taken back."""
    json: File = None
    """Write which edit was taken back to this file (- for standard output)."""

    def run(self) -> int:
        undone = edit_map_or_tile(self.map, self.tile, lambda path: undo_edit(path, print_waiting))
        tile = {} if self.tile is None else {"tile": self.tile}
        if self.json != "-":
            print(
                f"{self.map}{', tile ' * bool(tile)}{self.tile or ''}: {undone.name!r} of"
                f" {undone.date} is taken back"
            )
        write_json(self.json, {"map": self.map, **tile, "undone": asdict(undone)})
        return 0
