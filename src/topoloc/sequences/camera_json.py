"""``camera.json``: the calibration of a recording whose format has none of its own, or of a query."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.sequences.text_rows import read_text

FILE_NAME = "camera.json"


@dataclass(frozen=True)
class CameraFile:
    """A camera, with the `baseline` (metres) of a rectified stereo pair or the `depth_factor` (file units a metre) of depth pictures."""

    camera: Camera
    baseline: float | None = None
    depth_factor: float | None = None


def read_camera_json(path: Path) -> CameraFile:
    """Read a camera.json.

    Raises:
        CalibrationError: missing, not JSON, a key is missing or out of range; names the file.
    """
    try:
        data = json.loads(read_text(path, CalibrationError, "no such camera file"))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: not a JSON file ({error})") from None
    if not isinstance(data, dict):
        raise CalibrationError(f"{path}: not a JSON object")
    try:
        return CameraFile(Camera.from_json(data), _positive(data, "baseline"), _positive(data, "depth_factor"))
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None


def _positive(data: dict[str, object], key: str) -> float | None:
    value = data.get(key)
    if value is None:
        return None
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
    except OverflowError:  # an integer of hundreds of digits
        number = math.inf
    if not 0.0 < number < math.inf:
        raise CalibrationError(f"{key} must be a positive number, not {str(value)[:40]}")
    return number
