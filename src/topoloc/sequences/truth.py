"""Truth and times that lie in a recording's folder under this project's own names."""

from __future__ import annotations

from pathlib import Path

from topoloc.errors import RecordingError, TrajectoryError
from topoloc.geometry.rigid import Rigid3
from topoloc.sequences.recording import times_by_rate
from topoloc.sequences.trajectory import frame_poses, parse_times, read_trajectory


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
    numbered = [(number, line.split()) for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), start=1)]
    numbered = [(number, tokens) for number, tokens in numbered if tokens and not tokens[0].startswith("#")]
    try:
        t_ns = parse_times([tokens[0] for _, tokens in numbered], path, [number for number, _ in numbered])
    except TrajectoryError as error:
        raise RecordingError(str(error)) from None
    if len(t_ns) != num_frames:
        raise RecordingError(f"{path}: {len(t_ns)} times for {num_frames} pictures")
    return t_ns
