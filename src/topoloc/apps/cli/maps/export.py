"""topoloc export MAP|ATLAS|RESULTS OUT."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from topoloc import Atlas, TopolocError, TopoMetricMap, open_place
from topoloc.apps.cli.output import (
    File,
    UsageError,
    check_outputs,
    option,
    print_warning,
    progress_bar,
    write_json,
)
from topoloc.apps.cli.tile_option import TileOption, select_world
from topoloc.apps.export.formats import FORMATS, ExportFormat, find_export_format, write_scene
from topoloc.apps.viewer.map_scene import create_map_scene
from topoloc.apps.viewer.result_files import create_results_scene
from topoloc.apps.viewer.scene import Scene
from topoloc.apps.viewer.worlds import create_world_scene


@dataclass(frozen=True)
class Command:
    """Options of `topoloc export`."""

    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS|RESULTS")]
    """A map file, an atlas, or results: the JSON lines of `topoloc localize --json`. Of an atlas,
    the tiles of the shared world with most nodes are exported."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT")]
    """The file to write, such as points.ply, map.geojson, map.mcap, walk.tum or walk.kitti. COLMAP
    and nerfstudio need a folder."""
    format: Annotated[
        str | None, option("colmap|nerfstudio|ply|geojson|mcap|tum|kitti", "by OUT's suffix")
    ] = None
    """The format. A folder is written for COLMAP unless this is nerfstudio."""
    session: Annotated[int | None, option("ID", "all")] = None
    """Export only the nodes of this session of a map (`topoloc info --json` lists the sessions)."""
    tile: TileOption = None
    """Export only this tile of an atlas, in its own world."""
    json: File = None
    """Write the counts as JSON to this file (- for standard output)."""

    def run(self) -> int:
        form = find_export_format(Path(self.out), self.format)
        outputs = [self.json] if form.folder is not None else [self.out, self.json]
        check_outputs(outputs, inputs=[self.source])
        if os.path.realpath(self.out) == os.path.realpath(self.source):
            raise UsageError("OUT is the exported path; choose another one")
        if not Path(self.out).absolute().parent.is_dir():
            raise TopolocError(f"cannot write {self.out}: its folder does not exist")
        scene = self._load_scene(form)
        write_scene(scene, Path(self.out), form)
        facts = {
            "out": self.out,
            "num_views": len(scene.views),
            "num_poses": len(scene.trajectory),
            "num_points": len(scene.points.world),
        }
        if self.json != "-":
            points = f", {facts['num_points']} points" if facts["num_points"] else ""
            print(f"{self.out}: {facts['num_views']} pictures with poses{points}")
        write_json(self.json, facts)
        return 0

    def _load_scene(self, form: ExportFormat) -> Scene:
        if _is_results(Path(self.source)):
            if self.session is not None or self.tile is not None:
                raise UsageError(f"--session and --tile select parts of maps, not of {self.source}")
            return create_results_scene(Path(self.source))
        place = open_place(self.source)
        place.select_tiles(self.tile)  # refuses a tile that does not exist

        def load_map(path: str) -> Scene:
            with TopoMetricMap.load(path) as topomap, progress_bar() as progress:
                if form is FORMATS["mcap"]:
                    topomap.require_scale("MCAP")
                return create_map_scene(
                    topomap, place.name, self.session, form.with_points, progress
                )

        def load_tiles(atlas: Atlas) -> Scene:
            if self.session is not None:
                raise UsageError("--session selects a session of one map file, not of an atlas")
            world, name = select_world(atlas, self.tile), self.tile or place.name
            with progress_bar() as progress:
                return create_world_scene(
                    atlas, world, name, form.with_points, progress, print_warning
                )

        return place.visit(load_map, load_tiles)


def _is_results(path: Path) -> bool:
    """Return whether a path is a readable file that is no map, by its first bytes."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return file.read(16) != b"SQLite format 3\0"
    except (OSError, ValueError):
        return False
