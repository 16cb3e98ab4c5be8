"""Read ARKitScenes (Baruch et al., NeurIPS 2021): iPad scans with ``lowres_wide/``,
``lowres_depth/``, ``lowres_wide_intrinsics/`` and ``lowres_wide.traj``.

Names end with the time in seconds: ``47333462_3517.234.png``. A line of the trajectory has a time,
an axis times its angle (radians) and a position (metres): cam_from_world. A ``.pincam`` holds
width, height, fx, fy, cx, cy of one image. Depth is in millimetres with the view of the image.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from topoloc import CalibrationError, Camera, RecordingError, Rigid3, Trajectory, TrajectoryError
from topoloc.apps.core_names import IMAGE_SUFFIXES, parse_numbers, parse_times, read_rows
from topoloc.plugin import DepthImages, Recording, RecordingFormat, match_times, read_text

EXPECTED_FILES = "lowres_wide/, lowres_wide_intrinsics/ and lowres_wide.traj of ARKitScenes"
UNITS_PER_METRE, MAX_DELAY_MS = 1000.0, 20
_TIME = re.compile(r"(?:.*_)?(\d{1,9})\.(\d{1,9})")


def can_open(path: Path) -> bool:
    """Return whether this is a scan, or has one in its folder ``*_frames``."""
    return _find_root(path) is not None


def open_arkitscenes(path: Path) -> Recording:
    """Open a scan. Without lowres_depth/ it has single images with poses. An image without
    calibration or depth within 20 ms is skipped with a note.

    Raises:
        RecordingError: there are no images, or none has a calibration or depth.
        CalibrationError: a .pincam is malformed.
        TrajectoryError: a line of the trajectory is malformed, or no image has a pose.
    """
    root = _find_root(path)
    if root is None:
        raise RecordingError(f"{path}: not a scan of ARKitScenes, which has {EXPECTED_FILES}")
    frames = [(time, [image]) for time, image in _timed_files(root / "lowres_wide", IMAGE_SUFFIXES)]
    notes, has_depth = (), (root / "lowres_depth").is_dir()
    others = [("lowres_wide_intrinsics", {".pincam"}), ("lowres_depth", IMAGE_SUFFIXES)]
    for name, suffixes in others[: 1 + has_depth]:
        files = _timed_files(root / name, suffixes)
        times, partners = ([time for time, _ in timed] for timed in (frames, files))
        pairs, more = match_times(times, partners, MAX_DELAY_MS, str(root), ("lowres_wide", name))
        frames = [(frames[row][0], [*frames[row][1], files[other][1]]) for row, other in pairs]
        notes += more
    t_ns, trajectory = [time for time, _ in frames], root / "lowres_wide.traj"
    poses = _read_trajectory(trajectory).match_frames(t_ns, trajectory)
    images, pincams, *paths = zip(*(files for _, files in frames), strict=True)
    names = [image.relative_to(root).as_posix() for image in images]
    found = names, t_ns, poses, [_read_camera(file) for file in pincams]
    depth = DepthImages(list(paths[0]), UNITS_PER_METRE, None, Rigid3.identity()) if paths else None
    recording = Recording.with_cameras(path.resolve().name, root, *found, depth=depth)
    return replace(recording, notes=notes)


def _find_root(path: Path) -> Path | None:
    folders = (path, *path.glob("*_frames")) if path.is_dir() else ()
    return next((root for root in folders if (root / "lowres_wide.traj").is_file()), None)


def _timed_files(folder: Path, suffixes: Collection[str]) -> list[tuple[int, Path]]:
    """Return the files whose names end with a time, with that time (nanoseconds), in its order."""
    with RecordingError.at(folder, OSError):
        found = [
            (int(match[1]) * 1_000_000_000 + int(f"{match[2]:0<9}"), file)
            for file in folder.iterdir()
            if (match := _TIME.fullmatch(file.stem)) and file.suffix.lower() in suffixes
        ]
    if not found:
        raise RecordingError(
            f"{folder}: no file named by its video and time, such as 47_12.345.png"
        )
    return sorted(found)


def _read_camera(file: Path) -> Camera:
    with CalibrationError.at(file, CalibrationError, ValueError, OverflowError):
        width, height, *lens = map(float, read_text(file, CalibrationError).split())
        if len(lens) != 4:
            raise CalibrationError("not width, height, fx, fy, cx, cy")
        return Camera("PINHOLE", int(width), int(height), tuple(lens))


def _read_trajectory(file: Path) -> Trajectory:
    rows = read_rows(file, TrajectoryError)
    if short := next((line for line, columns in rows if len(columns) != 7), None):
        raise TrajectoryError(f"{file}, line {short}: a line has a time, a rotation and a position")
    t_ns, numbers = parse_times(rows, file, TrajectoryError), parse_numbers(file, rows, range(1, 7))
    cams_from_world = (
        Rigid3(Rigid3.exp(np.array([0.0, 0.0, 0.0, *row[:3]])).rotation, row[3:]) for row in numbers
    )
    return Trajectory([cam_from_world.inverse() for cam_from_world in cams_from_world], t_ns)


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_arkitscenes)
