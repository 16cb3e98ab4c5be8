"""A COLMAP database as a recording of single images with calibrations, without poses.

COLMAP writes it before a model. With poses of another source (``--trajectory``) it is sufficient.
The SQLite tables are those of COLMAP's `database.cc`.
"""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from typing import Any

from topoloc import CalibrationError, Camera, RecordingError, Rigid3
from topoloc.apps.formats import colmap
from topoloc.plugin import Recording, RecordingFormat, natural_key, parse_relative_path

EXPECTED_FILES = "database.db of COLMAP"
_NAME = "database.db"
_CAMERA_MODELS = [
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
]
"""COLMAP's camera models by their numbers."""
_MAX_PARAMS, _MAX_ROWS = 64, 10_000_000


def can_open(path: Path) -> bool:
    """Return whether this is a database, or a folder with a database and no model."""
    if path.is_dir():
        return (path / _NAME).is_file() and not colmap.can_open(path)
    return path.suffix == ".db" and path.is_file()


def open_colmap_database(path: Path, images: Path | None = None) -> Recording:
    """Open a database. Raises RecordingError: the file is no database of COLMAP or damaged, or the
    images are missing; CalibrationError: a camera model is unknown.

    Args:
        images: folder of the images. Default: `images` beside the database.
    """
    file = path / _NAME if path.is_dir() else path
    root = images or file.parent / "images"
    if not root.is_dir():
        fault = "the images of this database are missing; use --images FOLDER"
        raise RecordingError(f"{path}: {fault}")
    rows, camera_id_by_image = _read_database(file)
    if not camera_id_by_image:
        raise RecordingError(f"{file}: no image in this database")
    names = sorted(
        (parse_relative_path(name, str(file), RecordingError) for name in camera_id_by_image),
        key=natural_key,
    )
    if missing := next((name for name in names if camera_id_by_image[name] not in rows), None):
        raise RecordingError(f"{file}: damaged, the camera of {missing} is missing")
    used = {camera_id_by_image[name] for name in names}
    cameras = {number: _camera(rows[number], file) for number in used}
    of_frames = [cameras[camera_id_by_image[name]] for name in names]
    poses: list[Rigid3 | None] = [None] * len(names)
    name, t_ns = file.resolve().parent.name, colmap.times_from_names(names)
    return Recording.with_cameras(name, root, names, t_ns, poses, of_frames, as_stored=True)


def _read_database(file: Path) -> tuple[dict[int, tuple[Any, ...]], dict[str, int]]:
    """Return the rows of cameras by number, and the camera number of each image by its name."""
    try:
        uri = f"{file.resolve().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            database.text_factory = lambda data: data.decode(errors="replace")
            columns = "camera_id, model, width, height, params"
            select = f"SELECT {columns} FROM cameras LIMIT {_MAX_ROWS}"
            cameras = database.execute(select).fetchall()
            select = f"SELECT name, camera_id FROM images LIMIT {_MAX_ROWS}"
            images = database.execute(select).fetchall()
    # UnicodeDecodeError: the message of an error may quote damaged data
    except (sqlite3.Error, UnicodeDecodeError, MemoryError) as error:
        reason = " ".join(str(error).split())[:120]
        raise RecordingError(f"{file}: no database of COLMAP, or damaged ({reason})") from None
    if not all(isinstance(name, str) and isinstance(number, int) for name, number in images):
        raise RecordingError(f"{file}: damaged, an image without a name or a camera")
    return {row[0]: row for row in cameras}, dict(images)


def _camera(row: tuple[Any, ...], file: Path) -> Camera:
    number, model, width, height, params = row
    are_ints = all(isinstance(value, int) for value in (number, model, width, height))
    is_valid = are_ints and isinstance(params, bytes)
    if not is_valid or len(params) % 8 or len(params) > 8 * _MAX_PARAMS:
        raise RecordingError(f"{file}: damaged, an invalid camera")
    name = _CAMERA_MODELS[model] if 0 <= model < len(_CAMERA_MODELS) else f"number {model}"
    numbers = struct.unpack(f"<{len(params) // 8}d", params)
    with CalibrationError.at(f"{file}: camera {number}"):
        return Camera.from_colmap(name, width, height, numbers)


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_colmap_database, ("images",))
