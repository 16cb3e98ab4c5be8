"""kapture, the folder of text files of Naver Labs, as a recording of single images with poses.

``sensors/sensors.txt`` holds the cameras by COLMAP's models, ``records_camera.txt`` the images and
``trajectories.txt`` the poses (cam_from_world, or rig_from_world with ``rigs.txt``). The format
names no unit. Images without a pose are frames without one. See kapture's ``kapture_format.adoc``.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from topoloc import (
    CalibrationError,
    Camera,
    RecordingError,
    Rigid3,
    StereoSequence,
    TopolocError,
    TrajectoryError,
)
from topoloc.apps.core_names import CalibrationForSize, parse_numbers, with_calibration
from topoloc.apps.formats.colmap import times_from_names
from topoloc.plugin import (
    Recording,
    RecordingFormat,
    natural_key,
    parse_relative_path,
    read_text,
)

EXPECTED_FILES = "sensors/sensors.txt and sensors/records_camera.txt of kapture"
_TIME = re.compile(r"[0-9]{1,20}")


def can_open(path: Path) -> bool:
    """Return whether this is a folder with cameras and images of kapture."""
    folder = path / "sensors"
    return all((folder / name).is_file() for name in ("sensors.txt", "records_camera.txt"))


def open_kapture(path: Path, calibration: CalibrationForSize | None = None) -> StereoSequence:
    """Open a folder of kapture. `calibration` replaces its cameras. Raises RecordingError: a list
    is missing or malformed; CalibrationError: the camera of an image is not listed, or not
    calibrated; TrajectoryError: a row is no pose."""
    folder = path / "sensors"
    file = folder / "records_camera.txt"
    records = _rows(file, 3, RecordingError, timed=True)
    records.sort(key=lambda row: (int(row[1][0]), natural_key(row[1][2])))
    names = [
        parse_relative_path(tokens[2], f"{file}, line {line}", RecordingError)
        for line, tokens in records
    ]
    keys = [(int(time), device) for _, (time, device, *_) in records]
    poses = _poses(folder, keys)
    notes = (
        (f"{path}: kapture names no unit: positions are taken as metres; else give --scale",)
        if any(pose is not None for pose in poses)
        else ()
    )
    t_ns = times_from_names([str(time) for time, _ in keys])
    place = path.resolve().name, folder / "records_data", names, t_ns, poses
    if calibration is not None:
        return with_calibration(Recording(*place, None, notes=notes), calibration)
    cameras = _cameras(folder / "sensors.txt", {device for _, device in keys})
    of_images = [cameras[device] for _, device in keys]
    return replace(Recording.with_cameras(*place, of_images, as_stored=True), notes=notes)


def _rows(
    file: Path, num: int, error: type[TopolocError], timed: bool = False
) -> list[tuple[int, list[str]]]:
    """Return line numbers and columns of a file of comma-separated values. Raises `error`: a line
    has fewer than `num` columns, there is none, or the first column is no integer (`timed`)."""
    rows = []
    for number, line in enumerate(read_text(file, error).splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            tokens = [token.strip() for token in line.split(",")]
            if len(tokens) < num:
                raise error(f"{file}, line {number}: {len(tokens)} columns, not {num}")
            if timed and not _TIME.fullmatch(tokens[0]):
                raise error(f"{file}, line {number}: {tokens[0][:40]!r} is no time, an integer")
            rows.append((number, tokens))
    if not rows:
        raise error(f"{file}: nothing in this file")
    return rows


def _cameras(file: Path, used: set[str]) -> dict[str, Camera]:
    """Return the cameras that images use by their ids."""
    sensors = {row[1][0]: row for row in _rows(file, 3, CalibrationError)}
    cameras = {}
    for device in sorted(used):
        if device not in sensors:
            raise CalibrationError(f"{file}: no camera {device[:80]!r}, which images name")
        line, (_, _, kind, *params) = sensors[device]
        where = f"{file}, line {line}"
        if kind != "camera" or len(params) < 3 or params[0] == "UNKNOWN_CAMERA":
            raise CalibrationError(f"{where}: no calibrated camera; give --camera")
        try:
            width, height, *numbers = map(float, params[1:])
        except ValueError:
            raise CalibrationError(f"{where}: the parameters of a camera are numbers") from None
        with CalibrationError.at(where):
            size = int(width), int(height)
            cameras[device] = Camera.from_colmap(params[0], *size, tuple(numbers))
    return cameras


def _poses(folder: Path, keys: list[tuple[int, str]]) -> list[Rigid3 | None]:
    """Return world_from_cam of each time and camera, of the camera itself or of a rig with it."""
    file, rigs_file = folder / "trajectories.txt", folder / "rigs.txt"
    if not file.is_file():
        return [None] * len(keys)
    rows = _rows(file, 9, TrajectoryError, timed=True)
    devices_from_world = {
        (int(time), device): pose
        for (_, (time, device, *_)), pose in zip(rows, _read_poses(file, rows), strict=True)
    }
    rig_rows = _rows(rigs_file, 9, TrajectoryError) if rigs_file.is_file() else []
    cams_from_rigs = {
        (tokens[1], tokens[0]): pose
        for (_, tokens), pose in zip(rig_rows, _read_poses(rigs_file, rig_rows), strict=True)
        if pose is not None
    }
    poses = list[Rigid3 | None]()
    for time, device in keys:
        cam_from_world = devices_from_world.get((time, device))
        for (camera, rig), cam_from_rig in cams_from_rigs.items():
            rig_from_world = devices_from_world.get((time, rig))
            if cam_from_world is None and camera == device and rig_from_world is not None:
                cam_from_world = cam_from_rig @ rig_from_world
        poses.append(cam_from_world and cam_from_world.inverse())
    return poses


def _read_poses(file: Path, rows: list[tuple[int, list[str]]]) -> list[Rigid3 | None]:
    """Return the poses of rows of two names, a quaternion (w first) and a translation. A pose may
    lack one of these: it is None."""
    whole = [row for row in rows if all(row[1][2:9])]
    poses: dict[int, Rigid3] = {}
    numbers = parse_numbers(file, whole, range(2, 9)) if whole else []
    for (line, _), row in zip(whole, numbers, strict=True):
        with TrajectoryError.at(f"{file}, line {line}"):
            poses[line] = Rigid3.from_quat_wxyz(row[:4], row[4:])
    return [poses.get(line) for line, _ in rows]


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_kapture, ("calibration",))
