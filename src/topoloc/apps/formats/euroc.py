"""Read EuRoC / ASL recordings (Burri et al., IJRR 2016): ``mav0/cam0`` and ``mav0/cam1``.

Images are distorted and not rectified. Images whose time stamps differ by at most 1 ms form a
stereo pair. An image without a partner is skipped, because some published recordings lack frames of
one camera. Ground
truth is ``state_groundtruth_estimate0`` (or ``mocap0``). Its body poses are converted to poses of
the left camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topoloc import (
    CalibrationError,
    Camera,
    RecordingError,
    Rigid3,
    StereoRig,
    Trajectory,
    TrajectoryError,
)
from topoloc.apps.core_names import (
    CalibrationForSize,
    RightImages,
    find_calibration,
    first_image_size,
    kalibr_camera,
    read_rows,
    read_yaml,
    replace_cameras,
    require_numbers,
    timed_trajectory,
)
from topoloc.apps.formats.image_lists import match_times, read_file_list
from topoloc.plugin import Recording, RecordingFormat

EXPECTED_FILES = "mav0/ with cam0/data.csv, or cam0/data.csv"
MAX_TRUTH_GAP, MAX_PAIR_DELAY_MS = 0.05, 1
_TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0")


@dataclass(frozen=True, eq=False)
class SensorFile:
    """Hold the camera model and mounting of one sensor.yaml."""

    camera: Camera
    body_from_cam: Rigid3


def can_open(path: Path) -> bool:
    """Return whether this folder is a mav0 or contains one."""
    return _find_mav(path) is not None


def _find_mav(path: Path) -> Path | None:
    folders = (path / "mav0", path)
    return next((folder for folder in folders if (folder / "cam0" / "data.csv").is_file()), None)


def open_euroc(path: Path, calibration: CalibrationForSize | None = None) -> Recording:
    """Open a recording by its folder or its mav0. Without cam1 it is a monocular recording of the
    left camera.

    Args:
        path: the folder.
        calibration: replaces the cameras of each sensor.yaml, which may be missing. Without one, it
            is Kalibr's file beside mav0 or in dso/.

    Raises:
        RecordingError: data.csv is missing or malformed, or no two images have the same time.
        CalibrationError: a sensor.yaml is missing or not usable, and there is no calibration.
        TrajectoryError: the ground truth is malformed, or matches no frame.
    """
    mav = _find_mav(path)
    if mav is None:
        raise RecordingError(f"{path}: not an EuRoC recording, which has {EXPECTED_FILES}")
    t_ns, left = _read_csv(mav / "cam0" / "data.csv")
    sensor, rig, notes = _read_sensors(mav, left, calibration)
    right = None
    if rig is not None:
        others, images = _read_csv(mav / "cam1" / "data.csv")
        pairs, lost = match_times(t_ns, others, MAX_PAIR_DELAY_MS, str(mav), ("cam0", "cam1"))
        notes = (*notes, *lost)
        t_ns, left = [t_ns[row] for row, _ in pairs], [left[row] for row, _ in pairs]
        right = RightImages([images[row] for _, row in pairs], rig)
    names = [image.relative_to(path).as_posix() for image in left]
    name = mav.resolve().parent.name if mav.resolve().name == "mav0" else path.resolve().name
    poses = _read_ground_truth(mav, t_ns, sensor)
    return Recording(name, path, names, t_ns, poses, sensor.camera, right, notes=notes)


def _read_sensors(
    mav: Path, images: list[Path], calibration: CalibrationForSize | None
) -> tuple[SensorFile, StereoRig | None, tuple[str, ...]]:
    """Return the left sensor, the rig of a pair, and notes."""
    files = [mav / f"cam{number}" / "sensor.yaml" for number in (0, 1)]
    is_pair, has_sensors = (mav / "cam1" / "data.csv").is_file(), files[0].is_file()
    if not has_sensors:
        folders = [folder for folder in (mav.parent, mav.parent / "dso") if folder.is_dir()]
        found = (find_calibration(folder) for folder in folders)
        calibration = calibration or next(
            (calibration_file for calibration_file in found if calibration_file), None
        )
    given = calibration and calibration(*first_image_size(images))
    if given is None or has_sensors:
        sensor = read_sensor(files[0])
        rig = _rig(mav, sensor, read_sensor(files[1])) if is_pair else None
        if given is None:
            return sensor, rig, ()
        mounting = sensor.body_from_cam
    else:
        rig, mounting = None, given.body_from_cam
    if is_pair:
        rig = replace_cameras(rig, given, str(mav))
    has_truth = any((mav / name / "data.csv").is_file() for name in _TRUTH_FOLDERS)
    note = f"{mav}: no sensor.yaml and no T_cam_imu: the poses of the body are used as the camera's"
    notes = (note,) if mounting is None and has_truth else ()
    return SensorFile(given.camera, mounting or Rigid3.identity()), rig, notes


def read_sensor(path: Path) -> SensorFile:
    """Read the camera model and mounting of a sensor.yaml.

    Raises:
        CalibrationError: the file, a key or a number is missing, or the model is unknown.
    """
    text = read_yaml(path)
    camera = kalibr_camera(path, text)
    mounting = np.array(require_numbers(path, text, 16, "T_BS")).reshape(4, 4)
    with CalibrationError.at(path, TrajectoryError):
        return SensorFile(camera, Rigid3.from_matrix(mounting))


def _rig(mav: Path, left: SensorFile, right: SensorFile) -> StereoRig:
    right_from_left = right.body_from_cam.inverse() @ left.body_from_cam
    try:
        return StereoRig(left.camera, right.camera, right_from_left)
    except CalibrationError as error:
        raise CalibrationError(
            f"{mav / 'cam1' / 'sensor.yaml'}: with that of cam0, {error}"
        ) from None


def _read_csv(path: Path) -> tuple[list[int], list[Path]]:
    """Return the time stamps and the images."""
    t_ns, names = read_file_list(path, RecordingError)
    return t_ns, [path.parent / "data" / name for name in names]


def _read_ground_truth(mav: Path, t_ns: list[int], sensor: SensorFile) -> list[Rigid3 | None]:
    paths = (mav / name / "data.csv" for name in _TRUTH_FOLDERS)
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return [None] * len(t_ns)
    poses = _read_asl_poses(path).interpolate(t_ns, MAX_TRUTH_GAP)
    if all(world_from_body is None for world_from_body in poses):
        raise TrajectoryError(f"{path}: none of the {len(t_ns)} frames has a pose")
    return [pose and pose @ sensor.body_from_cam for pose in poses]


def _read_asl_poses(path: Path) -> Trajectory:
    """Read the poses of an ASL ground truth data.csv: ``t [ns], px, py, pz, qw, qx, qy, qz``.
    Further columns are ignored.

    Raises:
        TrajectoryError: the file is missing or empty, columns are missing, a number is NaN, a
            rotation is invalid, or times do not increase. Names the line.
    """
    rows = read_rows(path, TrajectoryError)
    for line, tokens in rows:
        if len(tokens) < 8:
            raise TrajectoryError(f"{path}, line {line}: {len(tokens)} columns, a pose has 8")
    return timed_trajectory(path, rows, (1, 2, 3, 5, 6, 7, 4))


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_euroc, ("calibration",))
