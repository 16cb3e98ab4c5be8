"""topoloc undo MAP|ATLAS."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

import tyro

from topoloc import open_place, undo_edit
from topoloc.apps.cli.output import File, print_line, print_waiting, write_json
from topoloc.apps.cli.tile_option import TileOption, select_tile


@dataclass(frozen=True)
class Command:
    """Options of `topoloc undo`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file. It becomes byte-identical to the file before its last edit. Or an atlas, with
    `--tile`."""
    tile: TileOption = None
    """The tile of an atlas whose last edit is undone."""
    json: File = None
    """Write the undone edit to this file (- for standard output)."""

    def run(self) -> int:
        place = open_place(self.map)
        tile_id = select_tile(place, self.tile)
        undone = place.edit(tile_id, lambda path: undo_edit(path, print_waiting))
        if self.json != "-":
            print_line(f"{place.title(tile_id)}: {undone.name!r} of {undone.date} is taken back")
        tile = {"tile": tile_id} if tile_id else {}
        write_json(self.json, {"map": self.map, **tile, "undone": asdict(undone)})
        return 0
