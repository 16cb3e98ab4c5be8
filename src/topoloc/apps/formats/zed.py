"""Recordings of Stereolabs' ZED cameras: side-by-side images of a USB camera, and ``.svo`` files.

The left image is the left half. Both are distorted. The calibration is Stereolabs' ``SN*.conf``
beside the video. Rectified halves have a camera.json of one half with a baseline instead.
"""

from __future__ import annotations

import configparser
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from topoloc import (
    CalibrationError,
    Camera,
    Image,
    RecordingError,
    Rigid3,
    StereoFrame,
    StereoRig,
    StereoSequence,
)
from topoloc.apps.formats.live import LiveSource
from topoloc.apps.formats.svo import SVO_SUFFIXES, open_svo
from topoloc.plugin import IndexedFrames, RecordingFormat, Video, read_camera_json, read_text

EXPECTED_FILES = "a video of left and right side by side with SN*.conf beside it, or .svo"
# Stereolabs' names of the image sizes.
RESOLUTIONS = {
    (2208, 1242): "2K",
    (1920, 1080): "FHD",
    (1920, 1200): "FHD1200",
    (1280, 720): "HD",
    (960, 600): "SVGA",
    (672, 376): "VGA",
}
_MIN_ASPECT_RATIO = 2.5  # of two images side by side; that of a single one is 1.8 at most
_CONF_NAME = re.compile(r"sn\d+\.conf", re.IGNORECASE)


def can_open(path: Path) -> bool:
    """Return whether this is an SVO file, or a side-by-side video with an SN*.conf beside it."""
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


@dataclass(frozen=True, eq=False, repr=False)
class SideBySideVideo(IndexedFrames):
    """A StereoSequence of the two halves of a video."""

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
        """Return the recording without the right halves."""
        return replace(self, with_right=False)

    def read_frame(self, row: int) -> StereoFrame:
        """Read one frame. See `Video` for errors."""
        frame = self.video.read_frame(row)
        left, right = _split_halves(frame.image)
        frame = replace(frame, image=left, camera=self.rig.left)
        return replace(frame, right=right, rig=self.rig) if self.with_right else frame


