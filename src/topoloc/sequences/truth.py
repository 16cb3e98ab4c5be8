"""Truth and times that lie in a recording's folder under this project's own names."""

from __future__ import annotations

from pathlib import Path

from topoloc.errors import RecordingError
from topoloc.geometry.rigid import Rigid3
from topoloc.sequences.recording import times_by_rate
from topoloc.sequences.text_rows import parse_times, read_rows
from topoloc.sequences.trajectory import frame_poses, read_trajectory


def read_truth(tum: Path, kitti_rows: list[Path], t_ns: list[int]) -> list[Rigid3 | None]:
    """The pose of each frame from the first of these files that is there: TUM by time, KITTI rows one a frame.

    Raises:
        TrajectoryError: the file is malformed, or fits no frame.
    """
    for path in (tum, *kitti_rows):
        if path.is_file():
            return frame_poses(read_trajectory(path), t_ns, path)
    return [None] * len(t_ns)


def read_times(path: Path, num_frames: int) -> list[int]:
    """Times in nanoseconds from a file of one time in seconds a line; 10 Hz where there is no file.

    Raises:
        RecordingError: malformed, not increasing, or their number is not that of the frames.
    """
    if not path.is_file():
        return times_by_rate(num_frames)
    t_ns = parse_times(read_rows(path, RecordingError), path, RecordingError)
    if len(t_ns) != num_frames:
        raise RecordingError(f"{path}: {len(t_ns)} times for {num_frames} pictures")
    return t_ns
