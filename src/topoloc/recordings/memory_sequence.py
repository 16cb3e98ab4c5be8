"""Frames that are in memory, as a recording: what a program has read itself is mapped as a file
would be."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from topoloc.errors import RecordingError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.frame_checks import find_frame_problem, find_times_problem


class MemorySequence:
    """A recording of frames in memory: stereo pairs, pictures with depth, or single pictures, with
    poses or without.

    The frames are looked at once, so that a picture of another type, size or unit is named before
    anything is built of it.

    Raises:
        RecordingError: no frames, or one whose parts do not fit together; names the frame and what
            would mend it.
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
        """The name of each frame."""
        return [frame.name for frame in self._frames]

    @property
    def t_ns(self) -> list[int]:
        """The time of each frame, integer nanoseconds."""
        return [frame.t_ns for frame in self._frames]

    @property
    def poses(self) -> list[Rigid3 | None]:
        """world_from_cam of each frame, None where unknown."""
        return [frame.world_from_cam for frame in self._frames]

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> StereoFrame:
        """One frame, as it was given. Raises IndexError."""
        return self._frames[index]
