"""topoloc view MAP|ATLAS [RESULTS ...]."""

from __future__ import annotations

import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from topoloc import Atlas, TopoMetricMap, open_place
from topoloc.apps.cli.output import (
    File,
    UsageError,
    check_outputs,
    option,
    print_warning,
    write_json,
)
from topoloc.apps.cli.tile_option import TileOption, select_world
from topoloc.apps.viewer.document import ResultSet, SceneBudget, create_document
from topoloc.apps.viewer.page import find_browser, write_scene_page, write_screenshot
from topoloc.apps.viewer.result_files import read_results
from topoloc.apps.viewer.worlds import create_world_document

_DEFAULT_MAX_POINTS = SceneBudget().max_points


@dataclass(frozen=True)
class Command:
    """Options of `topoloc view`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """The map file or an atlas. Of an atlas, the tiles of the shared world with most nodes are
    shown."""
    results: Annotated[tyro.conf.Positional[tuple[str, ...]], option("RESULTS ...")] = ()
    """Files to show in it: results of `topoloc localize` and `topoloc evaluate` (JSON),
    trajectories (TUM, KITTI)."""
    out: File = None
    """Write the page to this file (HTML, self-contained) instead of opening it in the browser."""
    screenshot: File = None
    """Write an image of the page to this file (PNG) instead. It needs an installed Chromium or
    Chrome."""
    tile: TileOption = None
    """Show only this tile of an atlas, in its own world."""
    points: Annotated[
        int, tyro.conf.arg(metavar="N", help_behavior_hint=f"(default: {_DEFAULT_MAX_POINTS})")
    ] = _DEFAULT_MAX_POINTS
    """The maximum number of points shown. With the default a page has at most about 10 MB."""

    json: File = None
    """Write the scene of the page to this file instead (JSON; - for standard output)."""

    def run(self) -> int:
        check_outputs([self.out, self.screenshot, self.json], inputs=[self.map, *self.results])
        if self.points < 0:
            raise UsageError(f"--points {self.points}: use 0 or more")
        if self.screenshot:
            find_browser()
        place = open_place(self.map)
        place.select_tiles(self.tile)  # refuses a tile that does not exist
        results = [one for path in self.results for one in read_results(Path(path))]
        budget = SceneBudget(max_points=self.points)

        def show_map(path: str) -> dict[str, Any]:
            with TopoMetricMap.load(path) as topomap:
                _warn_of_other_maps(results, topomap.id)
                return create_document(topomap, place.name, results, budget)

        def show_tiles(atlas: Atlas) -> dict[str, Any]:
            world, name = select_world(atlas, self.tile), self.tile or place.name
            shown = create_world_document(atlas, world, name, results, budget, print_warning)
            _warn_of_other_worlds(results, shown["results"])
            return shown

        document = place.visit(show_map, show_tiles)
        if self.out:
            write_scene_page(Path(self.out), document)
        if self.screenshot:
            with tempfile.TemporaryDirectory(prefix="topoloc-") as folder:
                page = Path(folder) / "scene.html"
                write_scene_page(page, document)
                write_screenshot(page, Path(self.screenshot))
        shown = self.out or self.screenshot or self.json or _open_in_browser(document)
        if self.json != "-":
            print(f"{shown}: {_format_summary(document['map'], results)}")
        write_json(self.json, document)
        return 0


def _open_in_browser(document: Mapping[str, Any]) -> str:
    """Open the page in the browser and return its path. The file stays in the system's temporary
    folder, because the browser reads it after this process has ended."""
    page = Path(tempfile.mkdtemp(prefix="topoloc-")) / "scene.html"
    write_scene_page(page, document)
    if not webbrowser.open(page.as_uri()):
        print_warning("no browser can be opened; --out FILE.html writes the page to a file")
    return str(page)


def _format_summary(facts: dict[str, Any], results: Sequence[ResultSet]) -> str:
    answers = sum(len(one.answers) for one in results)
    tiles = f"{len(facts['tiles'])} tiles, " if "tiles" in facts else ""
    points = f"{facts['num_points_shown']} of {facts['num_points']} points"
    return f"{tiles}{facts['num_nodes']} nodes, {points}" + (f", {answers} answers" * bool(answers))


def _warn_of_other_worlds(results: Sequence[ResultSet], shown: Sequence[Mapping[str, Any]]) -> None:
    """Print a warning if results belong to tiles that are not shown, or to no tile."""
    given = sum(len(one.answers) for one in results)
    missing = given - sum(one["num_answers"] for one in shown)
    if missing:
        print_warning(f"{missing} of {given} answers are of no tile that is shown, and left out")


def _warn_of_other_maps(results: Sequence[ResultSet], map_id: str) -> None:
    """Print a warning if results belong to another map. They are shown, because two maps may share
    a world."""
    others = {
        str(answer["map"]) for one in results for answer in one.answers if answer.get("map")
    } - {map_id}
    if others:
        print_warning(
            f"some answers are of another map ({', '.join(sorted(others)[:3])}; this is {map_id})"
        )
