"""topoloc merge A B OUT."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from topoloc import Atlas, LocalizerConfig, is_atlas, merge
from topoloc.apps.cli.maps.atlas import describe, print_atlas
from topoloc.apps.cli.maps.session_update import describe_outdated_models
from topoloc.apps.cli.maps.tile_joining import join_overlapping_tiles
from topoloc.apps.cli.output import File, UsageError, check_outputs, progress_bar, write_json
from topoloc.apps.cli.settings_file import Settings, read_settings


@dataclass(frozen=True)
class Command:
    """What `topoloc merge` takes."""

    first: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="A")]
    """A map; its world is that of the result. Or an atlas."""
    second: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="B")]
    """A map of a place that overlaps with it. Or an atlas."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT")]
    """The map file to write; neither A nor B. Where one of these is an atlas, the new atlas of the
    tiles of both, joined where they overlap."""
    json: File = None
    """Write what was merged to this file (- for standard output)."""
    config: File = None
    """All other settings: a TOML file, as `topoloc config update` prints it."""

    def run(self) -> int:
        if Path(self.out).exists() and any(
            Path(self.out).samefile(path)
            for path in (self.first, self.second)
            if Path(path).exists()
        ):
            raise UsageError("OUT is one of the maps that are merged; give it a name of its own")
        is_of_tiles = is_atlas(self.first) or is_atlas(self.second)
        check_outputs(
            [None if is_of_tiles else self.out, self.json],
            inputs=[path for path in (self.first, self.second, self.config) if path],
        )
        settings = read_settings(self.config)
        if is_of_tiles:
            return self._merge_tiles(settings)
        with progress_bar() as progress:
            c = merge(
                self.first,
                self.second,
                self.out,
                settings.of(LocalizerConfig),
                progress,
            )
        if self.json != "-":
            recognised = (
                f"{c['agreeing']} of {c['nodes_of_second']} nodes of {self.second} were recognised"
                f" in {self.first}"
            )
            print(
                f"{self.out}: {recognised}, {c['nodes_added']} added, {c['bytes'] / 1e6:.2f}"
                f" MB{describe_outdated_models(c)}"
            )
        write_json(self.json, {"map": self.out} | c)
        return 0

    def _merge_tiles(self, settings: Settings) -> int:
        """An atlas of two; then tiles of the second are compared with those of the first. Status 1
        where some could not be."""

        first = Atlas.open(self.first).manifest.by_id if is_atlas(self.first) else {}
        merged = Atlas.merge([self.first, self.second], self.out).manifest
        second = (
            Atlas.open(self.second).manifest.by_id
            if is_atlas(self.second)
            else merged.by_id.keys() - first.keys()
        )
        joined = join_overlapping_tiles(self.out, sorted(second), settings, self.json != "-")
        facts = describe(self.out, joined.manifest) | {"tried": joined.rows}
        if self.json != "-":
            print_atlas(facts)
        write_json(self.json, facts)
        for problem in joined.not_compared:
            print(f"error: {problem}", file=sys.stderr)
        return 1 if joined.not_compared else 0
