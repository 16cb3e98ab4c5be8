"""Read ``camera.json``, the calibration of a recording or a query without a calibration of its
own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgspec import Struct

from topoloc.errors import CalibrationError
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
