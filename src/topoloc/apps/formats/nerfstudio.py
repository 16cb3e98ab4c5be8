"""nerfstudio's ``transforms.json``, as its own tools, Polycam by way of them, and many phone
programs write it.

``transform_matrix`` is world_from_cam of a camera that looks along -z with y up (OpenGL's axes), in
metres where the program knows them; `applied_scale` is taken out again. `fl_x fl_y cx cy w h` and
the distortion of OpenCV stand in the file or in each frame; as in COLMAP the centre of the top-left
pixel is (0.5, 0.5). Depth is along z, of the picture's view, in units of `depth_unit_scale_factor`
metres: 0.001 where the file says nothing, as nerfstudio's loader takes it. Frames come by name, as
there, and have no times: 10 a second.
"""

from __future__ import annotations

import os
from pathlib import Path, PurePath
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct

from topoloc import CalibrationError, Camera, RecordingError, Rigid3
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
"""Metres: nerfstudio's own default of `depth_unit_scale_factor`."""
CV_FROM_GL = np.diag([1.0, -1.0, -1.0])
"""Axes of OpenCV (y down, z forward) from those of OpenGL (y up, z back), of one camera."""


def can_open(path: Path) -> bool:
    """Whether this is a transforms.json, or a folder with one."""
    return path.name == FILE_NAME if path.is_file() else (path / FILE_NAME).is_file()


def open_nerfstudio(path: Path) -> Recording:
    """Open a folder with a transforms.json, or the file itself; RGB-D where its frames have depth.

    Raises:
        RecordingError: no frames, malformed, a matrix is no pose, depth for some of them only, or
            a name that leads out of the folder.
        CalibrationError: a key of the camera is missing or not usable, or a model that is not known
            here.
    """
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
    where = [f"{file}, {name}" for name in names]
    frames = [frame for _, frame, _ in named]
    poses: list[Rigid3 | None] = [_pose(frame, whole.applied_scale) for frame in frames]
    # The values of the file count first, as in nerfstudio.
    cameras = [_camera(lens | data, at) for (_, _, lens), at in zip(named, where, strict=True)]
    depth = _depth(frames, whole.depth_unit_scale_factor, file, where)
    name, t_ns = file.parent.resolve().name, times_from_rate(len(names))
    if len(set(cameras)) == 1:
        return Recording(name, file.parent, names, t_ns, poses, cameras[0], depth=depth)
    return Recording(name, file.parent, names, t_ns, poses, None, depth=depth, cameras=cameras)


def rigid_from_gl(world_from_gl: Rigid3) -> Rigid3:
    """world_from_cam with OpenCV's camera axes, of one with OpenGL's."""
    return Rigid3(world_from_gl.rotation @ CV_FROM_GL, world_from_gl.translation)


_Factor = Annotated[float, Meta(gt=1e-12, lt=1e12)]


class _Frame(Struct, frozen=True):
    file_path: str
    transform_matrix: Rigid3
    depth_file_path: str | None = None


class _File(Struct, frozen=True):
    frames: Annotated[list[dict[str, Any]], Meta(min_length=1)]
    applied_scale: _Factor = 1.0
    depth_unit_scale_factor: _Factor = DEPTH_UNIT


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
        "fisheye",
    ] = "OPENCV"


def _pose(frame: _Frame, scale: float) -> Rigid3:
    world_from_gl = frame.transform_matrix
    return rigid_from_gl(Rigid3(world_from_gl.rotation, world_from_gl.translation / scale))


def _camera(data: dict[str, Any], where: str) -> Camera:
    lens = decode_json(data, _Lens, CalibrationError, where)
    w, h, k1, k2, k3, k4 = int(lens.w), int(lens.h), lens.k1, lens.k2, lens.k3, lens.k4
    p1, p2, fl_y = lens.p1, lens.p2, lens.fl_x if lens.fl_y is None else lens.fl_y
    params = (lens.fl_x, fl_y, lens.cx, lens.cy)
    try:
        if lens.camera_model in ("OPENCV_FISHEYE", "fisheye"):
            return Camera.from_colmap("OPENCV_FISHEYE", w, h, (*params, k1, k2, k3, k4))
        if k4 != 0.0:  # OpenCV's model has no fourth radial coefficient, its k4 is a divisor
            raise CalibrationError("a fourth radial coefficient is not known here")
        if k3 != 0.0:
            full = (*params, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
            return Camera.from_colmap("FULL_OPENCV", w, h, full)
        if (k1, k2, p1, p2) == (0.0, 0.0, 0.0, 0.0):
            return Camera.from_colmap("PINHOLE", w, h, params)
        return Camera.from_colmap("OPENCV", w, h, (*params, k1, k2, p1, p2))
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from None


def _depth(frames: list[_Frame], unit: float, file: Path, where: list[str]) -> DepthImages | None:
    names = [frame.depth_file_path for frame in frames if frame.depth_file_path is not None]
    if not names:
        return None
    if len(names) != len(frames):
        raise RecordingError(
            f"{file}: {len(frames)} frames but {len(names)} with a depth_file_path; all of them"
            " need one, or none"
        )
    paths = [
        file.parent / parse_relative_path(name, f"{at}: depth_file_path", RecordingError)
        for name, at in zip(names, where, strict=True)
    ]
    return DepthImages(paths, 1.0 / unit, None, Rigid3.identity())


def _with_suffix(folder: Path, name: str) -> str:
    """Blender's scenes name their pictures without the suffix, which is .png."""
    return name if PurePath(name).suffix or os.path.exists(folder / name) else f"{name}.png"


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_nerfstudio)
