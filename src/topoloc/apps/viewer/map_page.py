"""A page that shows a map file, and the results of queries in it, in 3-D."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from topoloc import TopoMetricMap
from topoloc.apps.viewer.document import create_document
from topoloc.apps.viewer.page import write_scene_page
from topoloc.apps.viewer.result_files import read_results


def view(path: str | Path, out: str | Path, results: Sequence[str | Path] = ()) -> None:
    """Write a self-contained HTML page that shows a map in 3-D.

    Args:
        path: the map file.
        out: the page to write.
        results: result files of `topoloc localize` or `topoloc evaluate` (JSON), and trajectories
            (TUM, KITTI), that are shown in the map.

    Raises:
        MapError: the map cannot be read.
        TopolocError: a result file cannot be read, or the page cannot be written.
    """
    shown = [one for file in results for one in read_results(Path(file))]
    with TopoMetricMap.load(path) as topomap:
        write_scene_page(Path(out), create_document(topomap, Path(path).stem, shown))
