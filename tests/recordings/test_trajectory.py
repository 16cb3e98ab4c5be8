from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tiny_recordings import assert_same_pose, kitti_row, pose, tum_line
from topoloc.errors import TopolocError, TrajectoryError
from topoloc.geometry.pose_conventions import PoseConventions
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings import trajectory
from topoloc.recordings.frame import SequenceView
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import Recording
from topoloc.recordings.trajectory import (
    Trajectory,
    with_pose_conventions,
    with_trajectory,
)

SECOND = 1_000_000_000


def shift(x: float) -> Rigid3:
    return Rigid3(np.eye(3), np.array([x, 0.0, 0.0]))


def test_tum_times_are_exact(tmp_path: Path):
    path = tmp_path / "a.tum"
    path.write_text(
        f"# a comment\n\n{tum_line('1403715273.262142976', pose(0))}\n{tum_line('1403715273.262142977', pose(1))}"  # noqa: E501
        " # last\n"
    )
    trajectory = Trajectory.read(path)
    assert trajectory.t_ns == [1403715273262142976, 1403715273262142977]
    assert_same_pose(trajectory.world_from_cam[1], pose(1))


def test_nanoseconds_are_recognised_by_their_size(tmp_path: Path):
    path = tmp_path / "a.tum"
    path.write_text(
        f"{tum_line('1403715273262142976.000000', pose(0))}\n{tum_line('1403715273312143104', pose(1))}\n"  # noqa: E501
    )
    assert Trajectory.read(path).t_ns == [1403715273262142976, 1403715273312143104]


def test_kitti_rows(tmp_path: Path):
    path = tmp_path / "a.txt"
    path.write_text(f"{kitti_row(pose(0))}\n{kitti_row(pose(1))}\n")
    trajectory = Trajectory.read(path)
    assert trajectory.t_ns is None
    assert_same_pose(trajectory.world_from_cam[1], pose(1))


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.integers(-5 * SECOND, 2_000_000_000 * SECOND), min_size=1, max_size=5, unique=True),
    st.integers(0, 1000),
)
def test_a_written_trajectory_is_read_again(
    tmp_path_factory: pytest.TempPathFactory, times: list[int], seed: int
):
    folder = tmp_path_factory.mktemp("trip")
    poses = [Rigid3.exp(xi) for xi in np.random.default_rng(seed).normal(size=(len(times), 6))]
    Trajectory(poses, sorted(times)).write_tum(folder / "a.tum")
    np.savetxt(folder / "a.txt", [pose.matrix()[:3].ravel() for pose in poses], fmt="%.12e")
    assert Trajectory.read(folder / "a.tum").t_ns == sorted(times)
    for name in ("a.tum", "a.txt"):
        for one, other in zip(Trajectory.read(folder / name).world_from_cam, poses, strict=True):
            assert_same_pose(one, other)
    assert sorted(path.name for path in folder.iterdir()) == ["a.tum", "a.txt"]


def test_writing_replaces_the_file_or_leaves_it(tmp_path: Path):
    path = tmp_path / "a.tum"
    path.write_text("old")
    with pytest.raises(TrajectoryError, match="times"):
        Trajectory([pose(0)]).write_tum(path)
    assert path.read_text() == "old"
    Trajectory([pose(0)], [7]).write_tum(path)
    assert Trajectory.read(path).t_ns == [7]
    with pytest.raises(TopolocError, match="cannot write"):
        Trajectory([pose(0)], [7]).write_tum(tmp_path / "nowhere" / "a.tum")


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (["0 0 0 0 0 0 0 1", "1 nan 0 0 0 0 0 1"], r"line 2.*nan"),
        (["0 0 0 0 0 0 0 1", "1 x 0 0 0 0 0 1"], r"line 2.*number"),
        (["0 0 0 0 0 0 0 1", "nan 0 0 0 0 0 0 1"], r"line 2.*not a time"),
        (["0 0 0 0 0 0 0 1", "1 0 0 0 0 0 1"], r"line 2.*7 columns"),
        (["0 0 0 0 0 0 1"], r"line 1.*7 columns"),
        (["# comment", "0 0 0 0 0 0 0 0"], r"line 2.*rotation"),
        (["0 0 0 0 0 0 0.5 0.5"], r"line 1.*rotation"),
        (["1 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 1"], r"line 2.*not after"),
        (["2 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 1"], r"line 2.*not after"),
        (["1 0 0 0 0 1 0 0 0 0 1 0", "1 0 0 0 0 1 0 0 0 0 -1 0"], r"line 2.*rotation"),
        (["1 0 0 0 0 1 0 0 0 0 inf 0"], r"line 1.*infinite"),
        (["# nothing"], "nothing in"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, lines: list[str], says: str):
    path = tmp_path / "bad.tum"
    path.write_text("\n".join(lines))
    with pytest.raises(TrajectoryError, match=r"bad\.tum.*" + says):
        Trajectory.read(path)


