"""Recordings of Stereolabs' ZED cameras: side-by-side video, as every ZED gives it as a USB camera,
and ``.svo`` through their SDK.

The left picture is the left half. The pictures are as the sensor has them, distorted; the
calibration is Stereolabs' ``SN*.conf`` beside the video (or a camera.json of one half with a
baseline, where the halves are rectified already).
"""

from __future__ import annotations

import configparser
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from topoloc import (
    CalibrationError,
    Camera,
    RecordingError,
    Rigid3,
    StereoFrame,
    StereoRig,
    StereoSequence,
)
from topoloc.apps.formats.svo import SVO_SUFFIXES, open_svo
from topoloc.plugin import RecordingFormat, Video, read_camera_json, read_text

EXPECTED_FILES = "a video of left and right side by side with SN*.conf beside it, or .svo"
# Stereolabs' names of the sizes of one picture.
RESOLUTIONS = {
    (2208, 1242): "2K",
    (1920, 1080): "FHD",
    (1920, 1200): "FHD1200",
    (1280, 720): "HD",
    (960, 600): "SVGA",
    (672, 376): "VGA",
}
_MIN_ASPECT_RATIO = 2.5  # width to height of two pictures side by side; a single one is 1.8 at most
_CONF_NAME = re.compile(r"sn\d+\.conf", re.IGNORECASE)


def can_open(path: Path) -> bool:
    """Whether this is an SVO file, or a video as wide as two pictures that has an SN*.conf beside
    it."""
    if not path.is_file():
        return False
    if path.suffix.lower() in SVO_SUFFIXES:
        return True
    if not Video.can_open(path) or not _list_conf_files(path.parent):
        return False
    try:
        width, height = Video.read_size(path)
    except RecordingError:
        return False
    return width >= _MIN_ASPECT_RATIO * height


@dataclass(frozen=True, eq=False)
class SideBySideVideo:
    """A StereoSequence of the two halves of each frame of a video."""

    video: Video
    rig: StereoRig
    with_right: bool = True

    @property
    def name(self) -> str:
        return self.video.name

    @property
    def names(self) -> list[str]:
        return self.video.names

    @property
    def t_ns(self) -> list[int]:
        return self.video.t_ns

    @property
    def poses(self) -> list[Rigid3 | None]:
        return self.video.poses

    def __len__(self) -> int:
        return len(self.video)

    def monocular(self) -> SideBySideVideo:
        """The same recording without the right halves."""
        return replace(self, with_right=False)

    def __getitem__(self, index: int) -> StereoFrame:
        """Read one frame. Raises as `Video` does."""
        frame = self.video[index]
        width = self.rig.left.width
        left, right = (
            np.ascontiguousarray(half) for half in (frame.image[:, :width], frame.image[:, width:])
        )
        frame = replace(frame, image=left, camera=self.rig.left)
        return replace(frame, right=right, rig=self.rig) if self.with_right else frame