def open_zed(path: Path, calibration: str | Path | None = None) -> StereoSequence:
    """Open a side-by-side video or an SVO file. Truth is ``NAME.tum`` beside ``NAME.mp4``. Raises
    RecordingError: the file is no video of two images side by side; CalibrationError: there is no
    calibration, or several, or it is invalid; TrajectoryError: the truth is malformed or fits no
    frame; MissingExtraError: Stereolabs' SDK for an SVO file is not installed.

    Args:
        calibration: SN*.conf of a video, or a camera.json of one half with a baseline (metres). By
            default the one beside the video.
    """
    if path.suffix.lower() in SVO_SUFFIXES:
        return open_svo(path)
    video = Video.open(path)
    width, height = video.size
    if not _is_side_by_side(width, height):
        raise RecordingError(f"{path}: {width}x{height} pixels are not two images side by side")
    file = _find_calibration_file(path) if calibration is None else Path(calibration)
    return SideBySideVideo(video, _read_rig(file, (width // 2, height)))


def side_by_side_frames(source: LiveSource, calibration: Path) -> Iterator[StereoFrame]:
    """Yield both halves of each image of a live source, distorted. `calibration`: Stereolabs'
    SN*.conf, or a camera.json of one half with a baseline. Raises RecordingError: the images are
    not two side by side, or the source stalls; CalibrationError: the calibration is invalid or of
    another resolution."""
    rig: StereoRig | None = None
    for picture in source:
        height, width = picture.image.shape[:2]
        if not _is_side_by_side(width, height):
            raise RecordingError(
                f"{source.source}: {width}x{height} pixels are not two images side by side; use"
                " --size to request another size"
            )
        rig = rig or _read_rig(calibration, (width // 2, height))
        left, right = _split_halves(picture.image)
        yield StereoFrame(f"{picture.number:06d}", picture.t_ns, left, rig.left, right, rig)


def _is_side_by_side(width: int, height: int) -> bool:
    return width % 2 == 0 and width >= _MIN_ASPECT_RATIO * height


def _split_halves(image: Image) -> tuple[np.ndarray, np.ndarray]:
    width = image.shape[1] // 2
    return np.ascontiguousarray(image[:, :width]), np.ascontiguousarray(image[:, width:])


def _read_rig(path: Path, size: tuple[int, int]) -> StereoRig:
    """Return the rig of halves of this size. Raises CalibrationError."""
    is_json = path.suffix.lower() == ".json"
    rig = read_camera_json(path).rig if is_json else read_conf(path, size)
    if rig is None:
        raise CalibrationError(f"{path}: no baseline (metres) between the two images")
    if (rig.left.width, rig.left.height) != size:
        raise CalibrationError(
            f"{path}: of {rig.left.width}x{rig.left.height}, but each half is {size[0]}x{size[1]}"
        )
    return rig


def read_conf(path: Path, size: tuple[int, int]) -> StereoRig:
    """Return the rig of Stereolabs' SN*.conf for images of this size.

    The file has lengths in mm and the rotation vector (RX, CV, RZ) in radians. Raises
    CalibrationError: the file is missing or malformed, lacks this resolution, or a number is
    missing or invalid.
    """
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    try:
        parser.read_string(read_text(path, CalibrationError, "no such calibration"))
    except configparser.Error as error:
        raise CalibrationError(
            f"{path}: not a calibration of Stereolabs ({' '.join(str(error).split())[:100]})"
        ) from None
    conf = {name.upper().strip(): dict(parser[name]) for name in parser.sections()}
    there = [name.removeprefix("LEFT_CAM_") for name in conf if name.startswith("LEFT_CAM_")]
    shown, resolution = f"{size[0]}x{size[1]}", RESOLUTIONS.get(size)
    if resolution is None:
        known = ", ".join(f"{width}x{height}" for width, height in RESOLUTIONS)
        raise CalibrationError(f"{path}: a ZED has no images of {shown}; its sizes are {known}")
    if resolution not in there or f"RIGHT_CAM_{resolution}" not in conf:
        known = ", ".join(there) or "nothing"
        raise CalibrationError(f"{path}: no calibration of {resolution} ({shown}), only of {known}")
    left, right = (
        _camera(path, conf, f"{side}_CAM_{resolution}", size) for side in ("LEFT", "RIGHT")
    )
    stereo = conf.get("STEREO", {})
    baseline = _number(path, stereo, "STEREO", "baseline")

    def of_resolution(axis: str, default: float = 0.0) -> float:
        return _number(path, stereo, "STEREO", f"{axis}_{resolution.lower()}", default)

    defaults = {axis: _number(path, stereo, "STEREO", axis, 0.0) for axis in ("ty", "tz")}
    across = [of_resolution(axis, default) for axis, default in defaults.items()]
    turn = [of_resolution(axis) for axis in ("rx", "cv", "rz")]
    if not baseline > 0.0:
        raise CalibrationError(f"{path}: STEREO baseline of {baseline:g} mm")
    translation = -np.array([baseline, *across]) / 1000.0
    rotation = Rigid3.exp(np.array([0.0, 0.0, 0.0, *turn])).rotation
    return StereoRig(left, right, Rigid3(rotation, translation))


def _camera(
    path: Path, conf: dict[str, dict[str, str]], section: str, size: tuple[int, int]
) -> Camera:
    intrinsics = [_number(path, conf[section], section, key) for key in ("fx", "fy", "cx", "cy")]
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    coefficients = [_number(path, conf[section], section, key, 0.0) for key in names]
    is_full = any(coefficients[4:])
    params = (*intrinsics, *coefficients[: 8 if is_full else 4])
    with CalibrationError.at(f"{path}, {section}"):
        return Camera("FULL_OPENCV" if is_full else "OPENCV", *size, params)


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
        fault = "missing" if text is None else f"{text[:40]!r}, not a number"
        raise CalibrationError(f"{path}, {section}: {key} is {fault}")
    return number


def _find_calibration_file(path: Path) -> Path:
    confs = _list_conf_files(path.parent)
    if len(confs) > 1:
        raise CalibrationError(
            f"{path}: several calibrations beside it ({', '.join(conf.name for conf in confs)});"
            " use --camera"
        )
    if not confs and not (path.parent / "camera.json").is_file():
        raise CalibrationError(
            f"{path}: no SN*.conf beside it; get it from Stereolabs by the serial number, and use"
            " --camera"
        )
    return confs[0] if confs else path.parent / "camera.json"


def _list_conf_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if _CONF_NAME.fullmatch(path.name))


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_zed, ("calibration_file",))
