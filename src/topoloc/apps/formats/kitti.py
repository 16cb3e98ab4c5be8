"""Read KITTI odometry (Geiger et al., CVPR 2012) and folders of the same layout.

A folder holds ``image_0/ image_1/`` (otherwise the colour images ``image_2/ image_3/``),
``calib.txt`` and ``times.txt``. Ground truth is ``truth.tum`` or ``poses.txt`` in the folder, or
KITTI's own ``poses/<name>.txt`` beside ``sequences/``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from topoloc import CalibrationError, Camera, RecordingError, Rigid3, StereoRig
from topoloc.apps.core_names import RightImages, complete_lists, first_image_size, read_times
from topoloc.plugin import Recording, RecordingFormat, list_images, read_ground_truth, read_text

EXPECTED_FILES = "image_0/ and image_1/ (or image_2/ and image_3/) with calib.txt"
_PAIRS = ((0, 1), (2, 3))


def can_open(path: Path) -> bool:
    """Return whether this folder has KITTI's image folders. With a camera.json instead of a
    calib.txt it is a plain folder."""
    has_pictures = any((path / f"image_{left}").is_dir() for left, _ in _PAIRS)
    return has_pictures and ((path / "calib.txt").is_file() or not (path / "camera.json").is_file())


def open_kitti(path: Path) -> Recording:
    """Open a KITTI-like folder. Without the right folder it is a monocular recording of the left
    camera.

    Raises:
        RecordingError: there are no images, most have no partner, or the number of times differs.
        CalibrationError: calib.txt is missing or not usable.
        TrajectoryError: the ground truth is malformed or matches no frame.
    """
    pair = next((pair for pair in _PAIRS if (path / f"image_{pair[0]}").is_dir()), None)
    if pair is None:
        raise RecordingError(f"{path}: not a KITTI folder, which has {EXPECTED_FILES}")
    folders = [path / f"image_{number}" for number in pair]
    lists = [list_images(folder) for folder in folders if folder.is_dir()]
    left, *others = complete_lists(path / "times.txt", *lists)
    projections = read_calib(path / "calib.txt")
    size = first_image_size(left)
    camera, shift = _camera(path, projections, pair[0], size)
    right = None
    if others:
        right_camera, right_shift = _camera(path, projections, pair[1], size)
        # P of the colour cameras has some millimetres in y and z, too. The images are still
        # rectified to equal rows.
        baseline = shift[0] - right_shift[0]
        if baseline <= 0:
            raise CalibrationError(
                f"{path / 'calib.txt'}: P{pair[1]} puts the right camera {-baseline:g} m to the"
                " left of the left one"
            )
        rig = replace(StereoRig.rectified(camera, baseline), right=right_camera)
        right = RightImages(others[0], rig)
    t_ns = read_times(path / "times.txt", len(left))
    poses = _read_ground_truth(path, t_ns, Rigid3(np.eye(3), -shift))
    names = [f"{file.parent.name}/{file.name}" for file in left]
    return Recording(path.resolve().name, path, names, t_ns, poses, camera, right)


def read_calib(path: Path) -> dict[str, Float[np.ndarray, "3 4"]]:
    """Read the projection matrices P0, P1, ... of a calib.txt.

    Raises:
        CalibrationError: the file is missing, or a P line is not a projection matrix of 12 finite
            numbers.
    """
    missing = "no calibration here; a camera.json with a baseline beside it would do as well"
    projections = {}
    for number, line in enumerate(read_text(path, CalibrationError, missing).splitlines(), start=1):
        key, _, values = line.partition(":")
        if not (key.startswith("P") and key[1:].isdigit()):
            continue
        try:
            matrix = np.array([float(value) for value in values.split()]).reshape(3, 4)
        except ValueError:
            raise CalibrationError(f"{path}, line {number}: {key} is not 12 numbers") from None
        is_valid = np.isfinite(matrix).all() and min(matrix[0, 0], matrix[1, 1]) > 0
        if not is_valid or np.linalg.matrix_rank(matrix[:, :3]) < 3:
            raise CalibrationError(f"{path}, line {number}: {key} is not a projection matrix")
        projections[key] = matrix
    return projections


def _camera(
    path: Path, projections: dict[str, np.ndarray], number: int, size: tuple[int, int]
) -> tuple[Camera, Float[np.ndarray, "3"]]:
    """Return the camera and the translation t of P = K [I | t]."""
    if f"P{number}" not in projections:
        raise CalibrationError(f"{path / 'calib.txt'}: no line P{number} for image_{number}")
    p = projections[f"P{number}"]
    camera = Camera.pinhole(*size, p[0, 0], p[1, 1], p[0, 2], p[1, 2])
    return camera, np.linalg.solve(p[:, :3], p[:, 3])


def _read_ground_truth(path: Path, t_ns: list[int], cam0_from_cam: Rigid3) -> list[Rigid3 | None]:
    if any(poses := read_ground_truth(path / "truth.tum", [], t_ns)):
        return poses
    absolute = path.resolve()
    rows = [path / "poses.txt", absolute.parent.parent / "poses" / f"{absolute.name}.txt"]
    # KITTI's rows are the poses of camera 0 for all image folders.
    return [pose and pose @ cam0_from_cam for pose in read_ground_truth(rows[0], rows[1:], t_ns)]


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_kitti)
