"""Read and write trajectories (TUM files, KITTI rows) and interpolate them at the times of frames.

A TUM line is ``t tx ty tz qx qy qz qw`` in seconds, and comments start with ``#`` (Sturm et al.,
IROS 2012). A KITTI line is the upper 3x4 of a pose matrix, row by row, one line per frame (Geiger
et al., CVPR 2012). Both are world_from_cam, in metres.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from warnings import warn

import numpy as np
from jaxtyping import Float

from topoloc.errors import TrajectoryError
from topoloc.geometry.alignment import align_scaled_poses
from topoloc.geometry.pose_conventions import (
    PoseConventions,
    lazy_poses,
    pose_from_quaternion,
    poses_from_matrices,
)
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.atomic import write_text
from topoloc.recordings.frame import SequenceView, StereoSequence
from topoloc.recordings.named_poses import (
    ROTATION_TOLERANCE,
    is_unit_quaternion,
    match_names,
    match_numbers,
    poses_of_named_rows,
    read_pose_folder,
)
from topoloc.recordings.recording import scale_poses, with_poses
from topoloc.recordings.text_files import (
    NANOSECONDS_PER_SECOND,
    Rows,
    check_rows,
    parse_numbers,
    parse_times,
    parse_uniform_times,
    read_numeric_table,
    read_rows,
)

# tolerance for times written with few decimals
_TIME_TOLERANCE_NS = 1_000_000
_MIN_OVERLAP_SHARE = 0.8  # minimum overlap of two clocks, as a share of the frames' duration
TUM_HEADER = "# t tx ty tz qx qy qz qw (s, m; world_from_cam)"
_ANSWERS_HEADER = "# answers of a topoloc map, no ground truth"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Hold poses in order of time. `t_ns` are their times, strictly increasing, or None if poses
    belong to frames by row, or by name: `by_name` holds None for a pose that is lost."""

    world_from_cam: Sequence[Rigid3]
    t_ns: list[int] | None = None
    by_name: dict[str, Rigid3 | None] | None = None

    def __repr__(self) -> str:
        return f"Trajectory({len(self)} poses)"

    def __len__(self) -> int:
        return len(self.world_from_cam)

    @staticmethod
    def of_frames(poses: Iterable[Rigid3 | None], t_ns: Iterable[int]) -> Trajectory:
        """Return the trajectory of the frames that have a pose."""
        known = [(pose, time) for pose, time in zip(poses, t_ns, strict=True) if pose is not None]
        return Trajectory([pose for pose, _ in known], [time for _, time in known])

    @staticmethod
    def from_quaternions(rows: Float[np.ndarray, "n 7"], t_ns: list[int]) -> Trajectory:
        """Return the trajectory of rows x, y, z (metres), qx, qy, qz, qw at these times.

        A pose is computed when it is read. A quaternion need not be of unit length; reading the
        pose of one without length raises TrajectoryError.
        """
        return Trajectory(lazy_poses(rows, pose_from_quaternion), t_ns)

    @staticmethod
    def read(path: str | Path) -> Trajectory:
        """Read a TUM file (8 columns), KITTI rows (12 columns), poses by name, or a folder of
        matrices (`named_poses.py`). TUM times are in seconds, or in nanoseconds if they are large.

        Raises:
            TrajectoryError: the file is missing or empty, the number of columns is wrong, a number
                is NaN, a rotation is invalid, or times do not increase. Names the line.
        """
        path = Path(path)
        if path.is_dir():
            return _named_trajectory(read_pose_folder(path))
        return _read_numeric_trajectory(path) or _trajectory_from_rows(path)

    def interpolate(self, t_ns: Sequence[int], max_gap: float = 0.2) -> list[Rigid3 | None]:
        """Return the pose at each time.

        It is interpolated if its neighbours are at most `max_gap` seconds apart. Otherwise it is a
        pose within 1 ms, or None.

        Raises:
            TrajectoryError: the trajectory has no times.
        """
        if self.t_ns is None:
            raise TrajectoryError("these poses have no times, they go with frames row by row")
        gap_ns, poses = round(max_gap * NANOSECONDS_PER_SECOND), self.world_from_cam
        return [_interpolate_pose(self.t_ns, poses, time, gap_ns) for time in t_ns]

    def match_frames(
        self, t_ns: Sequence[int], path: str | Path, names: Sequence[str] = ()
    ) -> list[Rigid3 | None]:
        """Return the pose of each frame by time, or by row or name if the trajectory has no times.
        Times that are the numbers of the frames (`names`) count as such; a warning says so.

        Raises:
            TrajectoryError: the numbers of rows and frames differ, or no frame has a pose. Names
                `path` and a likely difference of the clocks.
        """
        if self.by_name is not None:
            return match_names(self.by_name, names, Path(path))
        if self.t_ns is None:
            if len(self) != len(t_ns):
                raise TrajectoryError(f"{path}: {len(self)} poses for {len(t_ns)} frames")
            return list(self.world_from_cam)
        poses = self.interpolate(t_ns)
        if 2 * sum(pose is not None for pose in poses) < len(poses):
            by_number = match_numbers(self.world_from_cam, self.t_ns, names)
            if by_number is not None:
                text = "its times are the numbers of the pictures, and taken as such"
                warn(f"{path}: {text}", stacklevel=2)
                return by_number
        if t_ns and all(pose is None for pose in poses):
            span = f"{self.t_ns[0] / 1e9:.3f} to {self.t_ns[-1] / 1e9:.3f} s"
            frames = f"the frames {t_ns[0] / 1e9:.3f} to {t_ns[-1] / 1e9:.3f} s"
            raise TrajectoryError(
                f"{path}: no frame has a pose; it covers {span},"
                f" {frames}{_clock_hint(self.t_ns, t_ns)}"
            )
        return poses

    def to_tum(self, header: bool = True) -> str:
        """Return the lines of a TUM file, first the `header` that names the columns. Raises
        TrajectoryError if the trajectory has no times."""
        if self.t_ns is None:
            raise TrajectoryError("a TUM file needs times, and these poses have none")
        rows = map(tum_line, self.t_ns, self.world_from_cam)
        return "".join(f"{line}\n" for line in [*([TUM_HEADER] if header else []), *rows])

    def write_tum(self, path: str | Path, are_answers: bool = False) -> None:
        """Write a TUM file atomically. With `are_answers` its first line says that a map answered
        these poses, so that they are nobody's ground truth (`has_answers`). Raises TrajectoryError
        if the trajectory has no times, and TopolocError if the file cannot be written."""
        write_text(Path(path), f"{_ANSWERS_HEADER}\n" * are_answers + self.to_tum())


