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
from typing import Any

import numpy as np

from topoloc import CalibrationError, Camera, RecordingError, Rigid3, TrajectoryError
from topoloc.plugin import (
    DepthImages,
    Recording,
    RecordingFormat,
    json_number,
    json_rigid,
    natural_key,
    parse_relative_path,
    read_json,
    times_from_rate,
)

FILE_NAME = "transforms.json"
EXPECTED_FILES = "transforms.json of nerfstudio"
DEPTH_UNIT = 0.001
"""Metres: nerfstudio's own default of `depth_unit_scale_factor`."""
CV_FROM_GL = np.diag([1.0, -1.0, -1.0])
"""Axes of OpenCV (y down, z forward) from those of OpenGL (y up, z back), of one camera."""
_PERSPECTIVE = (
    "OPENCV",
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "FULL_OPENCV",
    "perspective",
)
_FISHEYE = ("OPENCV_FISHEYE", "fisheye")


def can_open(path: Path) -> bool:
    """Whether this is a transforms.json, or a folder with one."""
    return path.name == FILE_NAME if path.is_file() else (path / FILE_NAME).is_file()


def open_nerfstudio(path: Path) -> Recording:
    """Open a folder with a transforms.json, or the file itself; RGB-D where its frames have depth.

    Raises:
        RecordingError: no frames, malformed, depth for some of them only, or a name that leads out
            of the folder.
        CalibrationError: a key of the camera is missing or not usable, or a model that is not known
            here.
        TrajectoryError: a matrix is no pose.
    """
    file = path if path.is_file() else path / FILE_NAME
    data = read_json(file, RecordingError)
    frames = data.get("frames") if isinstance(data, dict) else None
    if (
        not isinstance(frames, list)
        or not frames
        or not all(isinstance(frame, dict) for frame in frames)
    ):
        raise RecordingError(
            f"{file}: no list of frames, which a transforms.json of nerfstudio has"
        )
    named = [
        (parse_relative_path(frame.get("file_path"), f"{file}, frame {k}", RecordingError), frame)
        for k, frame in enumerate(frames)
    ]
    named.sort(key=lambda pair: natural_key(pair[0]))
    names = [_with_suffix(file.parent, name) for name, _ in named]
    where = [f"{file}, {name}" for name in names]
    ordered = [frame for _, frame in named]
    scale = _positive_number(data, "applied_scale", 1.0, str(file))
    poses: list[Rigid3 | None] = [
        _pose(frame, scale, at) for frame, at in zip(ordered, where, strict=True)
    ]
    cameras = [_camera(data, frame, at) for frame, at in zip(ordered, where, strict=True)]
    depth = _depth(data, ordered, file, where)
    name, t_ns = file.parent.resolve().name, times_from_rate(len(names))
    if len(set(cameras)) == 1:
        return Recording(name, file.parent, names, t_ns, poses, cameras[0], depth=depth)
    return Recording(name, file.parent, names, t_ns, poses, None, depth=depth, cameras=cameras)


def rigid_from_gl(world_from_gl: Rigid3) -> Rigid3:
    """world_from_cam with OpenCV's camera axes, of one with OpenGL's."""
    return Rigid3(world_from_gl.rotation @ CV_FROM_GL, world_from_gl.translation)


def _pose(frame: dict[str, Any], scale: float, where: str) -> Rigid3:
    if "transform_matrix" not in frame:
        raise TrajectoryError(f"{where}: no transform_matrix")
    world_from_gl = json_rigid(
        frame["transform_matrix"], f"{where}: transform_matrix", TrajectoryError
    )
    return rigid_from_gl(Rigid3(world_from_gl.rotation, world_from_gl.translation / scale))


def _camera(data: dict[str, Any], frame: dict[str, Any], where: str) -> Camera:
    """The camera of a frame; what the file says for all of them counts first, as in nerfstudio."""
    values = frame | data
    model = values.get("camera_model", "OPENCV")
    if model not in _PERSPECTIVE + _FISHEYE:
        raise CalibrationError(
            f"{where}: camera_model {str(model)[:40]!r} is not known here; perspective and fisheye"
            " lenses are"
        )
    missing = [key for key in ("fl_x", "cx", "cy", "w", "h") if key not in values]
    if missing:
        raise CalibrationError(
            f"{where}: {', '.join(missing)} is missing, in the file and in this frame"
        )
    keys = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4")
    defaults = dict.fromkeys(keys, 0.0) | {"fl_y": values["fl_x"]}
    w, h, fx, fy, cx, cy, k1, k2, p1, p2, k3, k4 = (
        json_number(values.get(key, defaults[key]), f"{where}: {key}", CalibrationError)
        for key in keys
    )
    params = (fx, fy, cx, cy)
    try:
        if model in _FISHEYE:
            return Camera.from_colmap("OPENCV_FISHEYE", int(w), int(h), (*params, k1, k2, k3, k4))
        if (
            k4 != 0.0
            # nerfstudio's fourth radial coefficient is none of OpenCV's model, whose k4 is a divisor  # noqa: E501
        ):
            raise CalibrationError("a fourth radial coefficient is not known here")
        if k3 != 0.0:
            return Camera.from_colmap(
                "FULL_OPENCV", int(w), int(h), (*params, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
            )
        if (k1, k2, p1, p2) == (0.0, 0.0, 0.0, 0.0):
            return Camera.from_colmap("PINHOLE", int(w), int(h), params)
        return Camera.from_colmap("OPENCV", int(w), int(h), (*params, k1, k2, p1, p2))
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from None


def _depth(
    data: dict[str, Any], frames: list[dict[str, Any]], file: Path, where: list[str]
) -> DepthImages | None:
    num_with_depth = sum("depth_file_path" in frame for frame in frames)
    if num_with_depth == 0:
        return None
    if num_with_depth != len(frames):
        raise RecordingError(
            f"{file}: {len(frames)} frames but {num_with_depth} with a depth_file_path; all of them"
            " need one, or none"
        )
    pairs = zip(frames, where, strict=True)
    paths = [
        file.parent
        / parse_relative_path(frame["depth_file_path"], f"{at}: depth_file_path", RecordingError)
        for frame, at in pairs
    ]
    unit = _positive_number(data, "depth_unit_scale_factor", DEPTH_UNIT, str(file))
    return DepthImages(paths, 1.0 / unit, None, Rigid3.identity())


def _positive_number(data: dict[str, Any], key: str, default: float, where: str) -> float:
    number = json_number(data.get(key, default), f"{where}: {key}", RecordingError)
    if not 1e-12 < number < 1e12:
        raise RecordingError(f"{where}: {key} must be a positive number, not {number:g}")
    return number


def _with_suffix(folder: Path, name: str) -> str:
    """Blender's scenes name their pictures without the suffix, which is .png."""
    return name if PurePath(name).suffix or os.path.exists(folder / name) else f"{name}.png"


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_nerfstudio)
