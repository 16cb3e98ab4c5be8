"""topoloc merge A B OUT."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from topoloc.cli.output import File, UsageError, check_outputs, progress_bar, write_json
from topoloc.cli.session_joining import describe_untaught
from topoloc.cli.settings_file import read_settings
from topoloc.lifelong.merge import merge_maps
from topoloc.lifelong.update import UpdateConfig
from topoloc.localization.localizer import LocalizerConfig
from topoloc.map.schema import SCHEMA_VERSION
from topoloc.map.sessions import Edit, today
from topoloc.map.topomap import TopoMetricMap


@dataclass(frozen=True)
class Command:
    """What `topoloc merge` takes."""

    first: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="A")]
    """A map; its world is that of the result."""
    second: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="B")]
    """A map of a place that overlaps with it."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT")]
    """The map file to write; neither A nor B."""
    json: File = None
    """Write what was merged to this file (- for standard output)."""
    config: File = None
    """All other settings: a TOML file, as `topoloc config update` prints it."""

    def run(self) -> int:
        if Path(self.out).exists() and any(Path(self.out).samefile(path) for path in (self.first, self.second) if Path(path).exists()):
            raise UsageError("OUT is one of the maps that are merged; give it a name of its own")
        check_outputs([self.out, self.json], inputs=[path for path in (self.first, self.second, self.config) if path])
        settings = read_settings(self.config)
        with TopoMetricMap.load(self.first) as first, TopoMetricMap.load(self.second) as second, progress_bar() as progress:
            merged = merge_maps(first, second, settings.of(UpdateConfig), settings.of(LocalizerConfig), progress)
            edit = Edit(first.free_ids.edit, f"merge {Path(self.second).name}", today(), SCHEMA_VERSION, merged.changes)
            replace(merged.topomap, edits=[*first.edits, edit]).save(self.out)
        c = merged.changes | {"bytes": Path(self.out).stat().st_size}
        if self.json != "-":
            recognised = f"{c['agreeing']} of {c['nodes_of_second']} nodes of {self.second} were recognised in {self.first}"
            print(f"{self.out}: {recognised}, {c['nodes_added']} added, {c['bytes'] / 1e6:.2f} MB{describe_untaught(c)}")
        write_json(self.json, {"map": self.out} | c)
        return 0
