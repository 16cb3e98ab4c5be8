"""Read calibrations of one camera that other programs write, and name those that are not read.

These are COLMAP's cameras.txt, ROS's ost.txt, JSON of Open3D and RealSense, JSON with OpenCV's
names, and a camera matrix as text. COLMAP alone counts pixels from the corner of the first one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from topoloc import CalibrationError, Camera
from topoloc.apps.core_names import CalibrationForSize, Positive, make_camera
from topoloc.apps.formats.calibrations.ros_calibration import RosCalibration
from topoloc.plugin import CameraCalibration, Finite, decode_json

MakePinhole = Callable[[float, float, float, float, int, int], Camera]
_COLMAP_LINE = re.compile(r"\s*\d+\s+([A-Z][A-Z_]+)\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE\s]+)")
_OST_KEYS = ("width", "height", "camera matrix", "distortion", "rectification", "projection")
# names of the matrix and of the coefficients, as in OpenCV's samples
_MATRIX_KEYS = ("intrinsic_matrix", "camera_matrix", "cameraMatrix", "mtx", "K")
_COEFFICIENT_KEYS = (
    *("dist_coeffs", "dist_coeff", "distortion_coefficients", "distCoeffs", "dist", "D"),
)
# RealSense's models in the order of their numbers
_REALSENSE = (
    *("none", "modified_brown_conrady", "inverse_brown_conrady"),
    *("ftheta", "brown_conrady", "kannala_brandt4"),
)


def read_other_camera(
    path: Path, text: str, make_pinhole: MakePinhole
) -> CalibrationForSize | None:
    """Return the calibration of another program's file, or None if it is of no known one.

    Args:
        path: the file.
        text: its text.
        make_pinhole: returns the camera of fx, fy, cx, cy for an image size, if the file has none.

    Raises:
        CalibrationError: the model is not known here, or a value is missing. Names the file.
    """
    lines = [line for line in text.splitlines() if line.strip() and line.lstrip()[0] != "#"]
    rows = [_COLMAP_LINE.fullmatch(line) for line in lines]
    if rows and all(rows):
        return _read_colmap(path, {row.groups() for row in rows if row})
    if "[image]" in text and "camera matrix" in text:
        return _read_ost(path, lines)
    if text.lstrip().startswith("{"):
        data = decode_json(text, dict[str, Any], CalibrationError, str(path))
        return _read_json(path, data, make_pinhole)
    words = re.sub(r"^\s*\w+\s*[=:]|\barray\b|[\[\](),;]", " ", "\n".join(lines)).split()
    with CalibrationError.at(path):
        try:
            matrix = _parse_matrix([float(word) for word in words])
        except ValueError:
            return None
    return lambda *size: CameraCalibration(make_pinhole(*_intrinsics(matrix), *size))


def _parse_matrix(numbers: Sequence[float]) -> np.ndarray:
    """Return the camera matrix of 9 numbers, or of 16 of a homogeneous one. It may be written by
    columns, as in Open3D. Raises ValueError: other numbers; CalibrationError: another matrix."""
    if len(numbers) not in (9, 16):
        raise ValueError("no matrix")
    side = 3 if len(numbers) == 9 else 4
    matrix = np.array(numbers, np.float64).reshape(side, side)
    if side == 4 and matrix[3].tolist() == [0.0, 0.0, 0.0, 1.0] and not matrix[:3, 3].any():
        matrix = matrix[:3, :3]
    if matrix[-1].tolist() != [0.0, 0.0, 1.0]:
        matrix = matrix.T
    if matrix[-1].tolist() != [0.0, 0.0, 1.0] or matrix[1, 0] != 0.0:
        raise CalibrationError("no camera matrix, whose rows are fx 0 cx, 0 fy cy, 0 0 1")
    if abs(matrix[0, 1]) > 1e-6 * abs(matrix[0, 0]):
        raise CalibrationError(f"a skew of {matrix[0, 1]:g}, which no model here knows")
    return matrix


def _intrinsics(matrix: np.ndarray) -> tuple[float, float, float, float]:
    return tuple(matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())


def _read_colmap(path: Path, rows: set[tuple[str, ...]]) -> CalibrationForSize:
    def for_size(width: int, height: int) -> CameraCalibration:
        found = [row for row in rows if row[1:3] == (str(width), str(height))] or list(rows)
        if len(found) > 1:
            raise CalibrationError(
                f"{path}: {len(found)} cameras of COLMAP may be those of {width}x{height}; keep the"
                " line of one"
            )
        model, wide, high, numbers = found[0]
        with CalibrationError.at(path, CalibrationError, ValueError):
            params = tuple(map(float, numbers.split()))
            return CameraCalibration(Camera.from_colmap(model, int(wide), int(high), params))

    if len(rows) == 1:
        for_size(0, 0)  # raises errors before the first image is read
    return for_size


def _read_ost(path: Path, lines: Sequence[str]) -> CalibrationForSize:
    """Read the sections of one camera of ROS, or of a pair."""
    sections: dict[str, dict[str, list[float]]] = {}
    values: dict[str, list[float]] = {}
    key = ""
    for line in map(str.strip, lines):
        if line.startswith("["):
            values = sections.setdefault(line.strip("[]"), {})
        elif line in _OST_KEYS:
            key = line
        else:
            with CalibrationError.at(f"{path}, {key or line[:40]}", ValueError):
                values.setdefault(key, []).extend(map(float, line.split()))
    image = sections.pop("image", {})
    size = [*image.get("width", []), *image.get("height", [])]
    if len(size) != 2:
        raise CalibrationError(f"{path}: [image] needs a width and a height")
    cameras = [
        _ros_camera(path, named["camera matrix"], named.get("distortion", []), size, named)
        for _, named in sorted(sections.items())  # left before right
        if "camera matrix" in named
    ]
    if len(cameras) == 1:
        calibration = CameraCalibration(cameras[0].camera(is_rectified=False))
    elif len(cameras) == 2 and (rig := cameras[0].rig(cameras[1], is_rectified=False)):
        calibration = CameraCalibration(rig.left, rig)
    else:
        raise CalibrationError(f"{path}: {len(cameras)} cameras, but no projection of a pair")
    return lambda width, height: calibration


def _ros_camera(
    path: Path,
    numbers: Sequence[float],
    distortion: Sequence[float],
    size: Sequence[float],
    others: dict[str, list[float]],
) -> RosCalibration:
    """Return a camera of OpenCV's model. Raises CalibrationError: its distortion may be that of a
    fisheye lens, or a matrix or the size is malformed."""
    if len(distortion) == 4 and any(distortion):
        raise CalibrationError(
            f"{path}: 4 coefficients are those of OPENCV or of OPENCV_FISHEYE; write a camera.json"
            " that names the model, or give the YAML of the same calibration"
        )
    with CalibrationError.at(path, CalibrationError, ValueError, OverflowError):
        width, height = map(int, size)
        matrix = _parse_matrix(numbers)
        projection = others.get("projection") or np.column_stack([matrix, np.zeros(3)])
        rotation = others.get("rectification") or np.eye(3)
        return RosCalibration(
            name=str(path),
            frame="",
            width=width,
            height=height,
            model="plumb_bob",
            distortion=np.array(distortion, np.float64),
            matrix=matrix,
            rotation=np.reshape(rotation, (3, 3)).astype(np.float64),
            projection=np.reshape(projection, (3, 4)).astype(np.float64),
        )


def _read_json(
    path: Path, data: dict[str, Any], make_pinhole: MakePinhole
) -> CalibrationForSize | None:
    """Read the camera of a JSON object, or of the only one inside."""
    if "value0" in data:
        raise CalibrationError(
            f"{path}: a calibration of Basalt is not read; write a camera.json, with PINHOLE for"
            " pinhole and OPENCV_FISHEYE for kb4, or calibrate again as kb4"
        )
    inside = {key: value for key, value in data.items() if isinstance(value, dict)}
    if any("projection_type" in value for value in inside.values()):
        raise CalibrationError(
            f"{path}: camera models of OpenSfM are not read; write a camera.json, with focal"
            " lengths in pixels (times the longer side)"
        )
    if {"left", "right"} & data.keys() or ("fx" in data and "ppx" not in data):
        return None  # a camera.json
    keys = {"ppx", *_MATRIX_KEYS}
    cameras = {name: value for name, value in {"": data, **inside}.items() if keys & value.keys()}
    if len(cameras) > 1:
        raise CalibrationError(f"{path}: several cameras ({', '.join(cameras)}); write one alone")
    for camera in cameras.values():
        return (
            _read_realsense(path, camera)
            if "ppx" in camera
            else _read_matrix_json(path, camera, make_pinhole)
        )
    return None


class _RealSense(Struct, frozen=True):
    width: Positive
    height: Positive
    fx: Finite
    fy: Finite
    ppx: Finite
    ppy: Finite
    model: str | int = "none"
    coeffs: list[Finite] = []


def _read_realsense(path: Path, data: dict[str, Any]) -> CalibrationForSize:
    lens = decode_json(data, _RealSense, CalibrationError, str(path))
    word = re.sub(r"\W+", "_", str(lens.model).lower())
    names = [name for number, name in enumerate(_REALSENSE) if name in word or word == str(number)]
    name = max(names, key=len, default="")
    params, coeffs = [lens.fx, lens.fy, lens.ppx, lens.ppy], (lens.coeffs + [0.0] * 5)[:5]
    if name == "kannala_brandt4":
        model, params = "OPENCV_FISHEYE", params + coeffs[:4]
    elif name == "brown_conrady" and any(coeffs):
        model, params = "FULL_OPENCV", [*params, *coeffs, 0.0, 0.0, 0.0]
    elif name not in ("", "ftheta") and not any(coeffs):
        model = "PINHOLE"
    else:
        raise CalibrationError(
            f"{path}: RealSense's model {word[:40]} with these coefficients is not known here;"
            " calibrate the camera with OpenCV or Kalibr and give that YAML"
        )
    camera = make_camera(path, model, (lens.width, lens.height), params)
    return lambda width, height: CameraCalibration(camera)


_Numbers = list[Finite | list[Finite]]


class _MatrixJson(Struct, frozen=True):
    matrix: _Numbers
    coefficients: _Numbers = []
    width: Positive | None = None
    height: Positive | None = None


def _read_matrix_json(
    path: Path, data: dict[str, Any], make_pinhole: MakePinhole
) -> CalibrationForSize:
    found = {"width": data.get("image_width"), "height": data.get("image_height")} | data
    for name, keys in (("matrix", _MATRIX_KEYS), ("coefficients", _COEFFICIENT_KEYS)):
        found[name] = next((data[key] for key in keys if data.get(key) is not None), [])
    lens = decode_json(found, _MatrixJson, CalibrationError, str(path))
    matrix, coefficients = (
        np.hstack([*numbers, []]).tolist() for numbers in (lens.matrix, lens.coefficients)
    )

    def for_size(width: int, height: int) -> CameraCalibration:
        size = (
            (lens.width, lens.height)
            if lens.width and lens.height
            else (float(width), float(height))
        )
        ros = _ros_camera(path, matrix, coefficients, size, {})
        if size == (width, height):
            make_pinhole(*_intrinsics(ros.matrix), width, height)  # checks the size
        return CameraCalibration(ros.camera(is_rectified=False))

    _ros_camera(path, matrix, coefficients, (1000.0, 1000.0), {})
    return for_size
