"""Read calibrations and apply them to recordings.

A calibration is a `camera.json`, YAML of OpenCV, Kalibr or ROS, a file of another program
(`READERS`), or four numbers ``fx,fy,cx,cy`` in pixels. Four numbers and some files do not contain
the image size. So a calibration is a function of the size of the images.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from topoloc.errors import CalibrationError, RecordingError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.recordings.camera_files import (
    FILE_NAME,
    YAML_SUFFIXES,
    CameraCalibration,
    find_right_file,
    has_slam_settings,
    is_calibration,
    read_calibration_yaml,
    read_camera_json,
    read_yaml,
    yaml_image_size,
)
from topoloc.recordings.format import load_reader
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.image_io import image_size
from topoloc.recordings.recording import Recording
from topoloc.recordings.text_files import read_text

# Readers of files of other programs ("module:function"), imported when one may be at hand.
READERS = {
    "slam_settings": "topoloc.apps.formats.calibrations.slam_settings:read_slam_settings",
    "slam_files": "topoloc.apps.formats.calibrations.slam_settings:camera_files",
    "ros_pair": "topoloc.apps.formats.calibrations.ros_calibration:read_ros_pair",
    "other": "topoloc.apps.formats.calibrations.other_cameras:read_other_camera",
}

CalibrationForSize = Callable[[int, int], CameraCalibration]
"""Returns the calibration for images of this width and height (pixels). Raises CalibrationError."""
# The principal point of a camera lies within a few percent of the image centre. A larger offset
# indicates another image size or a cropped image.
_SIZE_TOLERANCE, _SCALE_TOLERANCE = 0.12, 0.08


def parse_calibration(text: str | Path, allow_files: bool = True) -> CalibrationForSize:
    """Read a calibration from four numbers ``fx,fy,cx,cy`` (pixels), or from a file if allowed.

    Raises:
        CalibrationError: the text is neither, or the file is not usable. Names the file.
    """
    path = Path(text)
    if not allow_files or ("," in str(text) and not os.path.exists(path)):
        return _parse_intrinsics(str(text))
    if path.suffix.lower() in YAML_SUFFIXES or is_calibration(path):
        _read_yaml_calibration(path, 1000, 1000)  # raises errors before the first image is read
        return lambda width, height: _read_yaml_calibration(path, width, height)
    if path.name == "cameras.bin":
        raise CalibrationError(
            f"{path}: not a text file; `colmap model_converter --output_type TXT` writes"
            " cameras.txt of it"
        )
    text = read_text(path, CalibrationError, "no such camera file")
    if calibration := load_reader(READERS["other"])(path, text, camera_from_intrinsics):
        return calibration
    if path.suffix.lower() != ".json" and not text.lstrip().startswith("{"):
        raise CalibrationError(
            f"{path}: no known calibration; write a camera.json (docs/recordings.md), or give"
            " fx,fy,cx,cy"
        )
    camera_calibration = read_camera_json(path)
    return lambda width, height: camera_calibration


def _read_yaml_calibration(path: Path, width: int, height: int) -> CameraCalibration:
    text = read_yaml(path)
    size = float(width), float(height)
    if has_slam_settings(text):
        return load_reader(READERS["slam_settings"])(path, text, size)
    if right_file := find_right_file(path):
        size = yaml_image_size(text) or size
        if calibration := load_reader(READERS["ros_pair"])(path, right_file, size):
            return calibration
    return read_calibration_yaml(path, width, height)


def _parse_intrinsics(text: str) -> CalibrationForSize:
    """Return the pinhole calibration of four numbers ``fx,fy,cx,cy`` (pixels). Raises
    CalibrationError."""
    try:
        fx, fy, cx, cy = map(float, text.split(","))
    except ValueError:
        raise CalibrationError(
            f"{text[:80]}: neither a file nor four numbers fx,fy,cx,cy"
        ) from None
    Camera.pinhole(1, 1, fx, fy, cx, cy)  # raises errors before the first image is read
    return lambda *size: CameraCalibration(camera_from_intrinsics(fx, fy, cx, cy, *size))


def camera_from_intrinsics(
    fx: float, fy: float, cx: float, cy: float, width: int, height: int
) -> Camera:
    """Return the pinhole camera model of four numbers and an image size (pixels).

    Raises:
        CalibrationError: the principal point belongs to another image size, or to an image rotated
            by 90 degrees.
    """
    camera = Camera.pinhole(width, height, fx, fy, cx, cy)
    its_width, its_height = 2.0 * cx + 1.0, 2.0 * cy + 1.0
    across, down = its_width / width, its_height / height
    if min(across, down) > 0.0 and max(abs(across - 1.0), abs(down - 1.0)) > _SIZE_TOLERANCE:
        is_turned = _is_close(its_width, float(height)) and _is_close(its_height, float(width))
        is_inside = 0.0 < cx < width and 0.0 < cy < height
        if is_turned or _is_close(across, down, _SCALE_TOLERANCE) or not is_inside:
            other = (
                f"turned by 90 degrees, of about {height}x{width}"
                if is_turned
                else f"of about {its_width:.0f}x{its_height:.0f} pixels"
            )
            raise CalibrationError(
                f"fx,fy,cx,cy = {fx:g},{fy:g},{cx:g},{cy:g} are those of a picture {other}; this"
                f" one has {width}x{height} (a camera.json says for which size it is, where this is"
                " meant)"
            )
    return camera


def find_calibration(folder: Path) -> CalibrationForSize | None:
    """Return the calibration in a recording's folder: camera.json, or the only YAML file with a
    calibration and the files that belong to it. Return None if there is none.

    Raises:
        CalibrationError: the calibration is not usable, or there are several.
    """
    if (folder / FILE_NAME).is_file():
        return parse_calibration(folder / FILE_NAME)
    found = [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in YAML_SUFFIXES and path.is_file() and is_calibration(path)
    ]
    parts = {find_right_file(path) for path in found}
    for path in found:
        parts.update(load_reader(READERS["slam_files"])(path, read_yaml(path)))
    found = [path for path in found if path not in parts]
    if len(found) > 1:
        raise CalibrationError(
            f"{folder}: several calibrations ({', '.join(path.name for path in found)}); name one"
            " with --camera"
        )
    return parse_calibration(found[0]) if found else None


def complete_calibration(given: CalibrationForSize, folder: Path) -> CalibrationForSize:
    """Return `given` with the missing parts taken from the calibration in the recording's folder.
    These are the baseline of a rectified stereo pair and the depth factor."""

    def for_size(width: int, height: int) -> CameraCalibration:
        calibration = given(width, height)
        with suppress(CalibrationError):
            if own := find_calibration(folder):
                of_folder, rig = own(width, height), calibration.rig
                if rig is None and of_folder.rig is not None and of_folder.rig.is_rectified:
                    rig = StereoRig.rectified(calibration.camera, of_folder.rig.baseline)
                units = calibration.depth_factor or of_folder.depth_factor
                return CameraCalibration(calibration.camera, rig, units)
        return calibration

    return for_size


def with_calibration(sequence: StereoSequence, calibration: CalibrationForSize) -> StereoSequence:
    """Return a recording with its own calibration replaced.

    A calibration of one camera replaces both cameras of a rectified stereo pair, and the camera of
    registered depth.

    Raises:
        CalibrationError: the calibration is not usable, or it is of one camera and the stereo pair
            is not rectified.
        RecordingError: the calibration of this type of recording cannot be replaced.
    """
    if not isinstance(sequence, Recording):
        raise RecordingError(
            f"{sequence.name}: a recording of this kind keeps its own calibration; --camera does"
            " not go with it"
        )
    images = [sequence.root / name for name in sequence.names]
    given = calibration(*first_image_size(images, sequence.as_stored))
    right, depth = sequence.right, sequence.depth
    if right is not None:
        right = replace(right, rig=replace_cameras(right.rig, given, sequence.name))
    if depth is not None:
        registered = depth.camera is not None and depth.camera == sequence.camera
        camera = given.camera if registered else depth.camera
        units = given.depth_factor or depth.units_per_metre
        depth = replace(depth, camera=camera, units_per_metre=units)
    return replace(sequence, camera=given.camera, cameras=None, right=right, depth=depth)


def replace_cameras(rig: StereoRig | None, given: CameraCalibration, where: str) -> StereoRig:
    """Return the given rig, or a rectified one with the given camera and the same baseline.

    Raises:
        CalibrationError: the given one is of one camera and `rig` is not rectified, or None. Begins
            with `where`.
    """
    if given.rig is not None:
        return given.rig
    if rig is None or not rig.is_rectified:
        fault = "its stereo pair is not rectified" if rig else "the right camera's place is unknown"
        raise CalibrationError(f"{where}: {fault}, so that --camera needs a file of both cameras")
    return StereoRig.rectified(given.camera, rig.baseline)


def first_image_size(images: Sequence[Path], as_stored: bool = False) -> tuple[int, int]:
    """Return the width and height of the first readable image. Return (0, 0) if none can be read,
    because reading the images reports the error later."""
    for path in images:
        with suppress(UnreadableImageError):
            return image_size(path, as_stored)
    return 0, 0


def _is_close(one: float, other: float, tolerance: float = _SIZE_TOLERANCE) -> bool:
    return abs(one - other) <= tolerance * other
