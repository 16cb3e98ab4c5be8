"""The forms in which maps and results leave for other programs, and how each is written."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from topoloc import TopolocError
from topoloc.apps.export.colmap import to_colmap_model
from topoloc.apps.export.foxglove import to_mcap
from topoloc.apps.export.nerfstudio import to_nerfstudio
from topoloc.apps.export.text_formats import to_geojson, to_kitti, to_ply, to_tum
from topoloc.apps.viewer.scene import Scene
from topoloc.plugin import write_bytes, write_folder


@dataclass(frozen=True)
class ExportFormat:
    """Either of one file or of a folder. `with_points`: does it take a map's points?"""

    file: Callable[[Scene], bytes] | None = None
    folder: Callable[[Scene], Mapping[str, bytes]] | None = None
    with_points: bool = True


FORMATS = {
    "colmap": ExportFormat(folder=to_colmap_model),
    "nerfstudio": ExportFormat(folder=to_nerfstudio),
    "ply": ExportFormat(to_ply),
    "geojson": ExportFormat(to_geojson, with_points=False),
    "mcap": ExportFormat(to_mcap),
    "tum": ExportFormat(to_tum, with_points=False),
    "kitti": ExportFormat(to_kitti, with_points=False),
}


def find_export_format(out: Path, named: str | None = None) -> ExportFormat:
    """The format that is named, or else by the suffix of `out`; a name without one is the folder of
    a COLMAP model.

    Raises:
        TopolocError: there is no such format, or the suffix says none.
    """
    name = named or out.suffix.lower().removeprefix(".") or "colmap"
    if named is None and out.is_dir():
        name = "colmap"
    if name not in FORMATS:
        raise TopolocError(
            f"{out if named is None else named}: no format of ours; --format takes"
            f" {', '.join(FORMATS)}"
        )
    return FORMATS[name]


def write_scene(scene: Scene, out: Path, form: ExportFormat) -> None:
    """Write the file or the folder at once or not at all.

    Raises:
        TopolocError: it cannot be written, or the scene lacks what the format needs.
    """
    if form.file is not None:
        write_bytes(out, form.file(scene))
    elif form.folder is not None:
        write_folder(out, form.folder(scene))
