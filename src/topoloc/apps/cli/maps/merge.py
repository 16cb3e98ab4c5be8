"""topoloc merge A B OUT."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from topoloc import Atlas, LocalizerConfig, merge, open_place
from topoloc.apps.cli.maps.atlas import join_overlapping_tiles, report_joined
from topoloc.apps.cli.maps.session_update import describe_outdated_models
from topoloc.apps.cli.output import (
    File,
    UsageError,
    check_outputs,
    print_line,
    print_waiting,
    progress_bar,
    write_json,
)
from topoloc.apps.cli.settings_file import Settings, read_settings


@dataclass(frozen=True)
class Command:
    """Options of `topoloc merge`."""

    first: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="A")]
    """A map, whose world is that of the result. Or an atlas."""
    second: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="B")]
    """A map that overlaps with it. Or an atlas."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT")]
    """The map file to write. If A or B is an atlas, the new atlas with the tiles of both, joined
    where they overlap."""
    json: File = None
    """Write the changes to this file (- for standard output)."""
    config: File = None
    """TOML file with all other settings, as printed by `topoloc config update`."""

    def run(self) -> int:
        out, inputs = Path(self.out), map(Path, (self.first, self.second))
        if out.exists() and any(out.samefile(path) for path in inputs if path.exists()):
            raise UsageError("OUT is A or B; choose another path")
        return open_place(self.first).visit(
            lambda _: open_place(self.second).visit(self._merge_maps, self._merge_tiles),
            self._merge_tiles,
        )

    def _read_settings(self, *outputs: str | None) -> Settings:
        check_outputs(outputs, [self.first, self.second, self.config])
        return read_settings(self.config)

    def _merge_maps(self, _: str) -> int:
        settings = self._read_settings(self.out, self.json)
        config = settings.get(LocalizerConfig)
        with progress_bar() as progress:
            c = merge(self.first, self.second, self.out, config, progress, print_waiting)
        if self.json != "-":
            nodes = f"{c['agreeing']} of {c['nodes_of_second']} nodes of {self.second}"
            size = f"{c['bytes'] / 1e6:.2f} MB{describe_outdated_models(c)}"
            print_line(
                f"{self.out}: {nodes} were recognised in {self.first}, {c['nodes_added']} added,"
                f" {size}"
            )
        write_json(self.json, {"map": self.out} | c)
        return 0

    def _merge_tiles(self, _: Atlas) -> int:
        """Create an atlas of both and compare the tiles of the second one with the others. The exit
        status is 1 if some could not be compared."""
        settings, second = self._read_settings(self.json), open_place(self.second)
        Atlas.merge([self.first, self.second], self.out)
        added = [tile_id or second.name for tile_id in second.select_tiles()]
        joined = join_overlapping_tiles(self.out, added, settings, self.json != "-")
        return report_joined(self.out, joined, self.json)