def test_missing_and_binary_files(tmp_path: Path):
    with pytest.raises(TrajectoryError, match="no such"):
        Trajectory.read(tmp_path / "gone.tum")
    (tmp_path / "binary.tum").write_bytes(b"\xff\xfe\x00\x81" * 9)
    with pytest.raises(TrajectoryError, match=r"binary\.tum"):
        Trajectory.read(tmp_path / "binary.tum")


def test_poses_between_are_interpolated_and_gaps_are_not():
    trajectory = Trajectory([shift(0), shift(1), shift(5)], [0, SECOND // 10, SECOND])
    times = [
        0,
        SECOND // 40,
        SECOND // 10,
        SECOND // 2,
        SECOND,
        SECOND + 500_000,
        SECOND + 2_000_000,
        -500_000,
        SECOND // 10 + 900_000,
    ]
    found = [
        None if pose is None else round(float(pose.translation[0]), 9)
        for pose in trajectory.interpolate(times)
    ]
    assert found == [0.0, 0.25, 1.0, None, 5.0, 5.0, None, 0.0, 1.0]
    assert trajectory.interpolate([SECOND // 2], max_gap=1.0)[0] is not None


def test_rows_have_no_times_to_look_up():
    with pytest.raises(TrajectoryError, match="row"):
        Trajectory([shift(0)]).interpolate([0])


def test_other_poses_for_the_same_recording(kitti: Path, tmp_path: Path):
    sequence = open_sequence(kitti)
    (tmp_path / "slam.tum").write_text(f"{tum_line('0.0', pose(5))}\n{tum_line('0.1', pose(6))}\n")
    other = with_trajectory(sequence, tmp_path / "slam.tum")
    assert_same_pose(other[0].world_from_cam, pose(5))
    assert_same_pose(other.poses[1], pose(6))
    assert other.poses[2] is None
    assert other[2].world_from_cam is None
    np.testing.assert_array_equal(other[2].image, sequence[2].image)
    assert_same_pose(sequence[0].world_from_cam, pose(0))


def test_rows_of_the_whole_recording_for_a_part_of_it(kitti: Path, tmp_path: Path):
    part = open_sequence(f"{kitti}@0::2")
    (tmp_path / "whole.txt").write_text("\n".join(kitti_row(pose(index)) for index in (5, 6, 7)))
    assert_same_pose(with_trajectory(part, tmp_path / "whole.txt")[1].world_from_cam, pose(7))
    (tmp_path / "part.txt").write_text("\n".join(kitti_row(pose(index)) for index in (8, 9)))
    assert_same_pose(with_trajectory(part, tmp_path / "part.txt").poses[1], pose(9))


def test_a_trajectory_that_fits_no_frame(kitti: Path, tmp_path: Path):
    sequence = open_sequence(kitti)
    (tmp_path / "later.tum").write_text(tum_line("1000.0", pose(0)))
    with pytest.raises(TrajectoryError, match=r"later\.tum: no frame"):
        with_trajectory(sequence, tmp_path / "later.tum")
    (tmp_path / "short.txt").write_text(kitti_row(pose(0)))
    with pytest.raises(TrajectoryError, match=r"short\.txt: 1 poses for 3 frames"):
        with_trajectory(sequence, tmp_path / "short.txt")


def test_euroc_trajectory_in_nanoseconds(euroc: Path, tmp_path: Path):
    sequence = open_sequence(euroc)
    path = tmp_path / "CameraTrajectory.txt"
    path.write_text(
        "".join(f"{tum_line(f'{t_ns}.000000', pose(i))}\n" for i, t_ns in enumerate(sequence.t_ns))
    )
    for index, found in enumerate(with_trajectory(sequence, path).poses):
        assert_same_pose(found, pose(index))


def test_times_beyond_all_clocks_are_refused_at_once(tmp_path: Path):
    (tmp_path / "a.tum").write_text(f"1e999999999999 {tum_line('0', pose(0)).partition(' ')[2]}\n")
    with pytest.raises(TrajectoryError, match=r"line 1.*not a time"):
        Trajectory.read(tmp_path / "a.tum")


@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_rotations_of_kitti_rows_are_made_exact(tmp_path: Path, turned: float):
    row = np.hstack(
        [turned * (pose(1).rotation + 1e-4 * np.arange(9).reshape(3, 3)), np.zeros((3, 1))]
    )
    (tmp_path / "a.txt").write_text(" ".join(f"{value:.12f}" for value in row.ravel()) + "\n")
    if turned < 0:
        with pytest.raises(TrajectoryError, match="line 1: not a rotation"):
            Trajectory.read(tmp_path / "a.txt")
        return
    rotation = Trajectory.read(tmp_path / "a.txt").world_from_cam[0].rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation, pose(1).rotation, atol=2e-3)


def test_a_clock_offset_is_reported_and_corrected(tmp_path: Path):
    poses = [Rigid3(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) for k in range(20)]
    frames = [1_700_000_000_000_000_000 + 100_000_000 * k for k in range(20)]
    late, in_microseconds = tmp_path / "late.tum", tmp_path / "microseconds.tum"
    Trajectory(poses, [time + 5_000_000_000_000 for time in frames]).write_tum(late)
    Trajectory(poses, frames).write_tum(in_microseconds)
    rows = [line.split() for line in in_microseconds.read_text().splitlines()[1:]]
    in_microseconds.write_text(
        "\n".join(" ".join([str(int(float(row[0]) * 1e6)), *row[1:]]) for row in rows)
    )
    with pytest.raises(TrajectoryError, match="--poses shift=5000"):
        Trajectory.read(late).match_frames(frames, late)
    shift = PoseConventions.parse("shift=5000")
    found = with_trajectory(recording_of(frames), late, shift).poses
    read = Trajectory.read(in_microseconds).match_frames(frames, in_microseconds)
    for of_file in (found, read):
        assert sum(pose is not None for pose in of_file) >= 18
        assert all(
            pose is None or np.allclose(pose.translation, poses[k].translation, atol=0.02)
            for k, pose in enumerate(of_file)
        )


def test_own_poses_are_read_in_the_given_convention():
    poses = [Rigid3(np.eye(3), np.array([0.1 * k, 0.0, 0.0])) for k in range(20)]
    sequence = SequenceView(
        recording_of([100_000_000 * k for k in range(20)]), list(range(20)), list(poses)
    )
    read = with_pose_conventions(sequence, PoseConventions.parse("mm,shift=0.2"))
    assert read.poses[-2:] == [None, None]
    np.testing.assert_allclose(
        [pose.translation[0] for pose in read.poses[:-2] if pose],
        [1e-4 * (k + 2) for k in range(18)],
        atol=1e-12,
    )


def recording_of(t_ns: list[int]) -> Recording:
    """Return a recording without images."""
    return Recording(
        "none", Path(), [f"{k}.png" for k in range(len(t_ns))], t_ns, [None] * len(t_ns), None
    )


@pytest.mark.parametrize(
    "lines",
    [
        [
            "1403636579.763555584 0 1 2 0 0 0 1",
            "1403636579.763555585 0 1.5 2e-3 0 0 0.6 0.8",
        ],  # read at once
        ["# t", "1403636579 0 1 2 0 0 0 1", "", "1403636580\t0 1.5 2e-3 0 0 0.6 0.8 # the last"],
        [
            "1403636579763555584 0 1 2 0 0 0 1",
            "1403636579763555585 0 1.5 2e-3 0 0 0.6 0.8",
        ],  # nanoseconds
        ["9.5 0 1 2 0 0 0 1", "10.25 0 1.5 2e-3 0 0 0.6 0.8"],  # of several lengths
        ["0.0 0 1 2 0 0 0 1", "1e0 0 1.5 2e-3 0 0 0.6 0.8"],
        ["5,0,1,2,0,0,0,1", "6,0,1.5,2e-3,0,0,0.6,0.8"],
        [" 5 0 1 2 0 0 0 1", " 6 0 1.5 2e-3 0 0 0.6 0.8"],
    ],
)
def test_read_at_once_or_line_by_line_it_is_the_same(tmp_path: Path, lines: list[str]):
    (tmp_path / "a.tum").write_text("\n".join(lines) + "\n")
    whole, by_lines = (
        Trajectory.read(tmp_path / "a.tum"),
        trajectory._trajectory_from_rows(tmp_path / "a.tum"),
    )
    assert whole.t_ns == by_lines.t_ns
    for one, other in zip(whole.world_from_cam, by_lines.world_from_cam, strict=True):
        assert_same_pose(one, other, 0.0)
    np.testing.assert_allclose(whole.world_from_cam[1].translation, [0.0, 1.5, 2e-3])


def test_exact_times_are_read_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A million lines take only seconds, because they are not parsed one by one."""
    poses = [pose(index) for index in range(5)]
    Trajectory(poses, [1_700_000_000_123_456_789 + index for index in range(5)]).write_tum(
        tmp_path / "a.tum"
    )
    monkeypatch.setattr(trajectory, "_trajectory_from_rows", None)
    read = Trajectory.read(tmp_path / "a.tum")
    assert read.t_ns == [1_700_000_000_123_456_789 + index for index in range(5)]
    for one, other in zip(poses, read.world_from_cam, strict=True):
        assert_same_pose(one, other)
    assert len(read.world_from_cam[1:4]) == 3
    assert_same_pose(read.world_from_cam[1:4][-1], poses[3])
