"""nerfstudio's ``transforms.json``, written by its tools, Polycam's export and many phone programs.

``transform_matrix`` is world_from_cam with OpenGL's camera axes (y up, z back), in metres if the
program knows them; `applied_scale` is removed. `fl_x fl_y cx cy w h` and the distortion of OpenCV
stand in the file or in each frame. As in COLMAP the centre of the top-left pixel is (0.5, 0.5).
Depth is along z, with the view of the image, in units of `depth_unit_scale_factor` metres (default
0.001, as in nerfstudio). NeRFCapture writes `depth_path` and `integer_depth_scale` (metres). Frames
are in the order of their names and have no times: 10 a second.
"""

from __future__ import annotations

import os
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from topoloc import CalibrationError, Camera, PoseConventions, RecordingError, Rigid3
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

FILE_NAME = "transforms.json"
EXPECTED_FILES = "transforms.json of nerfstudio"
DEPTH_UNIT = 0.001
"""Metres: nerfstudio's default of `depth_unit_scale_factor`."""


def can_open(path: Path) -> bool:
    """Return whether this is a transforms.json, or a folder with one."""
    return path.name == FILE_NAME if path.is_file() else (path / FILE_NAME).is_file()


def open_nerfstudio(path: Path) -> Recording:
    """Open a folder with a transforms.json, or the file itself. Frames with depth are RGB-D. Raises
    RecordingError: there are no frames, only some have depth, the file is malformed, a matrix is no
    pose, or a name leads out of the folder; CalibrationError: a key of the camera is missing or
    invalid, or its model is unknown."""
    file = path if path.is_file() else path / FILE_NAME
    data = decode_json(read_text(file, RecordingError), dict[str, Any], RecordingError, str(file))
    whole = decode_json(data, _File, RecordingError, str(file))
    read = [
        decode_json(frame, _Frame, RecordingError, f"{file}, frame {k}")
        for k, frame in enumerate(whole.frames)
    ]
    named = [
        (parse_relative_path(frame.file_path, f"{file}, frame {k}", RecordingError), frame, lens)
        for k, (frame, lens) in enumerate(zip(read, whole.frames, strict=True))
    ]
    named.sort(key=lambda pair: natural_key(pair[0]))
    names = [_with_suffix(file.parent, name) for name, _, _ in named]
    where, frames = [f"{file}, {name}" for name in names], [frame for _, frame, _ in named]
    poses: list[Rigid3 | None] = [_pose(frame, whole.applied_scale) for frame in frames]
    # Keys of the file take precedence, as in nerfstudio.
    cameras = [_camera(lens | data, at) for (_, _, lens), at in zip(named, where, strict=True)]
    depth = _depth(frames, whole.integer_depth_scale or whole.depth_unit_scale_factor, file, where)
    name, t_ns = file.parent.resolve().name, times_from_rate(len(names))
    return Recording.with_cameras(name, file.parent, names, t_ns, poses, cameras, depth=depth)


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


def _pose(frame: _Frame, scale: float) -> Rigid3:
    world_from_gl = frame.transform_matrix
    metric = Rigid3(world_from_gl.rotation, world_from_gl.translation / scale)
    return PoseConventions(("opengl",)).undo_conventions(metric)


def _camera(data: dict[str, Any], where: str) -> Camera:
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


def _with_suffix(folder: Path, name: str) -> str:
    """Add the suffix .png, which Blender's scenes omit."""
    return name if PurePath(name).suffix or os.path.exists(folder / name) else f"{name}.png"


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_nerfstudio)
