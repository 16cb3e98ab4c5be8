"""A COLMAP database as a recording of single pictures: their names and calibrations, without poses.

It is what COLMAP has before it makes a model: where poses come from elsewhere (``--trajectory``),
no model is needed. Read with SQLite; the tables are those of COLMAP's `database.cc`.
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
_CAMERA_MODELS = (
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
)
"""COLMAP's camera models by their numbers."""
_MAX_PARAMS, _MAX_ROWS = 64, 10_000_000


def can_open(path: Path) -> bool:
    """Whether this is a database, or a folder with one that holds no model."""
    if path.is_dir():
        return (path / _NAME).is_file() and not colmap.can_open(path)
    return path.suffix == ".db" and path.is_file()


def open_colmap_database(path: Path, images: Path | None = None) -> Recording:
    """Open a database.

    Args:
        images: the folder of its pictures; sought as `images` beside the database where None.

    Raises:
        RecordingError: no database of COLMAP, damaged, without pictures, or no folder of them.
        CalibrationError: a camera of a model that is not known here.
    """
    file = path / _NAME if path.is_dir() else path
    root = images or file.parent / "images"
    if not root.is_dir():
        raise RecordingError(
            f"{path}: the pictures of this database are needed, too; name their folder with"
            " --images"
        )
    cameras, camera_id_by_image = _read_database(file)
    if not camera_id_by_image:
        raise RecordingError(f"{file}: no picture in this database")
    names = sorted(
        (parse_relative_path(name, str(file), RecordingError) for name in camera_id_by_image),
        key=natural_key,
    )
    if missing := next((name for name in names if camera_id_by_image[name] not in cameras), None):
        raise RecordingError(f"{file}: damaged, {missing} is of a camera that is missing")
    of_frames = [cameras[camera_id_by_image[name]] for name in names]
    poses: list[Rigid3 | None] = [None] * len(names)
    one, each = (of_frames[0], None) if len(set(of_frames)) == 1 else (None, of_frames)
    return Recording(
        file.resolve().parent.name,
        root,
        names,
        colmap.times_from_names(names),
        poses,
        one,
        cameras=each,
    )


def _read_database(file: Path) -> tuple[dict[int, Camera], dict[str, int]]:
    """The cameras by their numbers, and the number of each picture's camera by the picture's
    name."""
    try:
        with closing(
            sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        ) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            database.text_factory = lambda data: data.decode(errors="replace")
            cameras = database.execute(
                f"SELECT camera_id, model, width, height, params FROM cameras LIMIT {_MAX_ROWS}"
            ).fetchall()
            images = database.execute(
                f"SELECT name, camera_id FROM images LIMIT {_MAX_ROWS}"
            ).fetchall()
    except (
        sqlite3.Error,
        UnicodeDecodeError,
        MemoryError,
    ) as error:  # the second of an error's text, which quotes what is damaged
        raise RecordingError(
            f"{file}: no database of COLMAP, or damaged ({' '.join(str(error).split())[:120]})"
        ) from None
    if not all(isinstance(name, str) and isinstance(number, int) for name, number in images):
        raise RecordingError(f"{file}: damaged, a picture without a name or a camera")
    return {row[0]: _camera(row, file) for row in cameras}, dict(images)


def _camera(row: tuple[Any, ...], file: Path) -> Camera:
    number, model, width, height, params = row
    whole = (
        isinstance(number, int)
        and all(isinstance(value, int) for value in (model, width, height))
        and isinstance(params, bytes)
    )
    if not whole or len(params) % 8 or len(params) > 8 * _MAX_PARAMS:
        raise RecordingError(f"{file}: damaged, a camera that is none")
    name = _CAMERA_MODELS[model] if 0 <= model < len(_CAMERA_MODELS) else f"number {model}"
    try:
        return Camera.from_colmap(
            name, width, height, struct.unpack(f"<{len(params) // 8}d", params)
        )
    except CalibrationError as error:
        raise CalibrationError(f"{file}: camera {number}: {error}") from None


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_colmap_database, ("images",))
