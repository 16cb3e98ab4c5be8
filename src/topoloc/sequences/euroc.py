"""EuRoC / ASL recordings (Burri et al., IJRR 2016): ``mav0/cam0``, ``mav0/cam1``, distorted and unrectified.

Pairs are the pictures of equal time stamp; a picture without its partner is left out, as some of the published recordings lack frames
of one camera. Truth is ``state_groundtruth_estimate0`` (or ``mocap0``): poses of the body, brought to the left camera.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topoloc.errors import CalibrationError, RecordingError, TrajectoryError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.sequences.recording import Recording, RightPictures
from topoloc.sequences.text_rows import read_file_list, read_text
from topoloc.sequences.trajectory import poses_at, read_asl_poses

LOOKS_FOR = "mav0/ with cam0/data.csv, or cam0/data.csv"
MAX_TRUTH_GAP = 0.05
_TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
# COLMAP's model of each of Kalibr's distortions, with the number of its coefficients.
_DISTORTIONS = {
    "radial-tangential": ("OPENCV", 4),
    "radtan": ("OPENCV", 4),
    "equidistant": ("OPENCV_FISHEYE", 4),
    "none": ("PINHOLE", 0),
}


@dataclass(frozen=True, eq=False)
class Sensor:
    """One camera's sensor.yaml."""

    camera: Camera
    body_from_cam: Rigid3


def recognises(path: Path) -> bool:
    """Whether this folder is a mav0, or has one."""
    return any((path / below / "cam0" / "data.csv").is_file() for below in ("mav0", ""))


def open_euroc(path: Path) -> Recording:
    """Open a recording by its folder or its mav0; a plain recording of the left camera where there is no cam1.

    Raises:
        RecordingError: no data.csv, a malformed one, or no two pictures of the same time.
        CalibrationError: a sensor.yaml is missing or not usable.
        TrajectoryError: the truth is malformed, or fits no frame.
    """
    mav = next((folder for folder in (path / "mav0", path) if (folder / "cam0" / "data.csv").is_file()), None)
    if mav is None:
        raise RecordingError(f"{path}: not an EuRoC recording, which has {LOOKS_FOR}")
    left = _read_csv(mav / "cam0" / "data.csv")
    sensor = read_sensor(mav / "cam0" / "sensor.yaml")
    t_ns, right = sorted(left), None
    if (mav / "cam1" / "data.csv").is_file():
        right_by_time = _read_csv(mav / "cam1" / "data.csv")
        right_sensor = read_sensor(mav / "cam1" / "sensor.yaml")
        t_ns = [time for time in t_ns if time in right_by_time]
        if not t_ns:
            raise RecordingError(
                f"{mav}: none of the {len(left)} pictures of cam0 has a partner of its time among {len(right_by_time)} of cam1"
            )
        right = RightPictures([right_by_time[time] for time in t_ns], _rig(mav, sensor, right_sensor))
    names = [left[time].relative_to(path).as_posix() for time in t_ns]
    name = mav.resolve().parent.name if mav.resolve().name == "mav0" else path.resolve().name
    return Recording(name, path, names, t_ns, _truth(mav, t_ns, sensor), sensor.camera, right)


def read_sensor(path: Path) -> Sensor:
    """Camera and mounting of a sensor.yaml.

    The files come with OpenCV's header or without it and in several styles of YAML, so only the numbers after the needed keys are read.

    Raises:
        CalibrationError: missing, a key or number is missing, or a model that is not known.
    """
    text = re.sub(r"#.*", "", read_text(path, CalibrationError, "no calibration here"))
    distortion = _word(text, "distortion_model", "none")
    if _word(text, "camera_model", "pinhole") != "pinhole" or distortion not in _DISTORTIONS:
        known = ", ".join(_DISTORTIONS)
        raise CalibrationError(f"{path}: distortion_model {distortion} is not one of {known}, or camera_model is not pinhole")
    model, num_coefficients = _DISTORTIONS[distortion]
    width, height = _numbers(path, text, "resolution", 2)
    intrinsics = _numbers(path, text, "intrinsics", 4)
    coefficients = _numbers(path, text, "distortion_coefficients", num_coefficients) if num_coefficients else []
    try:
        camera = Camera(model, int(width), int(height), tuple(intrinsics + coefficients))
        return Sensor(camera, Rigid3.from_matrix(np.array(_numbers(path, text, "T_BS", 16)).reshape(4, 4)))
    except (CalibrationError, TrajectoryError, ValueError, OverflowError) as error:
        raise CalibrationError(f"{path}: {error}") from None


def _rig(mav: Path, left: Sensor, right: Sensor) -> StereoRig:
    try:
        return StereoRig(left.camera, right.camera, right.body_from_cam.inverse() @ left.body_from_cam)
    except CalibrationError as error:
        raise CalibrationError(f"{mav / 'cam1' / 'sensor.yaml'}: with that of cam0, {error}") from None


def _word(text: str, key: str, default: str) -> str:
    found = re.search(rf"^\s*{key}:\s*[\"']?([\w-]+)", text, re.MULTILINE)
    return found[1] if found else default


def _numbers(path: Path, text: str, key: str, count: int) -> list[float]:
    """The first `count` numbers after a key, before the next key that is not `cols`, `rows`, `dt` or `data`."""
    found = re.search(rf"^[ \t]*{key}:(.*?)(?=^[ \t]*(?!(?:cols|rows|dt|data)\b)[A-Za-z_]\w*:|\Z)", text, re.MULTILINE | re.DOTALL)
    values = re.sub(r"\b(?:cols|rows|dt):.*", "", found[1]) if found else ""
    numbers = [float(number) for number in _NUMBER.findall(values)]
    if len(numbers) < count:
        raise CalibrationError(f"{path}: {key} with {count} numbers is missing")
    return numbers[:count]


def _read_csv(path: Path) -> dict[int, Path]:
    """Picture of each time stamp."""
    t_ns, names = read_file_list(path, RecordingError)
    return {time: path.parent / "data" / name for time, name in zip(t_ns, names, strict=True)}


def _truth(mav: Path, t_ns: list[int], sensor: Sensor) -> list[Rigid3 | None]:
    path = next((mav / name / "data.csv" for name in _TRUTH_FOLDERS if (mav / name / "data.csv").is_file()), None)
    if path is None:
        return [None] * len(t_ns)
    poses = poses_at(read_asl_poses(path), t_ns, MAX_TRUTH_GAP)
    if all(world_from_body is None for world_from_body in poses):
        raise TrajectoryError(f"{path}: none of the {len(t_ns)} frames has a pose")
    return [world_from_body @ sensor.body_from_cam if world_from_body is not None else None for world_from_body in poses]
