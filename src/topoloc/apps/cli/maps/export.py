"""topoloc export MAP|ATLAS|RESULTS OUT."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from topoloc import Atlas, TopolocError, TopoMetricMap, is_atlas
from topoloc.apps.cli.output import File, UsageError, check_outputs, progress_bar, write_json
from topoloc.apps.cli.tile_option import (
    TileOption,
    atlas_name,
    check_tile_option,
    print_warning,
    select_world,
)
from topoloc.apps.export.formats import ExportFormat, find_export_format, write_scene
from topoloc.apps.viewer.map_scene import create_map_scene, create_world_scene
from topoloc.apps.viewer.result_files import create_results_scene
from topoloc.apps.viewer.scene import Scene


@dataclass(frozen=True)
class Command:
    """What `topoloc export` takes."""

    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS|RESULTS")]
    """A map file; an atlas, of which the tiles are exported that share a world, those with most
    nodes; or results: the JSON lines of `topoloc localize --json`."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT")]
    """What is written: a file such as points.ply, map.geojson, map.mcap, walk.tum, walk.kitti, or
    for COLMAP and nerfstudio a folder."""
    format: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="colmap|nerfstudio|ply|geojson|mcap|tum|kitti",
            help_behavior_hint="(default: by OUT's suffix)",
        ),
    ] = None
    """The format; a folder is COLMAP's unless this says nerfstudio."""
    session: Annotated[
        int | None, tyro.conf.arg(metavar="ID", help_behavior_hint="(default: all)")
    ] = None
    """Of a map, only the nodes of this session (`topoloc info --json` names them)."""
    tile: TileOption = None
    """Of an atlas: only this tile, in its own world."""
    json: File = None
    """Write what is printed as JSON to this file (- for standard output)."""

    def run(self) -> int:
        form = find_export_format(Path(self.out), self.format)
        outputs = [self.json] if form.folder is not None else [self.out, self.json]
        check_outputs(outputs, inputs=[self.source])
        check_tile_option(self.source, self.tile)
        if (
            Path(self.source).exists()
            and not Path(self.source).is_file()
            and not is_atlas(self.source)
        ):
            raise TopolocError(
                f"{self.source} is no file and no atlas: a map, an atlas or results are exported"
            )
        if Path(self.out).resolve() == Path(self.source).resolve():
            raise UsageError("OUT is what is to be exported")
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
        if is_atlas(self.source):
            return self._load_tiles_scene(form)
        if not _is_map(Path(self.source)):
            if self.session is not None:
                raise UsageError("--session is of maps, and this is none")
            return create_results_scene(Path(self.source))
        with TopoMetricMap.load(self.source) as topomap, progress_bar() as progress:
            return create_map_scene(
                topomap, Path(self.source).stem, self.session, form.with_points, progress
            )

    def _load_tiles_scene(self, form: ExportFormat) -> Scene:
        if self.session is not None:
            raise UsageError(
                "--session is of maps: the tiles of an atlas have sessions of their own"
            )
        atlas = Atlas.open(self.source)
        world, name = select_world(atlas, self.tile), self.tile or atlas_name(self.source)
        with progress_bar() as progress:
            return create_world_scene(atlas, world, name, form.with_points, progress, print_warning)


def _is_map(path: Path) -> bool:
    """By the first bytes, or where these cannot be read, by the name: opening it then says what is
    wrong."""
    try:
        with path.open("rb") as file:
            return file.read(16) == b"SQLite format 3\0"
    except (OSError, ValueError):
        return path.suffix == ".topo"
