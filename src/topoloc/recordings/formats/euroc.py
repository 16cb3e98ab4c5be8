"""Read EuRoC / ASL recordings (Burri et al., IJRR 2016): ``mav0/cam0`` and ``mav0/cam1``.

Images are distorted and not rectified. Images of equal time stamps form a stereo pair. An image
without a partner is skipped, because some published recordings lack frames of one camera. Ground
truth is ``state_groundtruth_estimate0`` (or ``mocap0``). Its body poses are converted to poses of
the left camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topoloc.errors import CalibrationError, RecordingError, TrajectoryError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.format import RecordingFormat
from topoloc.recordings.recording import Recording, RightImages
from topoloc.recordings.stereo_yaml import kalibr_camera, read_yaml, require_numbers
from topoloc.recordings.text_files import read_file_list
from topoloc.recordings.trajectory import read_asl_poses

EXPECTED_FILES = "mav0/ with cam0/data.csv, or cam0/data.csv"
MAX_TRUTH_GAP = 0.05
_TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0")


@dataclass(frozen=True, eq=False)
class Sensor:
    """Hold the camera model and mounting of one sensor.yaml."""

    camera: Camera
    body_from_cam: Rigid3


def can_open(path: Path) -> bool:
    """Return whether this folder is a mav0 or contains one."""
    return _find_mav(path) is not None


def _find_mav(path: Path) -> Path | None:
    folders = (path / "mav0", path)
    return next((folder for folder in folders if (folder / "cam0" / "data.csv").is_file()), None)


def open_euroc(path: Path) -> Recording:
    """Open a recording by its folder or its mav0. Without cam1 it is a monocular recording of the
    left camera.

    Raises:
        RecordingError: data.csv is missing or malformed, or no two images have the same time.
        CalibrationError: a sensor.yaml is missing or not usable.
        TrajectoryError: the ground truth is malformed, or matches no frame.
    """
    mav = _find_mav(path)
    if mav is None:
        raise RecordingError(f"{path}: not an EuRoC recording, which has {EXPECTED_FILES}")
    left = _read_csv(mav / "cam0" / "data.csv")
    sensor = read_sensor(mav / "cam0" / "sensor.yaml")
    t_ns, right = sorted(left), None
    if (mav / "cam1" / "data.csv").is_file():
        right_by_time = _read_csv(mav / "cam1" / "data.csv")
        right_sensor = read_sensor(mav / "cam1" / "sensor.yaml")
        t_ns = [time for time in t_ns if time in right_by_time]
        if not t_ns:
            raise RecordingError(
                f"{mav}: none of the {len(left)} pictures of cam0 has a partner of its time among"
                f" {len(right_by_time)} of cam1"
            )
        right = RightImages([right_by_time[time] for time in t_ns], _rig(mav, sensor, right_sensor))
    names = [left[time].relative_to(path).as_posix() for time in t_ns]
    name = mav.resolve().parent.name if mav.resolve().name == "mav0" else path.resolve().name
    poses = _read_ground_truth(mav, t_ns, sensor)
    return Recording(name, path, names, t_ns, poses, sensor.camera, right)


def read_sensor(path: Path) -> Sensor:
    """Read the camera model and mounting of a sensor.yaml.

    Raises:
        CalibrationError: the file, a key or a number is missing, or the model is unknown.
    """
    text = read_yaml(path)
    camera = kalibr_camera(path, text)
    mounting = np.array(require_numbers(path, text, 16, "T_BS")).reshape(4, 4)
    try:
        return Sensor(camera, Rigid3.from_matrix(mounting))
    except TrajectoryError as error:
        raise CalibrationError(f"{path}: {error}") from None


def _rig(mav: Path, left: Sensor, right: Sensor) -> StereoRig:
    right_from_left = right.body_from_cam.inverse() @ left.body_from_cam
    try:
        return StereoRig(left.camera, right.camera, right_from_left)
    except CalibrationError as error:
        raise CalibrationError(
            f"{mav / 'cam1' / 'sensor.yaml'}: with that of cam0, {error}"
        ) from None


def _read_csv(path: Path) -> dict[int, Path]:
    """Return the image of each time stamp."""
    t_ns, names = read_file_list(path, RecordingError)
    return {time: path.parent / "data" / name for time, name in zip(t_ns, names, strict=True)}


def _read_ground_truth(mav: Path, t_ns: list[int], sensor: Sensor) -> list[Rigid3 | None]:
    paths = (mav / name / "data.csv" for name in _TRUTH_FOLDERS)
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return [None] * len(t_ns)
    poses = read_asl_poses(path).interpolate(t_ns, MAX_TRUTH_GAP)
    if all(world_from_body is None for world_from_body in poses):
        raise TrajectoryError(f"{path}: none of the {len(t_ns)} frames has a pose")
    return [pose and pose @ sensor.body_from_cam for pose in poses]


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_euroc)
