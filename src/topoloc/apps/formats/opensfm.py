"""``reconstruction.json`` of OpenSfM, also inside WebODM's projects, as a recording of single
images with poses.

A shot's rotation vector and translation are cam_from_world. Focal lengths and centres are fractions
of the longer side of the image, from its middle. As in OpenSfM cameras belong to images as stored,
whatever their EXIF orientation. Of several reconstructions the one with most shots is read. Only
with GNSS positions of the images its unit is the metre.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from topoloc import CalibrationError, Camera, RecordingError, Rigid3, TrajectoryError
from topoloc.apps.formats.colmap import times_from_names
from topoloc.plugin import (
    Finite,
    Recording,
    RecordingFormat,
    decode_json,
    natural_key,
    parse_relative_path,
    read_text,
)

EXPECTED_FILES = "reconstruction.json of OpenSfM"
_NAME = "reconstruction.json"
_NO_GNSS_DOP = 999999.0  # what OpenSfM writes for an image without a position


def can_open(path: Path) -> bool:
    """Return whether this is a reconstruction.json, or a folder with one."""
    return _find_file(path).is_file()


def _find_file(path: Path) -> Path:
    """Return the file itself, that of a folder, or that of a project of OpenDroneMap."""
    if path.is_file():
        return path if path.name == _NAME else path / _NAME
    in_project = path / "opensfm" / _NAME
    return in_project if in_project.is_file() else path / _NAME


def open_opensfm(path: Path, images: Path | None = None) -> Recording:
    """Open a reconstruction. Raises RecordingError: the file is malformed or has no shot, a name
    leads out of the folder, or the images are missing; CalibrationError: a camera is missing or of
    an unknown model; TrajectoryError: a shot has no usable pose.

    Args:
        images: folder of the images. Default: `images` beside the file or above it.
    """
    file = _find_file(path)
    text = read_text(file, RecordingError)
    models = decode_json(text, list[_Reconstruction], RecordingError, str(file))
    largest = max(models, key=lambda model: len(model.shots), default=None)
    if largest is None or not largest.shots:
        raise RecordingError(f"{file}: no picture of this reconstruction has a pose")
    shots = sorted(largest.shots.items(), key=lambda named: natural_key(named[0]))
    names = [parse_relative_path(name, str(file), RecordingError) for name, _ in shots]
    above = file.resolve().parent
    folders = [above / "images", above.parent / "images"]
    root = images or next((folder for folder in folders if folder.is_dir()), None)
    if root is None or not root.is_dir():
        raise RecordingError(f"{file}: the images of this model are missing; use --images FOLDER")
    cameras = {
        name: _camera(data, f"{file}, camera {name[:80]}") for name, data in largest.cameras.items()
    }
    if unknown := {shot.camera for _, shot in shots} - cameras.keys():
        raise CalibrationError(f"{file}: no camera {min(unknown)[:80]!r}, which a shot names")
    poses = [_world_from_cam(shot, f"{file}, {name}") for name, shot in shots]
    of_shots = [cameras[shot.camera] for _, shot in shots]
    is_metric = any(0.0 < shot.gps_dop < _NO_GNSS_DOP for _, shot in shots)
    frames = names, times_from_names(names), poses, of_shots
    recording = Recording.with_cameras(
        file.resolve().parent.name, root, *frames, has_scale=is_metric, as_stored=True
    )
    if len(models) == 1:
        return recording
    note = f"{file}: the largest of {len(models)} reconstructions, {len(shots)} pictures, is read"
    return replace(recording, notes=(note,))


class _Shot(Struct, frozen=True):
    rotation: tuple[Finite, Finite, Finite]
    camera: str
    translation: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    gps_dop: Finite = _NO_GNSS_DOP


class _Reconstruction(Struct, frozen=True):
    cameras: dict[str, dict[str, Any]]
    shots: dict[str, _Shot]


class _Lens(Struct, frozen=True):
    width: Annotated[int, Meta(ge=1)]
    height: Annotated[int, Meta(ge=1)]
    projection_type: str = "perspective"
    focal: Finite | None = None
    focal_x: Finite | None = None
    focal_y: Finite | None = None
    c_x: Finite = 0.0
    c_y: Finite = 0.0
    k1: Finite = 0.0
    k2: Finite = 0.0
    k3: Finite = 0.0
    k4: Finite = 0.0
    p1: Finite = 0.0
    p2: Finite = 0.0


def _camera(data: dict[str, Any], where: str) -> Camera:
    lens = decode_json(data, _Lens, CalibrationError, where)
    side, focal = float(max(lens.width, lens.height)), lens.focal_x or lens.focal
    if focal is None:
        raise CalibrationError(f"{where}: neither focal nor focal_x")
    params = (
        side * focal,
        side * (lens.focal_y or focal),
        0.5 * lens.width + side * lens.c_x,
        0.5 * lens.height + side * lens.c_y,
        lens.k1,
        lens.k2,
    )
    brown = (lens.p1, lens.p2, lens.k3, 0.0, 0.0, 0.0)
    models = {
        **dict.fromkeys(("perspective", "simple_radial", "radial"), ("OPENCV", (0.0, 0.0))),
        "brown": ("FULL_OPENCV", brown) if lens.k3 else ("OPENCV", brown[:2]),
        "fisheye": ("OPENCV_FISHEYE", (0.0, 0.0)),
        "fisheye_opencv": ("OPENCV_FISHEYE", (lens.k3, lens.k4)),
    }
    if lens.projection_type not in models:
        raise CalibrationError(
            f"{where}: images of the model {lens.projection_type[:40]} are not read; there are"
            f" {', '.join(models)}"
        )
    model, others = models[lens.projection_type]
    with CalibrationError.at(where):
        return Camera.from_colmap(model, lens.width, lens.height, (*params, *others))


def _world_from_cam(shot: _Shot, where: str) -> Rigid3 | None:
    with TrajectoryError.at(where):
        turn = Rigid3.exp(np.array([0.0, 0.0, 0.0, *shot.rotation])).rotation
        matrix = np.vstack([np.column_stack([turn, shot.translation]), [0.0, 0.0, 0.0, 1.0]])
        return Rigid3.from_matrix(matrix).inverse()


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_opensfm, ("images",))
