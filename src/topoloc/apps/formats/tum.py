"""Read TUM RGB-D (Sturm et al., IROS 2012): ``rgb.txt``, ``depth.txt``, ``groundtruth.txt``. Depth
is registered to colour.

The intrinsics are those published with the data set for its three cameras. The freiburg1 / 2 / 3 in
the folder's name selects one. Other recordings of this layout need a ``camera.json``.
"""

from __future__ import annotations

import re
from pathlib import Path

from topoloc import CalibrationError, Camera, RecordingError, Rigid3
from topoloc.apps.core_names import CalibrationForSize, first_image_size
from topoloc.apps.formats.image_lists import match_times, read_file_list
from topoloc.plugin import (
    CameraCalibration,
    DepthImages,
    Recording,
    RecordingFormat,
    read_camera_json,
    read_ground_truth,
)

EXPECTED_FILES = "rgb.txt and depth.txt"
DEPTH_FACTOR = 5000.0
MAX_DEPTH_DELAY_MS = 20
_FREIBURG = {
    "1": (517.3, 516.5, 318.6, 255.3, 0.2624, -0.9531, -0.0054, 0.0026, 1.1633, 0.0, 0.0, 0.0),
    "2": (520.9, 521.0, 325.1, 249.7, 0.2312, -0.7849, -0.0033, -0.0001, 0.9172, 0.0, 0.0, 0.0),
    "3": (535.4, 539.2, 320.1, 247.6),
}


def can_open(path: Path) -> bool:
    """Return whether both lists exist."""
    return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()


def open_tum(path: Path, calibration: CalibrationForSize | None = None) -> Recording:
    """Open a recording. A colour image without depth within 20 ms is skipped.

    Args:
        path: the folder.
        calibration: replaces the folder's calibration.

    Raises:
        RecordingError: a list is missing or malformed, or no colour image has depth.
        CalibrationError: neither a camera.json with depth_factor nor freiburg in the name.
        TrajectoryError: the ground truth is malformed or matches no frame.
    """
    colour_times, colour = read_file_list(path / "rgb.txt", RecordingError)
    if calibration:
        found = calibration(*first_image_size([path / name for name in colour]))
    else:
        found = _calibration(path)
    depth_times, depth = read_file_list(path / "depth.txt", RecordingError)
    pairs, notes = match_times(
        colour_times, depth_times, MAX_DEPTH_DELAY_MS, str(path), ("rgb.txt", "depth.txt")
    )
    t_ns = [colour_times[row] for row, _ in pairs]
    poses = read_ground_truth(path / "groundtruth.txt", [], t_ns)
    paths, units = [path / depth[row] for _, row in pairs], _depth_factor(path, found)
    images = DepthImages(paths, units, None, Rigid3.identity())
    frames = ([colour[row] for row, _ in pairs], t_ns, poses)
    return Recording(path.resolve().name, path, *frames, found.camera, depth=images, notes=notes)


def _calibration(path: Path) -> CameraCalibration:
    if (file := path / "camera.json").is_file():
        return read_camera_json(file)
    number = _find_freiburg(path)
    if number is None:
        raise CalibrationError(
            f"{file}: no calibration here, and the folder's name does not say freiburg1, 2 or 3"
        )
    params = _FREIBURG[number[1]]
    model = "PINHOLE" if len(params) == 4 else "FULL_OPENCV"
    return CameraCalibration(Camera(model, 640, 480, params))


def _depth_factor(path: Path, found: CameraCalibration) -> float:
    if found.depth_factor is None and _find_freiburg(path) is None:
        raise CalibrationError(
            f'{path / "camera.json"}: no "depth_factor" here, and the folder\'s name does not say'
            " freiburg1, 2 or 3; add the units a metre of its depth images: 1000 for millimetres,"
            f" {DEPTH_FACTOR:g} as the data set has them"
        )
    return found.depth_factor or DEPTH_FACTOR


def _find_freiburg(path: Path) -> re.Match[str] | None:
    return re.search(r"freiburg([123])", path.resolve().name)


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_tum, ("calibration",))
