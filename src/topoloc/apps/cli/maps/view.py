"""topoloc view MAP|ATLAS [RESULTS ...]."""

from __future__ import annotations

import sys
import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from topoloc import Atlas, TopoMetricMap, is_atlas
from topoloc.apps.cli.output import File, UsageError, check_outputs, write_json
from topoloc.apps.cli.tile_option import (
    TileOption,
    atlas_name,
    check_tile_option,
    print_warning,
    select_world,
)
from topoloc.apps.viewer.document import ResultSet, SceneBudget, create_document
from topoloc.apps.viewer.page import find_browser, write_scene_page, write_screenshot
from topoloc.apps.viewer.result_files import read_results
from topoloc.apps.viewer.world_document import create_world_document

_DEFAULT_MAX_POINTS = SceneBudget().max_points


@dataclass(frozen=True)
class Command:
    """What `topoloc view` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file; or an atlas, of which the tiles are shown that share a world, those with most
    nodes."""
    results: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="RESULTS ...", help_behavior_hint=""),
    ] = ()
    """What to show in it: result files of `topoloc localize` and `topoloc evaluate` (JSON),
    trajectories (TUM, KITTI)."""
    out: File = None
    """Write the page to this file (HTML, self-contained) instead of opening it in the browser."""
    screenshot: File = None
    """Write a picture of the page to this file (PNG) instead, by a Chromium or Chrome that is
    installed."""
    tile: TileOption = None
    """Of an atlas: only this tile, in its own world."""
    points: Annotated[
        int, tyro.conf.arg(metavar="N", help_behavior_hint=f"(default: {_DEFAULT_MAX_POINTS})")
    ] = _DEFAULT_MAX_POINTS
    """At most so many of the map's points are shown; with the default a page has some 10 MB at
    most."""

    json: File = None
    """Write the scene itself to this file instead, as the service gives it (JSON; - for standard
    output)."""

    def run(self) -> int:
        check_outputs([self.out, self.screenshot, self.json], inputs=[self.map, *self.results])
        if self.points < 0:
            raise UsageError(f"--points {self.points}: 0 or more are expected")
        if self.screenshot:
            find_browser()
        check_tile_option(self.map, self.tile)
        results = [one for path in self.results for one in read_results(Path(path))]
        budget = SceneBudget(max_points=self.points)
        if is_atlas(self.map):
            atlas = Atlas.open(self.map)
            world = select_world(atlas, self.tile)
            document = create_world_document(
                atlas, world, self.tile or atlas_name(self.map), results, budget, print_warning
            )
            _warn_of_other_worlds(results, document["results"])
        else:
            with TopoMetricMap.load(self.map) as topomap:
                _warn_of_other_maps(results, topomap.id)
                document = create_document(topomap, Path(self.map).stem, results, budget)
        if self.out:
            write_scene_page(Path(self.out), document)
        if self.screenshot:
            self._write_screenshot(document)
        shown = self.out or self.screenshot or self.json or _open_in_browser(document)
        if self.json != "-":
            print(f"{shown}: {_format_summary(document['map'], results)}")
        write_json(self.json, document)
        return 0

    def _write_screenshot(self, document: Mapping[str, Any]) -> None:
        with tempfile.TemporaryDirectory(prefix="topoloc-") as folder:
            page = Path(folder) / "scene.html"
            write_scene_page(page, document)
            write_screenshot(page, Path(str(self.screenshot)))


def _open_in_browser(document: Mapping[str, Any]) -> str:
    """The page, which the browser reads after we have ended: it stays in the system's folder for
    such files."""
    page = Path(tempfile.mkdtemp(prefix="topoloc-")) / "scene.html"
    write_scene_page(page, document)
    if not webbrowser.open(page.as_uri()):
        print(
            "warning: no browser opens here; --out FILE.html writes the page to a place of yours",
            file=sys.stderr,
        )
    return str(page)


def _format_summary(facts: dict[str, Any], results: Sequence[ResultSet]) -> str:
    answers = sum(len(one.answers) for one in results)
    tiles = f"{len(facts['tiles'])} tiles, " if "tiles" in facts else ""
    shown = (
        f"{tiles}{facts['num_nodes']} nodes, {facts['num_points_shown']} of {facts['num_points']}"
        " points"
    )
    return shown + (f", {answers} answers" if answers else "")


def _warn_of_other_worlds(results: Sequence[ResultSet], shown: Sequence[Mapping[str, Any]]) -> None:
    """One line where answers are of tiles that are not shown, or of no tile."""
    given = sum(len(one.answers) for one in results)
    missing = given - sum(one["num_answers"] for one in shown)
    if missing:
        print_warning(f"{missing} of {given} answers are of no tile that is shown, and left out")


def _warn_of_other_maps(results: Sequence[ResultSet], map_id: str) -> None:
    """One line where answers are of another map: they are shown all the same, for two maps may
    share their world."""
    others = {
        str(answer["map"]) for one in results for answer in one.answers if answer.get("map")
    } - {map_id}
    if others:
        print(
            f"warning: some answers are of another map ({', '.join(sorted(others)[:3])}; this is"
            f" {map_id})",
            file=sys.stderr,
        )
