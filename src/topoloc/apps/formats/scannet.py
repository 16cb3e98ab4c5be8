"""Read ScanNet (Dai et al., CVPR 2017) as its SensReader exports it: ``color/0.jpg``,
``depth/0.png``, ``pose/0.txt`` and ``intrinsic/intrinsic_color.txt``, ``intrinsic_depth.txt``.

Poses are world_from_cam in metres (4x4), -inf if they are lost. Depth is in millimetres, from the
same viewpoint as colour, with its own size and camera matrix. Times are frame numbers at 30 Hz.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from topoloc import CalibrationError, Camera, Rigid3
from topoloc.apps.core_names import (
    CalibrationForSize,
    complete_lists,
    first_image_size,
    parse_calibration,
    read_pose_matrix,
)
from topoloc.plugin import DepthImages, Recording, RecordingFormat, list_images

EXPECTED_FILES = "color/, depth/, pose/ and intrinsic/ of ScanNet"
UNITS_PER_METRE, RATE_HZ = 1000.0, 30
_PLACES = ("intrinsic/intrinsic_{}.txt", "intrinsics_{}.txt", "intrinsic_{}.txt")


def can_open(path: Path) -> bool:
    """Return whether this is such a folder."""
    return all((path / name).is_dir() for name in ("color", "pose")) and any(
        (path / place.format("color")).is_file() for place in _PLACES
    )


def open_scannet(path: Path, calibration: CalibrationForSize | None = None) -> Recording:
    """Open a folder. Without depth/ it has single images with poses.

    Args:
        path: the folder.
        calibration: replaces that of the colour camera.

    Raises:
        RecordingError: there are no images, or most have no depth.
        CalibrationError: a camera matrix is missing or belongs to another image size.
        TrajectoryError: a file in pose/ contains no 4x4 matrix of a pose.
    """
    images, depth = list_images(path / "color"), None
    if (path / "depth").is_dir():
        images, depth_paths = complete_lists(None, images, list_images(path / "depth"))
        camera = _read_camera(path, "depth", depth_paths)
        depth = DepthImages(depth_paths, UNITS_PER_METRE, camera, Rigid3.identity())
    camera = (
        calibration(*first_image_size(images)).camera
        if calibration
        else _read_camera(path, "color", images)
    )
    files = [path / "pose" / f"{image.stem}.txt" for image in images]
    poses = [read_pose_matrix(file) if file.is_file() else None for file in files]
    numbers = [int(image.stem) if image.stem.isdecimal() else k for k, image in enumerate(images)]
    t_ns = [number * 1_000_000_000 // RATE_HZ for number in numbers]
    names = [image.relative_to(path).as_posix() for image in images]
    moved = filter(_is_moved, (path / "intrinsic").glob("extrinsic_*.txt"))
    notes = tuple(
        f"{file}: no identity; it is not used, so depth has to have the viewpoint of color/"
        for file in moved
    )
    place = path.resolve().name, path, names, t_ns, poses, camera
    return Recording(*place, depth=depth, notes=notes)


def _read_camera(path: Path, kind: str, images: list[Path]) -> Camera:
    places = [path / place.format(kind) for place in _PLACES]
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        raise CalibrationError(f"{places[0]}: missing; it has the camera matrix of {kind}/")
    with CalibrationError.at(file, CalibrationError):
        return parse_calibration(file)(*first_image_size(images)).camera


def _is_moved(file: Path) -> bool:
    pose = read_pose_matrix(file)
    return pose is not None and not np.allclose(pose.matrix(), np.eye(4), atol=1e-4)


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_scannet, ("calibration",))
