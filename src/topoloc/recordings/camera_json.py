"""Read ``camera.json``, the calibration of a recording or a query without a calibration of its
own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.recordings.json_file import json_number, json_rigid, read_json

FILE_NAME = "camera.json"


@dataclass(frozen=True)
class CameraCalibration:
    """Hold a camera model, and the `rig` of a stereo pair. The camera is the left one of the pair.
    `depth_factor` is in file units per metre."""

    camera: Camera
    rig: StereoRig | None = None
    depth_factor: float | None = None


def read_camera_json(path: Path) -> CameraCalibration:
    """Read a camera.json.

    It holds one camera, optionally with the "baseline" (metres) of a rectified stereo pair whose
    left camera it is. Or it holds a stereo pair of any calibration: "left", "right" and
    "right_from_left" (4x4, metres).

    Raises:
        CalibrationError: the file is missing, is not JSON, or a key is missing or out of range.
            Names the file.
    """
    data = read_json(path, CalibrationError, "no such camera file")
    if not isinstance(data, dict):
        raise CalibrationError(f"{path}: not a JSON object")
    try:
        depth_factor = _positive_number(data, "depth_factor")
        if "left" in data or "right" in data:
            rig = _stereo_rig(data)
            return CameraCalibration(rig.left, rig, depth_factor)
        camera, baseline = Camera.from_json(data), _positive_number(data, "baseline")
        return CameraCalibration(
            camera,
            None if baseline is None else StereoRig.rectified(camera, baseline),
            depth_factor,
        )
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None


def _stereo_rig(data: dict[str, Any]) -> StereoRig:
    for key in ("left", "right", "right_from_left"):
        if key not in data:
            raise CalibrationError(
                f'{key!r} is missing; a stereo pair has "left", "right" and "right_from_left" (4x4,'
                " metres)"
            )
    right_from_left = json_rigid(data["right_from_left"], "right_from_left", CalibrationError)
    return StereoRig(
        _camera_from_key(data, "left"), _camera_from_key(data, "right"), right_from_left
    )


def _camera_from_key(data: dict[str, Any], key: str) -> Camera:
    try:
        return Camera.from_json(data[key])
    except CalibrationError as error:
        raise CalibrationError(f"{key}: {error}") from None


def _positive_number(data: dict[str, Any], key: str) -> float | None:
    if data.get(key) is None:
        return None
    try:
        number = json_number(data[key], key, CalibrationError)
    except CalibrationError:
        number = -1.0
    if number <= 0.0:
        raise CalibrationError(f"{key} must be a positive number, not {str(data[key])[:40]}")
    return number
