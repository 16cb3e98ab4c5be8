"""Read a folder of images or a single image. With a calibration it can be a stereo pair or RGB-D.

Stereo: ``left/ right/``, ``image_0/ image_1/`` or ``cam0/ cam1/``. It needs a ``camera.json`` with
a "baseline" (m) or two cameras, or YAML of OpenCV or Kalibr. RGB-D: ``rgb/`` or ``color/``,
``depth/`` registered to it, and a "depth_factor" (units per metre). Otherwise the images are in the
folder itself or in ``rgb/``, ``color/``, ``left/``, ``image_0/``, ``cam0/`` or ``images/``.
``times.txt``, ``truth.tum`` and ``poses.txt`` (KITTI rows) are optional.
"""

from __future__ import annotations

from pathlib import Path

from topoloc.errors import CalibrationError, RecordingError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.calibration import (
    CalibrationForSize,
    complete_calibration,
    find_calibration,
    first_image_size,
    parse_calibration,
)
from topoloc.recordings.camera_json import FILE_NAME, CameraCalibration
from topoloc.recordings.format import RecordingFormat
from topoloc.recordings.image_io import IMAGE_SUFFIXES
from topoloc.recordings.recording import (
    DepthImages,
    Recording,
    RightImages,
    check_pairs,
    list_images,
)
from topoloc.recordings.trajectory import read_ground_truth, read_times

EXPECTED_FILES = "pictures, or left/ and right/, or rgb/ and depth/ with camera.json"
_STEREO = (("left", "right"), ("image_0", "image_1"), ("cam0", "cam1"))
_RGBD = (("rgb", "depth"), ("color", "depth"))
_MONO = ("rgb", "color", "left", "image_0", "cam0", "images")


def can_open(path: Path) -> bool:
    """Return whether this is an image, or a folder with images in it or in one of the known
    subfolders."""
    if path.is_file():
        return path.suffix.lower() in IMAGE_SUFFIXES
    return any(_has_images(folder) for folder in (path, *(path / name for name in _MONO)))


def open_folder(path: Path, calibration: CalibrationForSize | None = None) -> Recording:
    """Open a folder of images, or a single image as a recording of one frame.

    The camera model is unknown if there is no calibration.

    Args:
        path: the folder or the image.
        calibration: replaces the calibration in the folder.

    Raises:
        RecordingError: there are no images, or the numbers of left, right or depth images and times
            differ.
        CalibrationError: the calibration of stereo or RGB-D images is missing or not usable.
        TrajectoryError: the ground truth is malformed or matches no frame.
    """
    if path.is_file():
        beside = path.parent / FILE_NAME
        calibration = calibration or (parse_calibration(beside) if beside.is_file() else None)
        camera = calibration(*first_image_size([path])).camera if calibration else None
        return Recording(path.name, path.parent, [path.name], [0], [None], camera)
    calibration = complete_calibration(calibration, path) if calibration else find_calibration(path)
    for left, right in _STEREO:
        if (path / left).is_dir() and (path / right).is_dir():
            return _open_stereo(path, left, right, calibration)
    for colour, depth in _RGBD:
        if (path / colour).is_dir() and (path / depth).is_dir():
            return _open_rgbd(path, colour, depth, calibration)
    folder = next((path / name for name in ("", *_MONO) if _has_images(path / name)), None)
    if folder is None:
        raise RecordingError(f"{path}: no pictures in this folder")
    images = list_images(folder)
    return _make_recording(path, images, _calibration_for_images(calibration, images))


def _open_stereo(
    path: Path, left: str, right: str, calibration: CalibrationForSize | None
) -> Recording:
    left_paths, right_paths = list_images(path / left), list_images(path / right)
    camera_calibration = _calibration_for_images(calibration, left_paths)
    if camera_calibration is None or camera_calibration.rig is None:
        raise CalibrationError(
            f"{path / FILE_NAME}: a stereo pair ({left}/, {right}/) needs this file, with a"
            ' "baseline" in metres or two cameras, or the YAML of OpenCV or Kalibr'
        )
    check_pairs(left_paths, right_paths)
    return _make_recording(
        path, left_paths, camera_calibration, right=RightImages(right_paths, camera_calibration.rig)
    )


def _open_rgbd(
    path: Path, colour: str, depth: str, calibration: CalibrationForSize | None
) -> Recording:
    colour_paths, depth_paths = list_images(path / colour), list_images(path / depth)
    camera_calibration = _calibration_for_images(calibration, colour_paths)
    if camera_calibration is None or camera_calibration.depth_factor is None:
        raise CalibrationError(
            f"{path / FILE_NAME}: RGB-D ({colour}/, {depth}/) needs this file, with a"
            ' "depth_factor" in units a metre'
        )
    check_pairs(colour_paths, depth_paths)
    images = DepthImages(
        depth_paths, camera_calibration.depth_factor, camera_calibration.camera, Rigid3.identity()
    )
    return _make_recording(path, colour_paths, camera_calibration, depth=images)


def _make_recording(
    path: Path,
    images: list[Path],
    camera_calibration: CameraCalibration | None,
    right: RightImages | None = None,
    depth: DepthImages | None = None,
) -> Recording:
    t_ns = read_times(path / "times.txt", len(images))
    poses = read_ground_truth(path / "truth.tum", [path / "poses.txt"], t_ns)
    names = [file.relative_to(path).as_posix() for file in images]
    camera = camera_calibration.camera if camera_calibration else None
    return Recording(path.resolve().name, path, names, t_ns, poses, camera, right, depth)


def _calibration_for_images(
    calibration: CalibrationForSize | None, images: list[Path]
) -> CameraCalibration | None:
    return None if calibration is None else calibration(*first_image_size(images))


def _has_images(folder: Path) -> bool:
    return folder.is_dir() and any(
        path.suffix.lower() in IMAGE_SUFFIXES for path in folder.iterdir()
    )


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_folder, ("calibration",))
