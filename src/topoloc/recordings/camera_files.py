"""Read calibrations of a camera or a stereo rig: camera.json, and YAML of OpenCV FileStorage and
Kalibr camchain. A pair of files of ROS, `left.yaml` and `right.yaml`, is found here.

OpenCV: `M1 D1 M2 D2 R T` as in its stereo sample, or the longer names of other programs. `R` and
`T` may be in an extrinsics.yml beside it. They transform points from the left camera to the right
one. Kalibr: `cam0`, `cam1` with `T_cn_cnm1`, or both with `T_cam_imu` or `T_imu_cam`. Lengths are
in metres.

The files come with or without OpenCV's header and in several styles of YAML. So only words and
numbers after the needed keys are read. Tags and aliases are ignored.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from topoloc.errors import CalibrationError, TrajectoryError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import Positive, decode_json
from topoloc.recordings.text_files import read_text

FILE_NAME = "camera.json"


@dataclass(frozen=True)
class CameraCalibration:
    """Hold a camera model, and the `rig` of a stereo pair. The camera is the left one of the pair.
    `depth_factor` is in file units per metre. `body_from_cam` is the mounting of the camera."""

    camera: Camera
    rig: StereoRig | None = None
    depth_factor: float | None = None
    body_from_cam: Rigid3 | None = None


def read_camera_json(path: Path) -> CameraCalibration:
    """Read a camera.json.

    It holds one camera, optionally with the "baseline" (metres) of a rectified stereo pair whose
    left camera it is. Or it holds a stereo pair of any calibration: "left", "right" and
    "right_from_left" (4x4, metres).

    Raises:
        CalibrationError: the file is missing, is not JSON, or a key is missing or out of range.
            Names the file.
    """
    text = read_text(path, CalibrationError, "no such camera file")
    whole = decode_json(text, dict[str, Any], CalibrationError, str(path))
    data = decode_json(whole, _CameraFile, CalibrationError, str(path))
    with CalibrationError.at(path):
        if data.left is None and data.right is None:
            camera = Camera.from_json(whole)
            rig = None if data.baseline is None else StereoRig.rectified(camera, data.baseline)
        elif data.left is None or data.right is None or data.right_from_left is None:
            raise CalibrationError(
                'a stereo pair has "left", "right" and "right_from_left" (4x4, metres)'
            )
        else:
            camera = Camera.from_json(data.left, "left")
            right = Camera.from_json(data.right, "right")
            rig = StereoRig(camera, right, data.right_from_left)
    return CameraCalibration(camera, rig, data.depth_factor)


class _CameraFile(Struct, frozen=True):
    """Hold the keys of a camera.json, except those of a single camera."""

    depth_factor: Positive | None = None
    baseline: Positive | None = None
    left: dict[str, Any] | None = None
    right: dict[str, Any] | None = None
    right_from_left: Rigid3 | None = None


_MAX_CHARS = 1_000_000
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
YAML_SUFFIXES = frozenset({".yaml", ".yml"})
_MAX_BASELINE = 5.0  # metres; a larger baseline is probably in millimetres
# COLMAP's camera model for each distortion model of Kalibr, with its number of coefficients
_DISTORTIONS = {
    "radial-tangential": ("OPENCV", 4),
    "radtan": ("OPENCV", 4),
    "equidistant": ("OPENCV_FISHEYE", 4),
    "none": ("PINHOLE", 0),
}
# Kalibr's camera models that are not read
_KALIBR_MODELS = {"ds": "double sphere", "omni": "Mei's unified"}
_FISHEYE_WORDS = ("equidistant", "fisheye", "KANNALA_BRANDT")
# names of the camera matrix and the distortion of the left, the right, and a single camera
_LEFT_KEYS = tuple(
    names.split()
    for names in (
        "M1 K1 cameraMatrix1 camera_matrix_1 camera_matrix_left left_camera_matrix K_left",
        "D1 distCoeffs1 dist_coeffs_1 distortion_coefficients_left dist_coeffs_left"
        " left_distortion_coefficients D_left",
    )
)
_RIGHT_KEYS = tuple(
    [name.replace("1", "2").replace("left", "right") for name in names] for names in _LEFT_KEYS
)
_MONO_KEYS = (
    ("camera_matrix", "cameraMatrix", "K"),
    ("distortion_coefficients", "distCoeffs", "dist_coeffs", "D"),
)


def read_yaml(path: Path) -> str:
    """Return the text of a calibration without comments. Raises CalibrationError with the file
    name."""
    text = read_text(path, CalibrationError, "no calibration here: no such file")
    if len(text) > _MAX_CHARS:
        raise CalibrationError(f"{path}: {len(text)} characters are no calibration")
    return re.sub(r"#.*", "", text)


def yaml_word(text: str, key: str, default: str, word: str = r"[\w-]+") -> str:
    """Return the word after a key, or `default`. `key` and `word` are regular expressions."""
    found = re.search(rf"^[ \t]*{key}:\s*[\"']?({word})", text, re.MULTILINE)
    return found[1] if found else default


def yaml_numbers(text: str, *keys: str) -> list[float]:
    """Return all numbers after the first existing key, up to the next key other than `cols`,
    `rows`, `dt` or `data`. Keys are regular expressions."""
    for key in keys:
        found = re.search(
            rf"^[ \t]*{key}:(.*?)(?=^[ \t]*(?!(?:cols|rows|dt|data)\b)[A-Za-z_][\w.]*:|\Z)",
            text,
            re.MULTILINE | re.DOTALL,
        )
        if found:
            return [
                float(number)
                for number in _NUMBER.findall(re.sub(r"\b(?:cols|rows|dt):.*", "", found[1]))
            ]
    return []


def require_numbers(path: Path, text: str, count: int, *keys: str) -> list[float]:
    """Return the first `count` numbers after one of these keys. Raises CalibrationError with the
    file name."""
    numbers = yaml_numbers(text, *keys)
    if len(numbers) < count:
        raise CalibrationError(f"{path}: {' or '.join(keys[:3])} with {count} numbers is missing")
    return numbers[:count]


def has_slam_settings(text: str) -> bool:
    """Return whether the text has a key of the settings of VINS or ORB-SLAM."""
    keys = "model_type", "cam0_calib", r"Camera1?\.(?:fx|type)", r"LEFT\.K"
    return re.search(rf"^({'|'.join(keys)}):", text, re.MULTILINE) is not None


def is_calibration(path: Path) -> bool:
    """Return whether a YAML file contains a camera with a known key."""
    try:
        text = read_yaml(path)
    except CalibrationError:
        return False
    return (
        has_slam_settings(text)
        or _is_kalibr(text)
        or any(yaml_numbers(text, *names[0]) for names in (_LEFT_KEYS, _MONO_KEYS))
    )


def read_calibration_yaml(path: Path, width: int, height: int) -> CameraCalibration:
    """Read a calibration. The size (pixels) is used if the file contains none.

    Raises:
        CalibrationError: the file is missing or is no calibration, a number is missing, the model
            is unknown, or the baseline is implausible. Names the file.
    """
    text = read_yaml(path)
    if _is_kalibr(text):
        return _read_kalibr(path, text)
    size = yaml_image_size(text) or (float(width), float(height))
    if not yaml_numbers(text, *_LEFT_KEYS[0]):
        return CameraCalibration(_opencv_camera(path, text, _MONO_KEYS, size))
    left, right = (_opencv_camera(path, text, names, size) for names in (_LEFT_KEYS, _RIGHT_KEYS))
    beside = path.with_name("extrinsics.yml")
    motion = read_yaml(beside) if not yaml_numbers(text, "R") and beside.is_file() else text
    rotation = require_numbers(path, motion, 9, "R", "rotation_matrix", "R_right_left")
    translation = require_numbers(path, motion, 3, "T", "translation_vector", "T_right_left")
    right_from_left = np.column_stack([np.reshape(rotation, (3, 3)), translation])
    return CameraCalibration(left, rig=make_rig(path, left, right, right_from_left))


def find_right_file(path: Path) -> Path | None:
    """Return ROS's file of the right camera beside that of the left one, such as right.yaml beside
    left.yaml. Return None if there is none."""
    right = path.with_name(path.name.replace("left", "right"))
    files = (path, right) if right != path and path.is_file() and right.is_file() else ()
    has_projections = [bool(yaml_numbers(read_yaml(file), "projection_matrix")) for file in files]
    return right if has_projections and all(has_projections) else None


def kalibr_camera(path: Path, section: str) -> Camera:
    """Read the camera of a sensor.yaml, or of a section of a camchain. Raises CalibrationError."""
    distortion = yaml_word(section, "distortion_model", "none")
    kind, known = yaml_word(section, "camera_model", "pinhole"), ", ".join(_DISTORTIONS)
    remedy = "calibrate with Kalibr's --models pinhole-equi, or pinhole-radtan for a narrow lens"
    if kind == "eucm":
        from topoloc.geometry.fitted_models import fit_known_model  # loads an optimizer

        alpha, beta, *params = require_numbers(path, section, 6, "intrinsics")
        width, height = require_numbers(path, section, 2, "resolution")
        make_camera(path, "PINHOLE", (width, height), params)  # refuses sizes that are none
        with CalibrationError.at(path):
            numbers = *params, alpha, beta
            model, fitted = fit_known_model("EUCM", int(width), int(height), numbers)
        return make_camera(path, model, (width, height), list(fitted))
    if kind != "pinhole":
        name = f" ({_KALIBR_MODELS[kind]})" if kind in _KALIBR_MODELS else ""
        raise CalibrationError(f"{path}: camera_model {kind}{name} is not known here; {remedy}")
    if distortion not in _DISTORTIONS:
        raise CalibrationError(
            f"{path}: distortion_model {distortion} is not one of {known}; {remedy}"
        )
    model, count = _DISTORTIONS[distortion]
    width, height = require_numbers(path, section, 2, "resolution")
    params = require_numbers(path, section, 4, "intrinsics")
    if count:
        names = "distortion_coefficients", "distortion_coeffs"
        params += require_numbers(path, section, count, *names)
    return make_camera(path, model, (width, height), params)


def _is_kalibr(text: str) -> bool:
    return re.search(r"^cam0:", text, re.MULTILINE) is not None


def _read_kalibr(path: Path, text: str) -> CameraCalibration:
    parts = re.split(r"^cam(\d+):", text, flags=re.MULTILINE)
    sections = dict(zip(parts[1::2], parts[2::2], strict=True))
    left, body_from_left = kalibr_camera(path, sections["0"]), _mounting(path, sections["0"])
    if "1" not in sections:
        return CameraCalibration(left, body_from_cam=body_from_left)
    right, body_from_right = kalibr_camera(path, sections["1"]), _mounting(path, sections["1"])
    if body_from_left and body_from_right and not yaml_numbers(sections["1"], "T_cn_cnm1"):
        motion = (body_from_right.inverse() @ body_from_left).matrix()
    else:
        motion = np.array(require_numbers(path, sections["1"], 16, "T_cn_cnm1")).reshape(4, 4)
    return CameraCalibration(left, make_rig(path, left, right, motion[:3]), None, body_from_left)


def _mounting(path: Path, section: str) -> Rigid3 | None:
    """Return the pose of a camera in the frame of the IMU, or None if the section has none."""
    for key in ("T_cam_imu", "T_imu_cam", "T_BS"):
        if yaml_numbers(section, key):
            numbers = require_numbers(path, section, 16, key)
            with CalibrationError.at(f"{path}, {key}", TrajectoryError):
                mounting = Rigid3.from_matrix(np.array(numbers).reshape(4, 4))
            return mounting.inverse() if key == "T_cam_imu" else mounting
    return None


def _opencv_camera(
    path: Path, text: str, names: Sequence[Sequence[str]], size: tuple[float, float]
) -> Camera:
    """Read the camera whose matrix and distortion have one of these names."""
    matrix, distortion = names
    fx, skew, cx, _, fy, cy, *_ = require_numbers(path, text, 9, *matrix)
    if abs(skew) > 1e-6 * abs(fx):
        raise CalibrationError(
            f"{path}: {matrix[0]} has a skew of {skew:g}, which no model here knows"
        )
    coefficients = yaml_numbers(text, *distortion)
    if yaml_word(text, "distortion_model", "") in _FISHEYE_WORDS:
        four = (coefficients + [0.0] * 4)[:4]
        return make_camera(path, "OPENCV_FISHEYE", size, [fx, fy, cx, cy, *four])
    if any(coefficients[8:]):
        raise CalibrationError(
            f"{path}: {distortion[0]} has {len(coefficients)} numbers; thin prism and tilted models"
            " are not known here"
        )
    model, count = ("OPENCV", 4) if not any(coefficients[4:]) else ("FULL_OPENCV", 8)
    return make_camera(path, model, size, [fx, fy, cx, cy, *(coefficients + [0.0] * 8)[:count]])


def make_camera(path: Path, model: str, size: tuple[float, float], params: list[float]) -> Camera:
    """Return a camera. Raises CalibrationError with the file name."""
    with CalibrationError.at(path, CalibrationError, ValueError, OverflowError):
        return Camera(model, int(size[0]), int(size[1]), tuple(params))


def yaml_image_size(text: str) -> tuple[float, float] | None:
    """Return width and height, or None if the file contains no size."""
    pair = yaml_numbers(text, "image_size", "imageSize", "size", "resolution")
    if len(pair) >= 2:
        return pair[0], pair[1]
    width = yaml_numbers(text, "image_width", "imageWidth", "width")
    height = yaml_numbers(text, "image_height", "imageHeight", "height")
    return (width[0], height[0]) if width and height else None


def make_rig(path: Path, left: Camera, right: Camera, right_from_left: np.ndarray) -> StereoRig:
    """Return a rig of a plausible baseline. Raises CalibrationError with the file name."""
    with CalibrationError.at(path, CalibrationError, TrajectoryError):
        rig = StereoRig(left, right, Rigid3.from_matrix(right_from_left))
    if rig.baseline > _MAX_BASELINE:
        raise CalibrationError(
            f"{path}: a baseline of {rig.baseline:g} m; is it in millimetres? Metres are needed"
        )
    return rig