def open_zed(path: Path, calibration: str | Path | None = None) -> StereoSequence:
    """Open a side-by-side video or an SVO file. Truth is ``NAME.tum`` beside ``NAME.mp4``.

    Args:
        calibration: of a video, the SN*.conf, or a camera.json of one half with a baseline
            (metres); by default those beside it.

    Raises:
        RecordingError: no video, or not of two pictures side by side.
        CalibrationError: no calibration, several, of another resolution, or not usable.
        TrajectoryError: the truth is malformed or fits no frame.
        MissingExtraError: an SVO file, and Stereolabs' SDK is not installed.
    """
    if path.suffix.lower() in SVO_SUFFIXES:
        return open_svo(path)
    video = Video.open(path)
    width, height = video.size
    if not is_side_by_side(width, height):
        raise RecordingError(f"{path}: {width}x{height} pixels are not two pictures side by side")
    file = _find_calibration_file(path) if calibration is None else Path(calibration)
    rig = read_rig(file, (width // 2, height))
    if (rig.left.width, rig.left.height) != (width // 2, height):
        raise CalibrationError(
            f"{file}: of {rig.left.width}x{rig.left.height}, but each half of {path.name} is"
            f" {width // 2}x{height}"
        )
    return SideBySideVideo(video, rig)


def is_side_by_side(width: int, height: int) -> bool:
    """Whether a picture of so many pixels can be two."""
    return width % 2 == 0 and width >= _MIN_ASPECT_RATIO * height


def read_rig(path: Path, size: tuple[int, int]) -> StereoRig:
    """The pair of an SN*.conf for halves of this size, or of a camera.json with a baseline. Raises
    CalibrationError."""
    return _read_rectified_rig(path) if path.suffix.lower() == ".json" else read_conf(path, size)


def read_conf(path: Path, size: tuple[int, int]) -> StereoRig:
    """The pair of Stereolabs' SN*.conf for pictures of this size: lengths in mm, the rotation (RX,
    CV, RZ) a vector in radians.

    Raises:
        CalibrationError: missing, not of this form, without this resolution, or a number that is
            missing or makes no sense.
    """
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        parser.read_string(read_text(path, CalibrationError, "no such calibration"))
    except configparser.Error as error:
        raise CalibrationError(
            f"{path}: not a calibration of Stereolabs' form ({' '.join(str(error).split())[:100]})"
        ) from None
    conf = {name.upper().strip(): dict(parser[name]) for name in parser.sections()}
    there = [name.removeprefix("LEFT_CAM_") for name in conf if name.startswith("LEFT_CAM_")]
    shown = f"{size[0]}x{size[1]}"
    resolution = RESOLUTIONS.get(size)
    if resolution is None:
        known = ", ".join(f"{width}x{height}" for width, height in RESOLUTIONS)
        raise CalibrationError(f"{path}: a ZED has no pictures of {shown}; its sizes are {known}")
    if resolution not in there or f"RIGHT_CAM_{resolution}" not in conf:
        raise CalibrationError(
            f"{path}: no calibration of {resolution} ({shown}), which the pictures are; it has"
            f" {', '.join(there) or 'none'}"
        )
    left, right = (
        _camera(path, conf, f"{side}_CAM_{resolution}", size) for side in ("LEFT", "RIGHT")
    )
    stereo = conf.get("STEREO", {})
    baseline = _number(path, stereo, "STEREO", "baseline")
    across = [
        _number(
            path,
            stereo,
            "STEREO",
            f"{axis}_{resolution.lower()}",
            _number(path, stereo, "STEREO", axis, 0.0),
        )
        for axis in ("ty", "tz")
    ]
    turn = [
        _number(path, stereo, "STEREO", f"{axis}_{resolution.lower()}", 0.0)
        for axis in ("rx", "cv", "rz")
    ]
    if not baseline > 0.0:
        raise CalibrationError(f"{path}: STEREO baseline of {baseline:g} mm")
    translation = -np.array([baseline, *across]) / 1000.0
    rotation = Rigid3.exp(np.array([0.0, 0.0, 0.0, *turn])).rotation
    return StereoRig(left, right, Rigid3(rotation, translation))


def _camera(
    path: Path, conf: dict[str, dict[str, str]], section: str, size: tuple[int, int]
) -> Camera:
    intrinsics = [_number(path, conf[section], section, key) for key in ("fx", "fy", "cx", "cy")]
    coefficients = [
        _number(path, conf[section], section, key, 0.0)
        for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    ]
    model, params = (
        ("FULL_OPENCV", coefficients) if any(coefficients[4:]) else ("OPENCV", coefficients[:4])
    )
    try:
        return Camera(model, *size, (*intrinsics, *params))
    except CalibrationError as error:
        raise CalibrationError(f"{path}, {section}: {error}") from None


def _number(
    path: Path, values: dict[str, str], section: str, key: str, default: float | None = None
) -> float:
    text = values.get(key)
    if text is None and default is not None:
        return default
    try:
        number = float(text) if text is not None else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise CalibrationError(
            f"{path}, {section}: {key} is"
            f" {'missing' if text is None else f'{text[:40]!r}, not a number'}"
        )
    return number


def _read_rectified_rig(path: Path) -> StereoRig:
    rig = read_camera_json(path).rig
    if rig is None:
        raise CalibrationError(
            f"{path}: no baseline (metres), which two pictures side by side need"
        )
    return rig


def _find_calibration_file(path: Path) -> Path:
    confs = _list_conf_files(path.parent)
    if len(confs) > 1:
        raise CalibrationError(
            f"{path}: several calibrations beside it ({', '.join(conf.name for conf in confs)});"
            " --camera names one"
        )
    if not confs and not (path.parent / "camera.json").is_file():
        raise CalibrationError(
            f"{path}: no SN*.conf beside it; Stereolabs has that of each camera by its serial"
            " number, --camera names it"
        )
    return confs[0] if confs else path.parent / "camera.json"


def _list_conf_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if _CONF_NAME.fullmatch(path.name))


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_zed, ("calibration_file",))
