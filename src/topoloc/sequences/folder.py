"""A plain folder of pictures, or one picture; with a ``camera.json`` also a rectified stereo pair or RGB-D.

Stereo: ``left/ right/`` or ``image_0/ image_1/`` and a "baseline" (m). RGB-D: ``rgb/`` or ``color/``, ``depth/`` registered to
it, and a "depth_factor" (units a metre). Else the pictures of the folder itself, or of ``rgb/``, ``color/``, ``left/``,
``image_0/`` or ``images/`` in it. ``times.txt``, ``truth.tum`` and ``poses.txt`` (KITTI rows) are read where they are there.
"""

from __future__ import annotations

from pathlib import Path

from topoloc.errors import CalibrationError, RecordingError
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.sequences.camera_json import FILE_NAME, CameraFile, read_camera_json
from topoloc.sequences.pictures import PICTURE_SUFFIXES
from topoloc.sequences.recording import DepthPictures, Recording, RightPictures, check_pairs, list_pictures
from topoloc.sequences.trajectory import read_times, read_truth

LOOKS_FOR = "pictures, or left/ and right/, or rgb/ and depth/ with camera.json"
_STEREO = (("left", "right"), ("image_0", "image_1"))
_RGBD = (("rgb", "depth"), ("color", "depth"))
_MONO = ("rgb", "color", "left", "image_0", "images")


def recognises(path: Path) -> bool:
    """Whether this is a picture, or a folder with pictures in it or in one of the known folders below it."""
    if path.is_file():
        return path.suffix.lower() in PICTURE_SUFFIXES
    return any(_has_pictures(folder) for folder in (path, *(path / name for name in _MONO)))


def open_folder(path: Path) -> Recording:
    """Open a folder of pictures, or a single picture as a recording of one frame. Without camera.json the camera is unknown.

    Raises:
        RecordingError: no pictures, or left, right, depth and times differ in number.
        CalibrationError: camera.json is missing for stereo or RGB-D folders, or not usable.
        TrajectoryError: the truth is malformed or fits no frame.
    """
    if path.is_file():
        camera_file = _camera_file(path.parent)
        return Recording(path.name, path.parent, [path.name], [0], [None], camera_file.camera if camera_file else None)
    camera_file = _camera_file(path)
    for left, right in _STEREO:
        if (path / left).is_dir() and (path / right).is_dir():
            return _open_stereo(path, left, right, camera_file)
    for colour, depth in _RGBD:
        if (path / colour).is_dir() and (path / depth).is_dir():
            return _open_rgbd(path, colour, depth, camera_file)
    folder = next((path / name for name in ("", *_MONO) if _has_pictures(path / name)), None)
    if folder is None:
        raise RecordingError(f"{path}: no pictures in this folder")
    return _recording(path, list_pictures(folder), camera_file)


def _open_stereo(path: Path, left: str, right: str, camera_file: CameraFile | None) -> Recording:
    if camera_file is None or camera_file.baseline is None:
        raise CalibrationError(f'{path / FILE_NAME}: a stereo pair ({left}/, {right}/) needs this file, with a "baseline" in metres')
    left_paths, right_paths = list_pictures(path / left), list_pictures(path / right)
    check_pairs(left_paths, right_paths)
    rig = StereoRig.rectified(camera_file.camera, camera_file.baseline)
    return _recording(path, left_paths, camera_file, right=RightPictures(right_paths, rig))


def _open_rgbd(path: Path, colour: str, depth: str, camera_file: CameraFile | None) -> Recording:
    if camera_file is None or camera_file.depth_factor is None:
        raise CalibrationError(f'{path / FILE_NAME}: RGB-D ({colour}/, {depth}/) needs this file, with a "depth_factor" in units a metre')
    colour_paths, depth_paths = list_pictures(path / colour), list_pictures(path / depth)
    check_pairs(colour_paths, depth_paths)
    pictures = DepthPictures(depth_paths, camera_file.depth_factor, camera_file.camera, Rigid3.identity())
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


def _camera_file(folder: Path) -> CameraFile | None:
    return read_camera_json(folder / FILE_NAME) if (folder / FILE_NAME).is_file() else None


def _has_pictures(folder: Path) -> bool:
    return folder.is_dir() and any(path.suffix.lower() in PICTURE_SUFFIXES for path in folder.iterdir())
