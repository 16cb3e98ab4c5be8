"""Check that trajectories of a wrong convention are named, and that right ones pass."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topoloc.errors import TrajectoryError
from topoloc.geometry.camera import Camera
from topoloc.geometry.pose_conventions import PoseConventions
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.frame import (
    MemorySequence,
    SequenceView,
    StereoFrame,
    StereoSequence,
)
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import with_poses
from topoloc.slam.input_checks import check_pose_coverage
from topoloc.slam.measured_steps import MeasuredStep, measure_steps
from topoloc.slam.pose_checks import check_poses, evaluate_poses

BODY_FROM_CAM = Rigid3(exp_so3(np.array([1.2, -1.1, 0.7])), np.array([0.3, -0.1, 0.5]))
FLIP, FLU = (
    np.diag([1.0, -1.0, -1.0]),
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
)


def w_first(pose: Rigid3) -> Rigid3:
    w, x, y, z = pose.quat_wxyz()
    return Rigid3.from_quat_wxyz(np.array([z, w, x, y]), pose.translation)


# Poses in other conventions, and words of their error messages.
WRONG: dict[str, tuple[Callable[[Rigid3], Rigid3], tuple[str, ...]]] = {
    "inverse": (Rigid3.inverse, ("inverse",)),
    "opengl": (lambda pose: Rigid3(pose.rotation @ FLIP, pose.translation), ("opengl",)),
    "inverse opengl": (
        lambda pose: Rigid3(pose.rotation @ FLIP, pose.translation).inverse(),
        ("inverse", "opengl"),
    ),
    "wxyz": (w_first, ("wxyz",)),
    "transposed": (lambda pose: Rigid3(pose.rotation.T.copy(), pose.translation), ("transposed",)),
    "flu": (lambda pose: Rigid3(pose.rotation @ FLU.T, pose.translation), ("flu",)),
    "mm": (lambda pose: Rigid3(pose.rotation, 1000.0 * pose.translation), ("mm",)),
}


def walk(num_frames: int) -> list[Rigid3]:
    """Return poses of a hand-held camera that moves on, sways, and looks around."""
    k = np.arange(num_frames)
    ways = np.column_stack([np.sin(0.13 * k), 0.1 * np.sin(0.31 * k), 0.08 * k])
    turns = np.column_stack(
        [0.15 * np.sin(0.23 * k), 0.5 * np.sin(0.09 * k + 1.0), 0.1 * np.cos(0.17 * k)]
    )
    world = Rigid3(exp_so3(np.array([0.3, -0.5, 0.9])), np.array([3.0, 2.0, 1.0]))
    return [world @ Rigid3(exp_so3(turn), way) for turn, way in zip(turns, ways, strict=True)]


POSES, T_NS = walk(120), [100_000_000 * k for k in range(120)]


def steps_of(poses: list[Rigid3], seed: int) -> list[MeasuredStep]:
    """Return steps as images give them: errors of some millimetres and a fifth of a degree,
    and one outlier."""
    rng, steps = np.random.default_rng(seed), []
    for first in range(0, 105, 7):
        noise = Rigid3(exp_so3(rng.normal(0.0, 0.003, 3)), rng.normal(0.0, 0.005, 3))
        steps.append(
            MeasuredStep(first, first + 10, poses[first].inverse() @ poses[first + 10] @ noise, 3.0)
        )
    return [*steps[:-1], replace(steps[-1], first_from_last=Rigid3.exp(np.full(6, 0.5)))]


@pytest.mark.parametrize("seed", range(4))
def test_right_poses_pass(seed: int):
    verdict = evaluate_poses(steps_of(POSES, seed), POSES, T_NS)
    assert verdict.is_accepted
    assert verdict.num_informative == len(steps_of(POSES, seed))


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_convention_is_named(name: str):
    spoil, conventions = WRONG[name]
    verdict = evaluate_poses(steps_of(POSES, 0), [spoil(pose) for pose in POSES], T_NS)
    assert not verdict.is_accepted
    assert verdict.conventions == conventions


def without_metres(steps: list[MeasuredStep]) -> list[MeasuredStep]:
    """Return the same steps as a single camera gives them."""
    ways = [step.first_from_last.translation for step in steps]
    units = [
        Rigid3(step.first_from_last.rotation, way / np.linalg.norm(way))
        for step, way in zip(steps, ways, strict=True)
    ]
    return [
        replace(step, first_from_last=unit, median_depth=0.0, has_scale=False)
        for step, unit in zip(steps, units, strict=True)
    ]


@pytest.mark.parametrize("name", WRONG)
def test_a_single_camera_names_all_but_the_unit(name: str):
    spoil, conventions = WRONG[name]
    steps = without_metres(steps_of(POSES, 0))
    assert evaluate_poses(steps, POSES, T_NS).is_accepted
    verdict = evaluate_poses(steps, [spoil(pose) for pose in POSES], T_NS)
    assert verdict.conventions == (() if name == "mm" else conventions)
    assert verdict.is_accepted == (name == "mm")


def test_poses_of_a_single_camera_at_rest_are_refused():
    still = [Rigid3(pose.rotation, np.zeros(3)) for pose in POSES]
    assert not evaluate_poses(without_metres(steps_of(POSES, 0)), still, T_NS).is_accepted


def test_the_mounting_on_a_body_is_found():
    verdict = evaluate_poses(
        steps_of(POSES, 0), [pose @ BODY_FROM_CAM.inverse() for pose in POSES], T_NS
    )
    (convention,) = verdict.conventions
    mended = PoseConventions.parse(convention).undo_conventions(Rigid3.identity())
    assert np.linalg.norm(mended.translation - BODY_FROM_CAM.translation) < 0.05
    assert (mended.inverse() @ BODY_FROM_CAM).angle() < np.radians(2.0)


def test_a_shifted_clock_is_found():
    late = [None] * 6 + list(POSES[:-6])  # frame k has the pose that frame k - 6 had
    (convention,) = evaluate_poses(steps_of(POSES, 0), late, T_NS).conventions
    assert PoseConventions.parse(convention).shift_s == pytest.approx(0.6, abs=0.1)


def test_poses_of_another_place_are_not_explained():
    rng = np.random.default_rng(1)
    verdict = evaluate_poses(
        steps_of(POSES, 0), [Rigid3.exp(rng.normal(0.0, 1.0, 6)) for _ in POSES], T_NS
    )
    assert not verdict.is_accepted
    assert verdict.conventions == ()


def test_huge_positions_are_refused():
    far = [Rigid3(pose.rotation, 1e200 * pose.translation) for pose in POSES]
    verdict = evaluate_poses(steps_of(POSES, 0), far, T_NS)
    assert not verdict.is_accepted
    assert verdict.conventions == ()


def test_a_camera_at_rest_gives_no_result():
    still = [MeasuredStep(k, k + 1, Rigid3.identity(), 3.0) for k in range(20)]
    assert evaluate_poses(still, [pose.inverse() for pose in POSES], T_NS).is_accepted


def test_steps_are_measured_from_pictures(tiny_recording: Path):
    sequence = open_sequence(tiny_recording)
    posed = list(range(len(sequence)))
    steps = measure_steps(sequence, posed, num_steps=6)
    assert len(steps) >= 5
    for step in steps:
        first, last = sequence.poses[step.first], sequence.poses[step.last]
        assert first is not None
        assert last is not None
        apart = (first.inverse() @ last).inverse() @ step.first_from_last
        assert np.linalg.norm(apart.translation) < 0.02
        assert apart.angle() < np.radians(0.5)


def test_a_recording_is_refused_in_one_line(tiny_recording: Path):
    sequence = open_sequence(tiny_recording)
    check_poses(sequence)
    inverse = [pose.inverse() for pose in sequence.poses if pose is not None]
    with pytest.raises(TrajectoryError, match="--poses inverse"):
        check_poses(with_poses(sequence, list(inverse)))


class LeftPicturesAlone(SequenceView):
    def __getitem__(self, index: int) -> StereoFrame:
        return replace(super().__getitem__(index), right=None, rig=None)


def test_a_recording_of_single_images_is_checked_too(tiny_recording: Path):
    sequence = open_sequence(tiny_recording)
    rows = list(range(len(sequence)))
    check_poses(LeftPicturesAlone(sequence, rows, list(sequence.poses)))
    inverse = [pose.inverse() for pose in sequence.poses if pose is not None]
    with pytest.raises(TrajectoryError, match="--poses inverse"):
        check_poses(LeftPicturesAlone(sequence, rows, list(inverse)))


def named_recording(names: list[str], poses: list[Rigid3]) -> MemorySequence:
    image, camera = np.zeros((24, 32), np.uint8), Camera.pinhole(32, 24, 40.0, 40.0, 15.5, 11.5)
    frames = zip(names, T_NS, poses, strict=False)
    return MemorySequence(
        [StereoFrame(name, t, image, camera, world_from_cam=pose) for name, t, pose in frames]
    )


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the steps be those of `POSES`."""

    def measure(sequence: StereoSequence, _: list[int]) -> list[MeasuredStep]:
        steps = steps_of(POSES, 0)
        frames = {int(name.split("_")[1]): k for k, name in enumerate(sequence.names)}
        return [
            replace(step, first=frames[step.first], last=frames[step.last])
            for step in steps
            if {step.first, step.last} <= frames.keys()
        ]

    monkeypatch.setattr("topoloc.slam.pose_checks.measure_steps", measure)
    monkeypatch.setattr("topoloc.slam.pose_checks.check_calibration", lambda *_: None)


