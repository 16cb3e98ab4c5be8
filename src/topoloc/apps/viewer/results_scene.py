"""A file of results (JSON lines of `topoloc localize --json`) as a scene: the pictures that were
localized are the views."""

from __future__ import annotations

from pathlib import Path

from topoloc import Localization, ResultError
from topoloc.apps.viewer.result_files import parse_result
from topoloc.apps.viewer.scene import Points, Scene, View
from topoloc.plugin import read_text


def create_results_scene(path: Path) -> Scene:
    """Pictures without a pose are left out.

    Raises:
        ResultError: the file is missing, a line is no result, or none has a pose; names the line.
    """
    views = list[View]()
    lines = [
        (number, line)
        for number, line in enumerate(read_text(path, ResultError).splitlines(), 1)
        if line.strip()
    ]
    for number, line in lines:
        try:
            result, extras = parse_result(line)
            query = extras.query
        except ResultError as error:
            raise ResultError(f"{path}, line {number}: {error}") from None
        if isinstance(result, Localization):
            t_ns, camera = result.provenance.t_ns, result.provenance.camera
            views.append(View(query, result.world_from_cam, t_ns, camera, geopose=result.geopose))
    if not views:
        raise ResultError(f"{path}: none of {len(lines)} results has a pose")
    return Scene(path.stem, views, Points.none(), [view.world_from_cam for view in views])
