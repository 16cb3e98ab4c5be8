"""topoloc history MAP|ATLAS."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import tyro

from topoloc.atlas.atlas import Atlas, is_atlas
from topoloc.cli.output import File, print_facts, write_json
from topoloc.errors import MapError, StoreError
from topoloc.lifelong.earlier_recall import described
from topoloc.map.edit import undoable_edits
from topoloc.map.topomap import TopoMetricMap


@dataclass(frozen=True)
class Command:
    """What `topoloc history` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file, or an atlas."""
    json: File = None
    """Write the history to this file (- for standard output)."""

    def run(self) -> int:
        if is_atlas(self.map):
            return self._of_tiles()
        facts, num_undoable = _edits(self.map), undoable_edits(self.map)
        for number, edit in enumerate(facts, start=1):
            edit["undoable"] = number > len(facts) - num_undoable
        if self.json != "-":
            _print_edits(facts, "nothing is known of how this map was made")
            if num_undoable:
                print(f"`topoloc undo {self.map}` takes the last one back" + (f"; {num_undoable} can be" if num_undoable > 1 else ""))
        write_json(self.json, {"map": self.map, "edits": facts})
        return 0

    def _of_tiles(self) -> int:
        """Tile by tile; one that cannot be read leaves the others. None can be taken back: an atlas keeps no undo files."""
        atlas, tiles, num_missing = Atlas.open(self.map), list[dict[str, Any]](), 0
        for tile in atlas.manifest.tiles:
            try:
                edits = _edits(str(atlas.map_path(tile)))
            except StoreError:  # the others would be asked for as long, one after the other
                raise
            except MapError as error:
                print(f"error: tile {tile.tile_id}: {error}", file=sys.stderr)
                num_missing += 1
                continue
            if self.json != "-":
                print(f"tile {tile.tile_id}")
                _print_edits(edits, "nothing is known of how this tile was made")
            tiles.append({"tile_id": tile.tile_id, "edits": [edit | {"undoable": False} for edit in edits]})
        write_json(self.json, {"atlas": self.map, "tiles": tiles})
        return 1 if num_missing else 0


def _edits(path: str) -> list[dict[str, Any]]:
    """The edits of a map file, the first one first. Raises MapError."""
    with TopoMetricMap.load(path) as topomap:
        return [asdict(edit) for edit in topomap.edits]


def _print_edits(edits: list[dict[str, Any]], without: str) -> None:
    print_facts([(f"{edit['edit_id']} {edit['date']}", f"{edit['name']}{_said(edit['changes'])}") for edit in edits] or [("", without)])


def _said(changes) -> str:
    """What an edit changed, in the words of its numbers."""
    recall, numbers = described(changes or {}), (changes or {}).items()
    shown = {name.replace("_", " "): value for name, value in numbers if value not in ([], None, "") and not name.startswith("earlier_")}
    said = [f"{name} {value}" for name, value in shown.items()] + ([recall] if recall else [])
    return "" if not said else ": " + ", ".join(said)