@pytest.mark.usefixtures("measured")
@pytest.mark.parametrize("num_frames", [60, 85, 120])
@pytest.mark.parametrize("pattern", ["left/im_{}_.png", "im_{:02d}_x.jpg"])
@pytest.mark.parametrize("first", [0, 5])
def test_rows_in_the_order_of_names_as_text(num_frames: int, pattern: str, first: int):
    """Of a whole recording, and of a part of it. Rows in the right order pass."""
    names = [pattern.format(number) for number in range(num_frames)]
    rows = [pose for _, pose in sorted(zip(names, POSES, strict=False), key=lambda pair: pair[0])]
    check_poses(named_recording(names, POSES)[first:])
    if names == sorted(names):
        check_poses(named_recording(names, rows)[first:])
        return
    with pytest.raises(TrajectoryError, match=r"sorted as text \(im_0+_.*: sort the rows"):
        check_poses(named_recording(names, rows)[first:])


def test_gaps_of_more_than_half(tiny_recording: Path):
    sequence = open_sequence(tiny_recording)
    poses = [pose if k < 5 else None for k, pose in enumerate(sequence.poses)]
    with pytest.raises(TrajectoryError, match=f"only 5 of {len(sequence)} frames"):
        check_pose_coverage(with_poses(sequence, poses))
    check_pose_coverage(sequence)