def has_answers(path: Path) -> bool:
    """Return whether the poses of a trajectory file are answers of a map."""
    with suppress(OSError), path.open("rb") as file:
        return file.read(len(_ANSWERS_HEADER)) == _ANSWERS_HEADER.encode()
    return False


def _read_numeric_trajectory(path: Path) -> Trajectory | None:
    """Read a valid file of numbers in one pass. Return None for any other file, which is then read
    line by line."""
    numbers, lines = read_numeric_table(path, TrajectoryError) or (np.zeros((0, 0)), [])
    if numbers.shape[1] == 12:
        poses, is_rotation = poses_from_matrices(numbers, ROTATION_TOLERANCE)
        return Trajectory(poses) if is_rotation.all() else None
    t_ns, rows = parse_uniform_times(lines) if numbers.shape[1] == 8 else None, numbers[:, 1:]
    if t_ns is None or not is_unit_quaternion(rows[:, 3:]).all():
        return None
    return Trajectory.from_quaternions(rows, t_ns)


def _trajectory_from_rows(path: Path) -> Trajectory:
    rows = read_rows(path, TrajectoryError)
    if (named := poses_of_named_rows(path, rows)) is not None:
        return _named_trajectory(named)
    num_columns = len(rows[0][1])
    if num_columns not in (8, 12):
        raise TrajectoryError(
            f"{path}, line {rows[0][0]}: {num_columns} columns; a TUM line has 8, a KITTI line 12,"
            " and one more if they begin with the name of the picture instead of a time"
        )
    for line, tokens in rows:
        if len(tokens) != num_columns:
            raise TrajectoryError(
                f"{path}, line {line}: {len(tokens)} columns, the lines before have {num_columns}"
            )
    if num_columns == 8:
        return timed_trajectory(path, rows, range(1, 8))
    numbers = parse_numbers(path, rows, range(12))
    poses, is_rotation = poses_from_matrices(numbers, ROTATION_TOLERANCE)
    check_rows(is_rotation, "not a rotation", path, rows)
    return Trajectory(poses)


def _named_trajectory(by_name: dict[str, Rigid3 | None]) -> Trajectory:
    return Trajectory([pose for pose in by_name.values() if pose is not None], by_name=by_name)


def timed_trajectory(path: Path, rows: Rows, columns: Sequence[int]) -> Trajectory:
    """Read rows of a time and the given columns: x, y, z (metres) and a quaternion (x, y, z, w).
    Raises TrajectoryError."""
    t_ns, numbers = parse_times(rows, path, TrajectoryError), parse_numbers(path, rows, columns)
    check_rows(is_unit_quaternion(numbers[:, 3:]), "not a rotation", path, rows)
    return Trajectory.from_quaternions(numbers, t_ns)


def tum_line(t_ns: int, world_from_cam: Rigid3) -> str:
    """Return one line of a TUM file without the line break."""
    w, x, y, z = world_from_cam.quat_wxyz()
    numbers = [f"{value:.12g}" for value in (*world_from_cam.translation, x, y, z, w)]
    return " ".join([f"{Decimal(t_ns).scaleb(-9):.9f}", *numbers])


