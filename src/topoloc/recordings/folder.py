"""Read a folder of images or a single image. With a calibration it can be a stereo pair or RGB-D.

Stereo: ``left/ right/``, ``image_0/ image_1/`` or ``cam0/ cam1/``, also written as ``Left`` or
``left_images``. It needs a ``camera.json`` with
a "baseline" (m) or two cameras, or YAML of OpenCV or Kalibr. RGB-D: ``rgb/`` or ``color/``,
``depth/`` registered to it, and a "depth_factor" (units per metre). Otherwise the images are in the
folder itself or in ``rgb/``, ``color/``, ``left/``, ``image_0/``, ``cam0/`` or ``images/``.
``times.txt``, ``truth.tum``, ``poses.txt`` (KITTI rows) and ``pose/`` (matrices) are optional.
Names that are times, such as ``1305031452.791720.png``, are used as such.
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

from topoloc.errors import CalibrationError, RecordingError, TrajectoryError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.calibration import (
    CalibrationForSize,
    complete_calibration,
    find_calibration,
    first_image_size,
    parse_calibration,
)
from topoloc.recordings.camera_files import FILE_NAME, CameraCalibration
from topoloc.recordings.format import (
    RecordingFormat,
    complete_lists,
    list_images,
    read_ground_truth,
    read_times,
    times_from_names,
)
from topoloc.recordings.image_io import IMAGE_SUFFIXES
from topoloc.recordings.recording import DepthImages, Recording, RightImages

EXPECTED_FILES = "pictures, or left/ and right/, or rgb/ and depth/ with camera.json"
_STEREO = (("left", "right"), ("0", "1"))
_RGBD = (("rgb", "depth"), ("color", "depth"), ("colour", "depth"))
_MONO = ("rgb", "color", "colour", "left", "0", "images")


def can_open(path: Path) -> bool:
    """Return whether this is an image, or a folder with images in it or in one of the known
    subfolders."""
    if path.is_file():
        return path.suffix.lower() in IMAGE_SUFFIXES
    folders = _plain_folders(path)
    return _has_images(path) or any(_has_images(folders[name]) for name in _MONO if name in folders)


def open_folder(path: Path, calibration: CalibrationForSize | None = None) -> Recording:
    """Open a folder of images, or a single image as a recording of one frame.

    The camera model is unknown if there is no calibration.

    Args:
        path: the folder or the image.
        calibration: replaces the calibration in the folder.

    Raises:
        RecordingError: there are no images, most have no partner, or the number of times differs.
        CalibrationError: the calibration of stereo or RGB-D images is missing or not usable.
        TrajectoryError: the ground truth is malformed or matches no frame.
    """
    if path.is_file():
        beside = path.parent / FILE_NAME
        calibration = calibration or (parse_calibration(beside) if beside.is_file() else None)
        camera = calibration(*first_image_size([path])).camera if calibration else None
        return Recording(path.name, path.parent, [path.name], [0], [None], camera)
    calibration = complete_calibration(calibration, path) if calibration else find_calibration(path)
    folders = _plain_folders(path)
    for pair in (*_STEREO, *_RGBD):
        if folders.keys() >= set(pair):
            one, other = (folders[name] for name in pair)
            return _open_pairs(path, one.name, other.name, pair in _STEREO, calibration)
    single = [path, *(folders[name] for name in _MONO if name in folders)]
    folder = next(filter(_has_images, single), None)
    if folder is None:
        raise RecordingError(f"{path}: no pictures in this folder")
    (images,) = complete_lists(path / "times.txt", list_images(folder))
    return _make_recording(path, images, calibration and calibration(*first_image_size(images)))


def _open_pairs(
    path: Path, name: str, other: str, is_stereo: bool, calibration: CalibrationForSize | None
) -> Recording:
    """Open the images of two folders, the second one with right or depth images."""
    lists = [list_images(path / folder) for folder in (name, other)]
    images, others = complete_lists(path / "times.txt", *lists)
    found = calibration and calibration(*first_image_size(images))
    right, depth = None, None
    if is_stereo and found and found.rig:
        right = RightImages(others, found.rig)
    elif not is_stereo and found and found.depth_factor:
        depth = DepthImages(others, found.depth_factor, None, Rigid3.identity())
    else:
        kind, need = "RGB-D", '"depth_factor" in units a metre'
        if is_stereo:
            need = '"baseline" in metres or two cameras, or the YAML of OpenCV or Kalibr'
            kind = "a stereo pair"
        raise CalibrationError(
            f"{path / FILE_NAME}: {kind} ({name}/, {other}/) needs this file, with a {need}"
        )
    return _make_recording(path, images, found, right, depth)


def _make_recording(
    path: Path,
    images: list[Path],
    calibration: CameraCalibration | None,
    right: RightImages | None = None,
    depth: DepthImages | None = None,
) -> Recording:
    names = [file.relative_to(path).as_posix() for file in images]
    t_ns, poses = _find_times(path, images, names)
    camera = calibration and calibration.camera
    return Recording(path.resolve().name, path, names, t_ns, poses, camera, right, depth)


def _find_times(
    path: Path, images: list[Path], names: list[str]
) -> tuple[list[int], list[Rigid3 | None]]:
    """Return the times and poses of the frames. The names of the images are their times if there is
    no other list of them, and they fit the ground truth."""
    t_ns = read_times(path / "times.txt", len(images))
    truth = path / "truth.tum", [path / name for name in ("poses.txt", "poses", "pose")]
    named = None if (path / "times.txt").is_file() else times_from_names(images)
    try:
        return named or t_ns, read_ground_truth(*truth, named or t_ns, names)
    except TrajectoryError:
        with suppress(TrajectoryError):
            return t_ns, read_ground_truth(*truth, t_ns, names)
        raise


def _plain_folders(path: Path) -> dict[str, Path]:
    """Return the subfolders by their plain names: in small letters, without `images`, `cam` or the
    like beside the rest (`Left_Images`: left; `cam0`, `image_0`: 0)."""
    folders = (folder for folder in sorted(path.iterdir()) if folder.is_dir())
    beside = "(image|img|pic|picture|frame|cam|camera)s?"
    around = re.compile(f"^{beside}(?=[^s])|(?<=.){beside}$")
    return {around.sub("", re.sub("[-_ ]", "", one.name.lower())): one for one in folders}


def _has_images(folder: Path) -> bool:
    return folder.is_dir() and any(
        path.suffix.lower() in IMAGE_SUFFIXES for path in folder.iterdir()
    )


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_folder, ("calibration",))
