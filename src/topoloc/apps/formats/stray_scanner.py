"""Stray Scanner's recording of an iPhone's or iPad's camera and LiDAR: ``rgb.mp4``,
``odometry.csv``, ``camera_matrix.csv``, ``depth/000000.png`` and ``confidence/``.

A row of odometry.csv has the time in seconds, the number of the frame, and world_from_cam (metres;
x right, y down, z forward). Later versions add fx, fy, cx, cy. Depth is in millimetres with the
view of the video, at a lower resolution. Depth of confidence 0 is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from topoloc import Camera, RecordingError, Rigid3, StereoFrame, TrajectoryError, read_image
from topoloc.apps.core_names import parse_calibration
from topoloc.plugin import (
    IndexedFrames,
    RecordingFormat,
    Video,
    depth_image_of,
    read_depth_image,
    read_text,
)

EXPECTED_FILES = "rgb.mp4, odometry.csv and camera_matrix.csv of Stray Scanner"
_NAMES = ["timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw"]
_LENS_NAMES = ["fx", "fy", "cx", "cy"]


@dataclass(frozen=True, eq=False, repr=False)
class StrayRecording(IndexedFrames):
    """A StereoSequence of such a folder. `video_idx` are the numbers of the frames in the video."""

    name: str
    root: Path
    video: Video
    video_idx: list[int]
    t_ns: list[int]
    poses: list[Rigid3 | None]
    cameras: list[Camera]
    has_depth: bool
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Return the numbers of the frames."""
        return [f"{index:06d}" for index in self.video_idx]

    def __len__(self) -> int:
        return len(self.video_idx)

    def monocular(self) -> StrayRecording:
        """Return the recording without its depth images."""
        return replace(self, has_depth=False)

    def paths_of(self, index: int) -> list[Path]:
        """Return the depth image of a frame."""
        return [self._depth_path(index)] if self.has_depth else []

    def _depth_path(self, index: int) -> Path:
        path = self.root / "depth" / f"{self.video_idx[index]:06d}.npy"  # of earlier versions
        return path if path.is_file() else path.with_suffix(".png")

    def read_left_frame(self, index: int) -> StereoFrame:
        """Read one frame without depth. Raises UnreadableImageError."""
        frame = self.video[self.video_idx[index]]
        camera, pose = self.cameras[index], self.poses[index]
        return replace(frame, t_ns=self.t_ns[index], camera=camera, world_from_cam=pose)

    def read_frame(self, row: int) -> StereoFrame:
        """Read one frame. Raises UnreadableImageError."""
        frame, camera = self.read_left_frame(row), self.cameras[row]
        if not self.has_depth:
            return frame
        path = self._depth_path(row)
        depth = read_depth_image(path, units_per_metre=1000.0)
        confidence = self.root / "confidence" / f"{path.stem}.png"
        if confidence.is_file():
            levels = read_image(confidence)
            if levels.shape == depth.shape:
                depth = np.where(levels > 0, depth, np.float32(np.nan))
        return replace(frame, depth=depth_image_of(path, depth, camera))


def can_open(path: Path) -> bool:
    """Return whether this is such a folder."""
    return (path / "odometry.csv").is_file() and (path / "camera_matrix.csv").is_file()


def open_stray_scanner(path: Path) -> StrayRecording:
    """Open a folder. Without depth/ it has single images with poses. Raises RecordingError: the
    video or a table is missing or malformed, or no frame has a pose; CalibrationError: the matrix
    belongs to another image size; TrajectoryError: a row is no pose."""
    file, video = path / "odometry.csv", Video.open(path / "rgb.mp4")
    numbers, notes = _read_odometry(file, len(video))
    video_idx = [int(number) for number in numbers["frame"]]
    rows = zip(*(numbers[name] for name in _NAMES[2:]), strict=True)
    poses: list[Rigid3 | None] = [
        _pose(row, f"{file}, frame {k}") for row, k in zip(rows, video_idx, strict=True)
    ]
    if all(name in numbers for name in _LENS_NAMES):
        lenses = list(zip(*(numbers[name] for name in _LENS_NAMES), strict=True))
    else:
        lenses = [_read_matrix(path / "camera_matrix.csv")] * len(poses)
    cameras = {lens: _camera(lens, video.size) for lens in set(lenses)}
    return StrayRecording(
        path.resolve().name,
        path,
        video,
        video_idx,
        [round(1e9 * seconds) for seconds in numbers["timestamp"]],
        poses,
        [cameras[lens] for lens in lenses],
        (path / "depth").is_dir(),
        (*video.notes, *notes),
    )


def _read_odometry(file: Path, num_frames: int) -> tuple[dict[str, list[float]], tuple[str, ...]]:
    """Return the columns of the rows whose frame is in the video, and a note on other rows. Raises
    RecordingError."""
    header, rows = _read_table(file, has_header=True)
    if lacking := [name for name in _NAMES if name not in header]:
        raise RecordingError(f"{file}, line 1: no column {lacking[0]}")
    kept = [row for row in rows if 0 <= row[header.index("frame")] < num_frames]
    if not kept:
        raise RecordingError(f"{file}: no row is of one of the {num_frames} frames of rgb.mp4")
    numbers = dict(zip(header, map(list, zip(*kept, strict=True)), strict=True))
    if any(after <= before for key in _NAMES[:2] for before, after in pairwise(numbers[key])):
        raise RecordingError(f"{file}: the times or frames do not increase from row to row")
    num_lost = len(rows) - len(kept)
    note = f"{file}: {num_lost} of {len(rows)} rows have no frame in rgb.mp4 and are left out"
    return numbers, (note,) if num_lost else ()


def _read_table(path: Path, has_header: bool) -> tuple[list[str], list[list[float]]]:
    """Return the names of the columns, and the rows of finite numbers. Raises RecordingError."""
    lines = [line for line in read_text(path, RecordingError).splitlines() if line.strip()]
    header = [name.strip() for name in lines.pop(0).split(",")] if has_header and lines else []
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=1 + has_header):
        try:
            row = [float(text) for text in line.split(",")]
        except ValueError:
            row = [math.nan]
        if not all(map(math.isfinite, row)) or (header and len(row) != len(header)):
            raise RecordingError(f"{path}, line {number}: not {len(header) or 3} finite numbers")
        rows.append(row)
    return header, rows


def _read_matrix(path: Path) -> tuple[float, ...]:
    """Return fx, fy, cx, cy of the 3x3 matrix K."""
    rows = _read_table(path, has_header=False)[1]
    if [len(row) for row in rows] != [3, 3, 3]:
        raise RecordingError(f"{path}: not a matrix of 3x3 numbers")
    return rows[0][0], rows[1][1], rows[0][2], rows[1][2]


def _camera(lens: tuple[float, ...], size: tuple[int, int]) -> Camera:
    return parse_calibration(",".join(map(repr, lens)), allow_files=False)(*size).camera


def _pose(row: tuple[float, ...], where: str) -> Rigid3:
    x, y, z, *quat_xyzw = row
    length = math.hypot(*quat_xyzw)
    if not 0.99 < length < 1.01:
        raise TrajectoryError(f"{where}: qx qy qz qw is no rotation")
    qx, qy, qz, qw = (value / length for value in quat_xyzw)
    return Rigid3.from_quat_wxyz(np.array([qw, qx, qy, qz]), np.array([x, y, z]))


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_stray_scanner)
