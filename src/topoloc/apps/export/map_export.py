"""A map file written in a format of another program."""

from __future__ import annotations

from pathlib import Path

from topoloc import TopoMetricMap
from topoloc.apps.export.formats import find_export_format, write_scene
from topoloc.apps.viewer.map_scene import create_map_scene


def export(path: str | Path, out: str | Path, format: str | None = None) -> None:
    """Write a map file in a format of another program, at once or not at all.

    Args:
        path: the map file.
        out: the file to write, or for COLMAP and nerfstudio the folder.
        format: colmap, nerfstudio, ply, geojson, mcap, tum or kitti; by default from the suffix of
            `out`, and COLMAP for a folder.

    Raises:
        TopolocError: the format is unknown, the map lacks what it needs, or `out` cannot be
            written.
        MapError: the map cannot be read.
    """
    form = find_export_format(Path(out), format)
    with TopoMetricMap.load(path) as topomap:
        scene = create_map_scene(topomap, Path(path).stem, None, form.with_points)
        write_scene(scene, Path(out), form)
