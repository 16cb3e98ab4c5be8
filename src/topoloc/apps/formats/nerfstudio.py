"""nerfstudio's ``transforms.json``, written by its tools, Polycam's export and many phone programs.

``transform_matrix`` is world_from_cam with OpenGL's camera axes (y up, z back), in metres if the
program knows them; `applied_scale` is removed. `fl_x fl_y cx cy w h` and the distortion of OpenCV
stand in the file or in each frame. As in COLMAP the centre of the top-left pixel is (0.5, 0.5).
Files of Blender have `camera_angle_x` (radians) instead: the focal length, with the centre and the
size of the images. Their names are `transforms_train.json` and the like.
Depth is along z, with the view of the image, in units of `depth_unit_scale_factor` metres (default
0.001, as in nerfstudio). NeRFCapture writes `depth_path` and `integer_depth_scale` (metres). Frames
are in the order of their names and have no times: 10 a second.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from topoloc import (
    CalibrationError,
    Camera,
    PoseConventions,
    RecordingError,
    Rigid3,
    StereoSequence,
)
from topoloc.apps.core_names import (
    CalibrationForSize,
    find_path,
    first_image_size,
    with_calibration,
)
from topoloc.plugin import (
    DepthImages,
    Finite,
    Recording,
    RecordingFormat,
    decode_json,
    natural_key,
    parse_relative_path,
    read_text,
    times_from_rate,
)

_FILE_NAMES = "transforms.json", "transforms_train.json"
_SUFFIXES = "", ".png", ".jpg", ".jpeg"
EXPECTED_FILES = "transforms.json of nerfstudio"
DEPTH_UNIT = 0.001
"""Metres: nerfstudio's default of `depth_unit_scale_factor`."""


def can_open(path: Path) -> bool:
    """Return whether this is a transforms.json, or a folder with one."""
    if path.is_file():
        return path.name.startswith("transforms") and path.suffix == ".json"
    return _find_file(path).is_file()


def _find_file(path: Path) -> Path:
    files = [path / name for name in _FILE_NAMES]
    return path if path.is_file() else next((file for file in files if file.is_file()), files[0])


def open_nerfstudio(path: Path, calibration: CalibrationForSize | None = None) -> StereoSequence:
    """Open a folder with a transforms.json, or the file itself. Frames with depth are RGB-D.
    `calibration` replaces that of the file. Raises RecordingError: there are no frames, only some
    have depth, the file is malformed, a matrix is no pose, or a name leads out of the folder;
    CalibrationError: a key of the camera is missing or invalid, or its model is unknown."""
    file = _find_file(path)
    data = decode_json(read_text(file, RecordingError), dict[str, Any], RecordingError, str(file))
    whole = decode_json(data, _File, RecordingError, str(file))
    read = [
        decode_json(frame, _Frame, RecordingError, f"{file}, frame {k}")
        for k, frame in enumerate(whole.frames)
    ]
    named = [
        (_find_image(file.parent, frame.file_path, f"{file}, frame {k}"), frame, lens)
        for k, (frame, lens) in enumerate(zip(read, whole.frames, strict=True))
    ]
    named.sort(key=lambda pair: natural_key(pair[0]))
    names = [name for name, _, _ in named]
    where, frames = [f"{file}, {name}" for name in names], [frame for _, frame, _ in named]
    poses: list[Rigid3 | None] = [_pose(frame, whole.applied_scale) for frame in frames]
    depth = _depth(frames, whole.integer_depth_scale or whole.depth_unit_scale_factor, file, where)
    place = file.parent.resolve().name, file.parent, names, times_from_rate(len(names)), poses
    notes = _describe_moved(file, [frame.file_path for frame in frames], names)
    if calibration is not None:
        return with_calibration(Recording(*place, None, depth=depth, notes=notes), calibration)
    size = cache(lambda: first_image_size([file.parent / name for name in names]))
    # Keys of the file take precedence, as in nerfstudio.
    cameras = [
        _camera(_with_defaults(lens | data, size, at), at)
        for (_, _, lens), at in zip(named, where, strict=True)
    ]
    return replace(Recording.with_cameras(*place, cameras, depth=depth), notes=notes)


_Factor = Annotated[float, Meta(gt=1e-12, lt=1e12)]


class _Frame(Struct, frozen=True):
    file_path: str
    transform_matrix: Rigid3
    depth_file_path: str | None = None
    depth_path: str | None = None


class _File(Struct, frozen=True):
    frames: Annotated[list[dict[str, Any]], Meta(min_length=1)]
    applied_scale: _Factor = 1.0
    depth_unit_scale_factor: _Factor = DEPTH_UNIT
    integer_depth_scale: _Factor | None = None


