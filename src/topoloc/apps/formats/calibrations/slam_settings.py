"""Read the cameras of the settings files of VINS-Mono, VINS-Fusion, ORB-SLAM2 and ORB-SLAM3.

VINS: `model_type` with `projection_parameters` and `distortion_parameters` of camodocal, or a file
with `cam0_calib`, `cam1_calib` (names of such files) and `body_T_cam0`, `body_T_cam1`. ORB-SLAM:
`Camera.fx` or `Camera1.fx`, with `Camera.bf`, `Stereo.b`, `Stereo.T_c1_c2`, `Tlr`, or `LEFT.K` and
`RIGHT.K` for a pair, and `DepthMapFactor` for depth. Lengths are in metres.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from topoloc import CalibrationError, Camera, Rigid3, TrajectoryError
from topoloc.apps.core_names import (
    make_camera,
    make_rig,
    read_yaml,
    yaml_numbers,
    yaml_word,
)
from topoloc.apps.formats.calibrations.ros_calibration import RosCalibration
from topoloc.plugin import CameraCalibration, parse_relative_path

_Size = tuple[float, float]


def camera_files(path: Path, text: str) -> list[Path]:
    """Return the files of the cameras that a file of VINS-Fusion names: none, one or two. Raises
    CalibrationError: a name leaves the folder."""
    names = (yaml_word(text, f"cam{number}_calib", "", r"[^\"'\s]+") for number in (0, 1))
    return [
        path.parent / parse_relative_path(name, f"{path}: cam{number}_calib", CalibrationError)
        for number, name in enumerate(names)
        if name
    ]


def read_slam_settings(path: Path, text: str, size: _Size) -> CameraCalibration:
    """Read the camera or the pair of such a file. `size` (width and height, pixels) is used if the
    file contains none. Raises CalibrationError with the file and the key."""
    if re.search(r"^(model_type|cam0_calib):", text, re.MULTILINE):
        return _read_vins(path, text, size)
    if yaml_numbers(text, r"LEFT\.K"):
        left, right = (_rectified(path, text, side, size) for side in ("LEFT", "RIGHT"))
        if rig := left.rig(right, is_rectified=False):
            return CameraCalibration(rig.left, rig)
        raise CalibrationError(f"{path}: RIGHT.P has no baseline")
    return _read_orb(path, text, size)


def _read_vins(path: Path, text: str, size: _Size) -> CameraCalibration:
    files = camera_files(path, text)
    if yaml_numbers(text, "num_of_cam")[:1] == [1.0]:
        files = files[:1]
    cameras = [_camodocal(file, read_yaml(file), size) for file in files]
    if not files:
        return CameraCalibration(_camodocal(path, text, size))
    body_from_cams = [
        _transform(path, text, f"body_T_cam{number}")
        for number in range(len(files))
        if len(files) > 1 or yaml_numbers(text, "body_T_cam0")
    ]
    mounting = next(iter(body_from_cams), None)
    if len(cameras) == 1:
        return CameraCalibration(cameras[0], None, None, mounting)
    right_from_left = body_from_cams[1].inverse() @ body_from_cams[0]
    rig = make_rig(path, cameras[0], cameras[1], right_from_left.matrix()[:3])
    return CameraCalibration(cameras[0], rig, None, mounting)


def _camodocal(path: Path, text: str, size: _Size) -> Camera:
    """Read a camera of the library camodocal, which VINS uses."""
    model = yaml_word(text, "model_type", "")
    size = _find_size(text, "image_width", "image_height", size)
    if model == "PINHOLE":
        lens = _values(path, text, "projection_parameters: ", "fx fy cx cy")
        bends = _values(path, text, "distortion_parameters: ", "k1 k2 p1 p2")
        return make_camera(path, "OPENCV", size, lens + bends)
    if model == "KANNALA_BRANDT":
        lens = _values(path, text, "projection_parameters: ", "mu mv u0 v0 k2 k3 k4 k5")
        return make_camera(path, "OPENCV_FISHEYE", size, lens)
    if model == "MEI":
        (xi,) = _values(path, text, "mirror_parameters: ", "xi")
        lens = _values(path, text, "projection_parameters: ", "gamma1 gamma2 u0 v0")
        bends = _values(path, text, "distortion_parameters: ", "k1 k2 p1 p2")
        return _fisheye_of_mei(path, size, xi, lens, bends)
    raise CalibrationError(
        f"{path}: model_type {model or 'is missing, it'} is not one of PINHOLE, KANNALA_BRANDT, MEI"
    )


def _values(path: Path, text: str, section: str, names: str) -> list[float]:
    """Return the number after each of these keys. In errors they follow `section`, which is a part
    of the key if it ends with a dot."""
    prefix = re.escape(section) if section.endswith(".") else ""
    found = [yaml_numbers(text, prefix + name)[:1] for name in names.split()]
    if missing := [name for name, one in zip(names.split(), found, strict=True) if not one]:
        raise CalibrationError(f"{path}: {section}{missing[0]} is missing, or not a number")
    return [values[0] for values in found]


def _find_size(text: str, width: str, height: str, size: _Size) -> _Size:
    wide, high = yaml_numbers(text, width), yaml_numbers(text, height)
    return (min(wide[0], 1e9), min(high[0], 1e9)) if wide and high else size  # not infinite


def _transform(path: Path, text: str, key: str) -> Rigid3:
    """Return a transform of 3x4 or 4x4 numbers."""
    numbers = yaml_numbers(text, re.escape(key))[:12]
    if len(numbers) < 12:
        raise CalibrationError(f"{path}: {key} with 12 or 16 numbers is missing")
    with CalibrationError.at(f"{path}: {key}", TrajectoryError):
        return Rigid3.from_matrix(np.vstack([np.reshape(numbers, (3, 4)), [0.0, 0.0, 0.0, 1.0]]))


def _fisheye_of_mei(
    path: Path, size: _Size, xi: float, lens: list[float], bends: list[float]
) -> Camera:
    """Return the camera OPENCV_FISHEYE nearest to a camera of Mei and Rives (*Single view point
    omnidirectional camera calibration from planar grids*, ICRA 2007) within the image."""
    max_error_px, center = 0.5, np.array(lens[2:])
    # angles from the axis, of a grid of directions
    angles, around = np.meshgrid(np.linspace(0.01, 1.5, 150), np.linspace(0.0, 2 * np.pi, 24))
    with np.errstate(all="ignore"):
        gammas = np.array(lens[:2]) / (1.0 + xi)
        x, y = (np.sin(angles) / (np.cos(angles) + xi) * turn(around) for turn in (np.cos, np.sin))
        pixels = _distort(x, y, bends) * np.array(lens[:2]) + center
        inside = ((pixels >= 0.0) & (pixels <= np.array(size) - 1.0)).all(axis=-1)
        angles, directions = angles[inside], np.stack([np.cos(around), np.sin(around)], -1)[inside]
        rest = (pixels[inside] - center) / gammas - directions * angles[:, None]
    errors_px, ks = np.array([np.inf]), np.zeros(4)
    if len(rest) and np.isfinite(rest).all():
        columns = directions[:, :, None] * (angles[:, None] ** np.array([3, 5, 7, 9]))[:, None, :]
        columns = columns.reshape(-1, 4)
        ks, *_ = np.linalg.lstsq(columns, rest.ravel(), rcond=None)
        errors_px = np.abs((columns @ ks).reshape(rest.shape) - rest) * gammas
    if not errors_px.max() < max_error_px:
        raise CalibrationError(
            f"{path}: model_type MEI with these distortion_parameters differs from a fisheye camera"
            f" by more than {max_error_px:g} pixels; calibrate it as KANNALA_BRANDT"
        )
    return make_camera(path, "OPENCV_FISHEYE", size, [*gammas, *center, *ks])


def _distort(x: np.ndarray, y: np.ndarray, bends: list[float]) -> np.ndarray:
    """Return distorted coordinates, by OpenCV's radial and tangential model."""
    (k1, k2, p1, p2), squares = bends, x * x + y * y
    radial = 1.0 + k1 * squares + k2 * squares**2
    across = x * radial + 2.0 * p1 * x * y + p2 * (squares + 2.0 * x * x)
    down = y * radial + p1 * (squares + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([across, down], axis=-1)


def _rectified(path: Path, text: str, side: str, size: _Size) -> RosCalibration:
    """Read one camera of ORB-SLAM2's pairs that are not rectified."""
    width, height = _find_size(text, rf"{side}\.width", rf"{side}\.height", size)
    for key, count in {"K": 9, "R": 9, "P": 12}.items():
        if len(yaml_numbers(text, rf"{side}\.{key}")) < count:
            raise CalibrationError(f"{path}: {side}.{key} with {count} numbers is missing")
    matrix, rotation, projection = (
        np.array(yaml_numbers(text, rf"{side}\.{key}")) for key in "KRP"
    )
    return RosCalibration(
        name=f"{path}: {side}",
        frame="",
        width=int(width),
        height=int(height),
        model="",
        distortion=np.array(yaml_numbers(text, rf"{side}\.D")),
        matrix=matrix[:9].reshape(3, 3),
        rotation=rotation[:9].reshape(3, 3),
        projection=projection[:12].reshape(3, 4),
    )


def _read_orb(path: Path, text: str, size: _Size) -> CameraCalibration:
    size = _find_size(text, r"Camera\.width", r"Camera\.height", size)
    first = "Camera1" if yaml_numbers(text, r"Camera1\.fx") else "Camera"
    left = _orb_camera(path, text, first, size)
    factors = yaml_numbers(text, r"RGBD\.DepthMapFactor") or yaml_numbers(text, "DepthMapFactor")
    if factors:  # bf is that of a projector then
        if not factors[0] > 0.0:
            raise CalibrationError(f"{path}: DepthMapFactor must be above 0, not {factors[0]:g}")
        return CameraCalibration(left, None, factors[0])
    for key in ("Stereo.T_c1_c2", "Tlr"):
        if yaml_numbers(text, re.escape(key)):
            right = _orb_camera(path, text, "Camera2", size)
            right_from_left = _transform(path, text, key).inverse().matrix()[:3]
            return CameraCalibration(left, make_rig(path, left, right, right_from_left))
    baselines = yaml_numbers(text, r"Stereo\.b") or [
        bf / left.fx for bf in yaml_numbers(text, r"Camera\.bf")
    ]
    if not baselines or baselines[0] == 0.0:
        return CameraCalibration(left)
    if left.is_distorted:
        raise CalibrationError(
            f"{path}: Camera.bf or Stereo.b is of rectified images, but {first}.k1 to p2 are not 0;"
            " give Stereo.T_c1_c2 and Camera2, or LEFT.K and RIGHT.K"
        )
    shift = np.column_stack([np.eye(3), [-baselines[0], 0.0, 0.0]])
    return CameraCalibration(left, make_rig(path, left, left, shift))


def _orb_camera(path: Path, text: str, name: str, size: _Size) -> Camera:
    model = yaml_word(text, r"Camera\.type", "PinHole")
    lens = _values(path, text, f"{name}.", "fx fy cx cy")
    bends = [
        (yaml_numbers(text, rf"{name}\.{key}") or [0.0])[0] for key in ("k1", "k2", "p1", "p2")
    ]
    if model == "KannalaBrandt8":
        bends = _values(path, text, f"{name}.", "k1 k2 k3 k4")
        return make_camera(path, "OPENCV_FISHEYE", size, lens + bends)
    if model == "Rectified":
        return make_camera(path, "PINHOLE", size, lens)
    if model != "PinHole":
        known = "PinHole, Rectified, KannalaBrandt8"
        raise CalibrationError(f"{path}: Camera.type {model} is not one of {known}")
    if third := yaml_numbers(text, rf"{name}\.k3")[:1]:
        return make_camera(path, "FULL_OPENCV", size, [*lens, *bends, *third, 0.0, 0.0, 0.0])
    return make_camera(path, "OPENCV" if any(bends) else "PINHOLE", size, lens + bends * any(bends))
