"""Read a video file (MP4, AVI, ...) as a monocular recording with OpenCV.

The calibration is the ``camera.json`` beside it, and ground truth is ``NAME.tum`` for ``NAME.mp4``.
Times come from the container, so variable frame rates are kept. The rotation flag of the container
is ignored, because a calibration refers to the stored pixels.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2

from topoloc import (
    CalibrationError,
    Camera,
    Image,
    RecordingError,
    Rigid3,
    StereoFrame,
    UnreadableImageError,
)
from topoloc.apps.core_names import CalibrationForSize
from topoloc.plugin import IndexedFrames, RecordingFormat, read_camera_json, read_ground_truth

# Suppress FFmpeg's messages about broken files on stderr, because an error reports them. FFmpeg
# reads the variable once per process.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

VIDEO_SUFFIXES = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm"})
_LOG_LEVEL_LOCK = threading.Lock()
EXPECTED_FILES = "a video file (.mp4, .mov, .avi, .mkv, .webm)"


@dataclass(eq=False)
class _Reader:
    """Hold an open video and the number of its next frame."""

    capture: Any
    next_idx: int = 0


@dataclass(eq=False, repr=False)
class Video(IndexedFrames):
    """A StereoSequence in one video file. Frames are decoded in order. Accessing an earlier frame
    restarts the video."""

    name: str
    path: Path
    names: list[str]
    t_ns: list[int]
    poses: list[Rigid3 | None]
    camera: Camera | None
    size: tuple[int, int]
    notes: tuple[str, ...] = ()
    _reader: _Reader | None = field(default=None, repr=False)

    @staticmethod
    def can_open(path: Path) -> bool:
        """Whether this is a video file, by its name."""
        return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES

    @staticmethod
    def open(path: Path) -> Video:
        """Open a video without a camera, whatever calibration lies beside it.

        Raises:
            RecordingError: no video, no frame in it that can be decoded, or its clock goes
                backwards.
            TrajectoryError: the truth is malformed or fits no frame.
        """
        size, rate = _read_frame_size(path)
        t_ns, notes = _read_times(path, rate)
        poses = read_ground_truth(path.with_suffix(".tum"), [], t_ns)
        names = [f"{index:06d}" for index in range(len(t_ns))]
        return Video(path.name, path, names, t_ns, poses, None, size, notes)

    @staticmethod
    def read_size(path: Path) -> tuple[int, int]:
        """Return width and height of the first frame, in pixels. Raises RecordingError."""
        return _read_frame_size(path)[0]

    def __len__(self) -> int:
        return len(self.names)

    def read_frame(self, row: int) -> StereoFrame:
        """Read one frame. Raises UnreadableImageError: it cannot be decoded, or its size differs
        from the first frame's."""
        name, t_ns, pose = self.names[row], self.t_ns[row], self.poses[row]
        return StereoFrame(name, t_ns, self._decode(row), self.camera, world_from_cam=pose)

    def _decode(self, index: int) -> Image:
        reader = self._reader
        if reader is None or reader.next_idx > index:
            reader = self._reader = _Reader(_open_capture(self.path))
        while reader.next_idx <= index:
            grabbed = reader.capture.grab()
            reader.next_idx += 1
            if not grabbed:
                self._reader = None
                raise UnreadableImageError(f"{self.path}, frame {index}: cannot be decoded")
        _, picture = reader.capture.retrieve()
        if picture is None:
            raise UnreadableImageError(f"{self.path}, frame {index}: cannot be decoded")
        height, width = picture.shape[:2]
        if (width, height) != self.size:
            raise UnreadableImageError(
                f"{self.path}, frame {index}: {width}x{height} pixels, but the first frame is of"
                f" {self.size[0]}x{self.size[1]}"
            )
        return picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def open_video(path: Path, calibration: CalibrationForSize | None = None) -> Video:
    """Open a video file. One pass over the file reads its times. A truncated file ends with its
    last complete frame.

    Args:
        path: the file.
        calibration: replaces the camera.json beside it.

    Raises:
        RecordingError: the file is not a video, no frame can be decoded, or its times do not
            increase.
        CalibrationError: a calibration is not usable, or its size differs from the frames'.
        TrajectoryError: the ground truth is malformed or matches no frame.
    """
    video, file = Video.open(path), path.parent / "camera.json"
    width, height = video.size
    if file.is_file():
        camera = read_camera_json(file).camera
        if (camera.width, camera.height) != video.size:
            raise CalibrationError(
                f"{file}: of {camera.width}x{camera.height}, but {path.name} is {width}x{height}"
            )
        video = replace(video, camera=camera)
    if calibration:
        camera = calibration(width, height).camera
        if (camera.width, camera.height) != video.size:
            raise CalibrationError(
                f"{path.name}: of {width}x{height}, the camera of {camera.width}x{camera.height}"
            )
        video = replace(video, camera=camera)
    return video


def _read_frame_size(path: Path) -> tuple[tuple[int, int], float]:
    """Return width and height of the first frame in pixels, and the frame rate of the container.
    Raises RecordingError."""
    capture = _open_capture(path)
    _, first = capture.read()
    if first is None:
        raise RecordingError(f"{path}: no frame of this video can be decoded")
    return (first.shape[1], first.shape[0]), capture.get(cv2.CAP_PROP_FPS)


def _open_capture(path: Path) -> cv2.VideoCapture:
    with silence_opencv():
        capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise RecordingError(f"{path}: not a video, damaged, or of a codec that OpenCV cannot read")
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def _read_times(path: Path, rate: float) -> tuple[list[int], tuple[str, ...]]:
    """Return the time of each frame in nanoseconds, and notes for the user.

    Times come from the frame rate if a frame has no time, as in AVI files. The other times are then
    late by the frames that the decoder holds back.
    """
    capture, t_ns = _open_capture(path), []
    while capture.grab():
        t_ns.append(round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6))
    if num_without := t_ns[1:].count(0):
        if not rate > 0:
            raise RecordingError(f"{path}: neither its frames have times, nor does it name a rate")
        note = f"{num_without} of {len(t_ns)} frames have no time; times are from its {rate:g} Hz"
        notes = () if not any(t_ns) else (f"{path}: {note}",)
        return [round(index * 1e9 / rate) for index in range(len(t_ns))], notes
    for index, (before, after) in enumerate(pairwise(t_ns), start=1):
        if after <= before:
            raise RecordingError(
                f"{path}, frame {index}: at {after / 1e9:.3f} s, but the frame before is at"
                f" {before / 1e9:.3f} s"
            )
    return t_ns, ()


@contextmanager
def silence_opencv() -> Iterator[None]:
    """Suppress OpenCV's messages on stderr, because an error reports the problem."""
    # OpenCV 4 has these functions in the module cv2.
    logging: Any = getattr(cv2.utils, "logging", cv2)
    with _LOG_LEVEL_LOCK:
        level = logging.getLogLevel()
        logging.setLogLevel(0)
        try:
            yield
        finally:
            logging.setLogLevel(level)


FORMAT = RecordingFormat(EXPECTED_FILES, Video.can_open, open_video, ("calibration",))
