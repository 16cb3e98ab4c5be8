"""Use frames in memory as a recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from topoloc.errors import RecordingError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.frame_checks import find_frame_problem, find_times_problem


class MemorySequence:
    """A recording of frames in memory: stereo pairs, RGB-D or single images, with or without poses.

    All frames are checked at construction, so that a wrong type, size or unit is reported early.

    Raises:
        RecordingError: there are no frames, or a frame is inconsistent. Names the frame and a
            remedy.
    """

    def __init__(self, frames: Iterable[StereoFrame], name: str = "memory") -> None:
        self.name = name
        self._frames = list(frames)
        if not self._frames:
            raise RecordingError(f"{name}: no frames")
        for number, frame in enumerate(self._frames):
            if not isinstance(frame, StereoFrame):
                raise RecordingError(
                    f"{name}, frame {number}: a StereoFrame is expected, not {type(frame).__name__}"
                )
            problem = find_frame_problem(frame)
            if (
                problem is None
                and frame.camera is None
                and frame.image.shape[:2] != self._frames[0].image.shape[:2]
            ):
                problem = (
                    "its picture is of another size than the first frame's, and neither has a"
                    " camera"
                )
            if problem is not None:
                raise RecordingError(f"{name}, frame {number} ({frame.name}): {problem}")
        self._frames = [replace(frame, t_ns=int(frame.t_ns)) for frame in self._frames]
        if problem := find_times_problem(self.t_ns):
            raise RecordingError(f"{name}: {problem}")

    @property
    def names(self) -> list[str]:
        """Return the name of each frame."""
        return [frame.name for frame in self._frames]

    @property
    def t_ns(self) -> list[int]:
        """Return the time of each frame, in integer nanoseconds."""
        return [frame.t_ns for frame in self._frames]

    @property
    def poses(self) -> list[Rigid3 | None]:
        """Return world_from_cam of each frame, None if unknown."""
        return [frame.world_from_cam for frame in self._frames]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> StereoFrame:
        """Return one frame as it was given. Raises IndexError."""
        return self._frames[index]
