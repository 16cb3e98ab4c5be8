"""A plain folder of pictures, or one picture; with a calibration in it also a stereo pair or RGB-D.

Stereo: ``left/ right/``, ``image_0/ image_1/`` or ``cam0/ cam1/`` with a ``camera.json`` of a
"baseline" (m) or of two cameras, or with YAML of OpenCV or Kalibr. RGB-D: ``rgb/`` or ``color/``,
``depth/`` registered to it, and a "depth_factor" (units a metre). Else the pictures of the folder
itself, or of ``rgb/``, ``color/``, ``left/``, ``image_0/``, ``cam0/`` or ``images/`` in it.
``times.txt``, ``truth.tum`` and ``poses.txt`` (KITTI rows) are read where they are there.
"""

from __future__ import annotations

from pathlib import Path

from topoloc.errors import CalibrationError, RecordingError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.calibration import (
    CalibrationOfSize,
    calibration_of,
    completed,
    find_calibration,
    size_of_first,
)
from topoloc.recordings.camera_json import FILE_NAME, CameraFile
from topoloc.recordings.format import SequenceFormat
from topoloc.recordings.pictures import PICTURE_SUFFIXES
from topoloc.recordings.recording import (
    DepthPictures,
    Recording,
    RightPictures,
    check_pairs,
    list_pictures,
)
from topoloc.recordings.trajectory import read_times, read_truth

LOOKS_FOR = "pictures, or left/ and right/, or rgb/ and depth/ with camera.json"
_STEREO = (("left", "right"), ("image_0", "image_1"), ("cam0", "cam1"))
_RGBD = (("rgb", "depth"), ("color", "depth"))
_MONO = ("rgb", "color", "left", "image_0", "cam0", "images")


def recognises(path: Path) -> bool:
    """Whether this is a picture, or a folder with pictures in it or in one of the known folders
    below it."""
    if path.is_file():
        return path.suffix.lower() in PICTURE_SUFFIXES
    return any(_has_pictures(folder) for folder in (path, *(path / name for name in _MONO)))


def open_folder(path: Path, calibration: CalibrationOfSize | None = None) -> Recording:
    """Open a folder of pictures, or a single picture as a recording of one frame. Without a
    calibration the camera is unknown.

    Args:
        calibration: instead of the one in the folder.

    Raises:
        RecordingError: no pictures, or left, right, depth and times differ in number.
        CalibrationError: the calibration is missing for stereo or RGB-D folders, or not usable.
        TrajectoryError: the truth is malformed or fits no frame.
    """
    if path.is_file():
        beside = path.parent / FILE_NAME
        calibration = calibration or (calibration_of(beside) if beside.is_file() else None)
        camera = calibration(*size_of_first([path])).camera if calibration else None
        return Recording(path.name, path.parent, [path.name], [0], [None], camera)
    calibration = completed(calibration, path) if calibration else find_calibration(path)
    for left, right in _STEREO:
        if (path / left).is_dir() and (path / right).is_dir():
            return _open_stereo(path, left, right, calibration)
    for colour, depth in _RGBD:
        if (path / colour).is_dir() and (path / depth).is_dir():
            return _open_rgbd(path, colour, depth, calibration)
    folder = next((path / name for name in ("", *_MONO) if _has_pictures(path / name)), None)
    if folder is None:
        raise RecordingError(f"{path}: no pictures in this folder")
    pictures = list_pictures(folder)
    return _recording(path, pictures, _sized(calibration, pictures))


def _open_stereo(
    path: Path, left: str, right: str, calibration: CalibrationOfSize | None
) -> Recording:
    left_paths, right_paths = list_pictures(path / left), list_pictures(path / right)
    camera_file = _sized(calibration, left_paths)
    if camera_file is None or camera_file.rig is None:
        raise CalibrationError(
            f"{path / FILE_NAME}: a stereo pair ({left}/, {right}/) needs this file, with a"
            ' "baseline" in metres or two cameras, or the YAML of OpenCV or Kalibr'
        )
    check_pairs(left_paths, right_paths)
    return _recording(
        path, left_paths, camera_file, right=RightPictures(right_paths, camera_file.rig)
    )


def _open_rgbd(
    path: Path, colour: str, depth: str, calibration: CalibrationOfSize | None
) -> Recording:
    colour_paths, depth_paths = list_pictures(path / colour), list_pictures(path / depth)
    camera_file = _sized(calibration, colour_paths)
    if camera_file is None or camera_file.depth_factor is None:
        raise CalibrationError(
            f"{path / FILE_NAME}: RGB-D ({colour}/, {depth}/) needs this file, with a"
            ' "depth_factor" in units a metre'
        )
    check_pairs(colour_paths, depth_paths)
    pictures = DepthPictures(
        depth_paths, camera_file.depth_factor, camera_file.camera, Rigid3.identity()
    )
    return _recording(path, colour_paths, camera_file, depth=pictures)


def _recording(
    path: Path,
    pictures: list[Path],
    camera_file: CameraFile | None,
    right: RightPictures | None = None,
    depth: DepthPictures | None = None,
) -> Recording:
    t_ns = read_times(path / "times.txt", len(pictures))
    poses = read_truth(path / "truth.tum", [path / "poses.txt"], t_ns)
    names = [file.relative_to(path).as_posix() for file in pictures]
    camera = camera_file.camera if camera_file else None
    return Recording(path.resolve().name, path, names, t_ns, poses, camera, right, depth)


def _sized(calibration: CalibrationOfSize | None, pictures: list[Path]) -> CameraFile | None:
    return None if calibration is None else calibration(*size_of_first(pictures))


def _has_pictures(folder: Path) -> bool:
    return folder.is_dir() and any(
        path.suffix.lower() in PICTURE_SUFFIXES for path in folder.iterdir()
    )


FORMAT = SequenceFormat(LOOKS_FOR, recognises, open_folder, ("calibration",))