class _Lens(Struct, frozen=True):
    w: Finite
    h: Finite
    fl_x: Finite
    cx: Finite
    cy: Finite
    fl_y: Finite | None = None
    k1: Finite = 0.0
    k2: Finite = 0.0
    k3: Finite = 0.0
    k4: Finite = 0.0
    p1: Finite = 0.0
    p2: Finite = 0.0
    camera_model: Literal[
        "OPENCV",
        "PINHOLE",
        "SIMPLE_PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "FULL_OPENCV",
        "perspective",
        "OPENCV_FISHEYE",
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
        "fisheye",
    ] = "OPENCV"


_Angle = Annotated[float, Meta(gt=0, lt=math.pi)] | None


class _View(Struct, frozen=True):
    w: Finite | None = None
    h: Finite | None = None
    camera_angle_x: _Angle = None
    camera_angle_y: _Angle = None


def _with_defaults(
    data: dict[str, Any], size: Callable[[], tuple[int, int]], where: str
) -> dict[str, Any]:
    """Return the keys of a camera with those that the file leaves out: the size of the images, and
    the focal length of a viewing angle, with the centre, as in Blender and instant-ngp."""
    view = decode_json(data, _View, CalibrationError, where)
    w, h = (view.w, view.h) if view.w and view.h else size()
    given = {"w": w, "h": h} | data
    angles = {"fl_x": (w, view.camera_angle_x), "fl_y": (h, view.camera_angle_y)}
    focal = {
        key: 0.5 * side / math.tan(0.5 * angle) for key, (side, angle) in angles.items() if angle
    }
    if "fl_x" in data or not focal:
        return given
    return {"cx": 0.5 * w, "cy": 0.5 * h, "fl_x": focal.get("fl_y")} | focal | given


def _pose(frame: _Frame, scale: float) -> Rigid3:
    world_from_gl = frame.transform_matrix
    metric = Rigid3(world_from_gl.rotation, world_from_gl.translation / scale)
    return PoseConventions(("opengl",)).undo_conventions(metric)


def _camera(data: dict[str, Any], where: str) -> Camera:
    if "fl_x" not in data:
        raise CalibrationError(f"{where}: neither fl_x nor camera_angle_x; give --camera")
    lens = decode_json(data, _Lens, CalibrationError, where)
    w, h, k1, k2, k3, k4 = int(lens.w), int(lens.h), lens.k1, lens.k2, lens.k3, lens.k4
    p1, p2, fl_y = lens.p1, lens.p2, lens.fl_x if lens.fl_y is None else lens.fl_y
    params = (lens.fl_x, fl_y, lens.cx, lens.cy)
    with CalibrationError.at(where):
        if lens.camera_model.lower().endswith("fisheye"):
            return Camera.from_colmap("OPENCV_FISHEYE", w, h, (*params, k1, k2, k3, k4))
        if k4 != 0.0:  # OpenCV's model has no fourth radial coefficient, its k4 is a divisor
            raise CalibrationError("a fourth radial coefficient is not supported")
        if k3 != 0.0:
            full = (*params, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
            return Camera.from_colmap("FULL_OPENCV", w, h, full)
        if (k1, k2, p1, p2) == (0.0, 0.0, 0.0, 0.0):
            return Camera.from_colmap("PINHOLE", w, h, params)
        return Camera.from_colmap("OPENCV", w, h, (*params, k1, k2, p1, p2))


def _depth(frames: list[_Frame], unit: float, file: Path, where: list[str]) -> DepthImages | None:
    found = [frame.depth_file_path or frame.depth_path for frame in frames]
    names = [name for name in found if name is not None]
    if not names:
        return None
    if len(names) != len(frames):
        raise RecordingError(
            f"{file}: only {len(names)} of {len(frames)} frames have a depth_file_path"
        )
    paths = [
        file.parent / parse_relative_path(name, f"{at}: depth_file_path", RecordingError)
        for name, at in zip(names, where, strict=True)
    ]
    return DepthImages(paths, 1.0 / unit, None, Rigid3.identity())


def _find_image(folder: Path, given: str, where: str) -> str:
    """Return the path of an image below the folder, with the suffix of the file, which Blender's
    scenes omit. Of a path that begins in another folder the longest end that exists counts."""
    parts = [part for part in re.split(r"[\\/]+", given) if part not in ("", ".", "..")]
    for start, suffix in product(range(0 if "\0" in given else len(parts)), _SUFFIXES):
        end = "/".join(parts[start:])
        if os.path.exists(find_path(folder / f"{end}{suffix}")):
            return f"{end}{suffix}"
    name = parse_relative_path(given, where, RecordingError)
    return name if PurePath(name).suffix else f"{name}.png"


def _describe_moved(file: Path, given: list[str], names: list[str]) -> tuple[str, ...]:
    """Return a note if images are not where the file says."""
    moved = [
        (said, name)
        for said, name in zip(given, names, strict=True)
        if len(PurePath(said.replace("\\", "/")).parts) > len(PurePath(name).parts)
    ]
    if not moved:
        return ()
    said, name = moved[0]
    return (f"{file}: {len(moved)} images are elsewhere: {name}, not {said[:120]!r}",)


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_nerfstudio, ("calibration",))