def with_trajectory(
    sequence: StereoSequence, path: str | Path, conventions: PoseConventions | None = None
) -> StereoSequence:
    """Return the recording with the poses of a trajectory file: TUM by time, KITTI rows by frame,
    rows with names and folders of matrices by name.

    For a selection of frames, KITTI rows may belong to the selection or to the whole recording.

    Raises:
        TrajectoryError: the file is malformed, or matches no frame.
    """
    trajectory, conventions = Trajectory.read(path), conventions or PoseConventions()
    if (
        trajectory.t_ns is trajectory.by_name is None
        and isinstance(sequence, SequenceView)
        and len(trajectory) == len(sequence.base) != len(sequence)
    ):
        rows = trajectory.match_frames(sequence.base.t_ns, path)
        poses = [rows[index] for index in sequence.indices]
    else:
        on_clock = _to_frame_clock(trajectory, conventions)
        poses = on_clock.match_frames(sequence.t_ns, path, sequence.names)
    return with_poses(sequence, [pose and conventions.undo_conventions(pose) for pose in poses])


def with_pose_conventions(sequence: StereoSequence, conventions: PoseConventions) -> StereoSequence:
    """Return the recording with its own poses converted from the given conventions.

    Raises:
        TrajectoryError: no frame has a pose after the conversion.
    """
    if conventions == PoseConventions():
        return sequence
    poses, t_ns = sequence.poses, sequence.t_ns
    trajectory = Trajectory.of_frames(poses, t_ns)
    if len(trajectory) and (conventions.shift_s or conventions.time_scale != 1.0):
        poses = _to_frame_clock(trajectory, conventions).match_frames(t_ns, Path(sequence.name))
    return with_poses(sequence, [pose and conventions.undo_conventions(pose) for pose in poses])


def align_to_trajectory(sequence: StereoSequence, path: str | Path) -> StereoSequence:
    """Return the recording in the world of a trajectory file, in metres: its own poses, moved and
    scaled to fit best.

    Raises:
        TrajectoryError: the file is malformed, fits no frame, or its positions fix no scale.
    """
    theirs = Trajectory.read(path).match_frames(sequence.t_ns, path, sequence.names)
    pairs = zip(sequence.poses, theirs, strict=True)
    both = [(a, b) for a, b in pairs if a is not None and b is not None]
    if not both:
        raise TrajectoryError(f"{path}: no frame has a pose in it and in {sequence.name}")
    with TrajectoryError.at(path):
        scale, world_from_model = align_scaled_poses([b for _, b in both], [a for a, _ in both])
    scaled = scale_poses(sequence, scale).poses
    return with_poses(sequence, [pose and world_from_model @ pose for pose in scaled])


def _to_frame_clock(trajectory: Trajectory, conventions: PoseConventions) -> Trajectory:
    t_ns, shift_ns = trajectory.t_ns, round(conventions.shift_s * NANOSECONDS_PER_SECOND)
    if t_ns is not None and conventions.time_scale != 1.0:  # floats would round unscaled times
        t_ns = [round(time * conventions.time_scale) for time in t_ns]
    return replace(trajectory, t_ns=t_ns and [time - shift_ns for time in t_ns])


def _clock_hint(of_poses: Sequence[int], of_frames: Sequence[int]) -> str:
    """Describe the likely difference between the clocks of poses and frames: another unit or
    another start."""
    for factor in (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9):
        last = min(of_poses[-1] * factor, of_frames[-1])
        overlap = last - max(of_poses[0] * factor, of_frames[0])
        if overlap > _MIN_OVERLAP_SHARE * (of_frames[-1] - of_frames[0]):
            return f"; its times seem to be in another unit: --poses clock={factor:g}"
    lasts, frames_last = of_poses[-1] - of_poses[0], of_frames[-1] - of_frames[0]
    if _MIN_OVERLAP_SHARE * frames_last < lasts < frames_last / _MIN_OVERLAP_SHARE:
        shift = (of_poses[0] - of_frames[0]) / NANOSECONDS_PER_SECOND
        return f"; if both began at the same moment: --poses shift={shift:.9g}"
    return ""


def _interpolate_pose(
    times: list[int], poses: Sequence[Rigid3], time: int, max_gap_ns: int
) -> Rigid3 | None:
    after = bisect.bisect_left(times, time)
    if after < len(times) and times[after] == time:
        return poses[after]
    if 0 < after < len(times) and times[after] - times[after - 1] <= max_gap_ns:
        fraction = (time - times[after - 1]) / (times[after] - times[after - 1])
        return poses[after - 1].interpolate(poses[after], fraction)
    rows = [row for row in (after - 1, after) if 0 <= row < len(times)]
    near = [row for row in rows if abs(times[row] - time) <= _TIME_TOLERANCE_NS]
    return poses[min(near, key=lambda row: abs(times[row] - time))] if near else None
