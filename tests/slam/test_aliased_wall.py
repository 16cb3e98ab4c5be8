"""Test SLAM along a wall of equal panels: lost frames never cause an unreported error of
a whole panel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from aliased_wall import PERIOD, STEP, walk_along

from room_frames import FrameList
from topoloc.errors import TrajectoryError
from topoloc.recordings.recording import with_poses
from topoloc.slam.pose_checks import check_poses
from topoloc.slam.slam import SlamResult, run_slam

GONE = range(10, 14)


def kept(
    num: int, gone: Sequence[int] = GONE, jump: float = 0.0
) -> tuple[list[float], list[float]]:
    """Return places and times of a walk without some frames. After the gap, the camera is `jump`
    metres further."""
    rows = [k for k in range(num) if k not in gone]
    return [STEP * k + (jump if k > gone[-1] else 0.0) for k in rows], [0.1 * k for k in rows]


def along_the_wall(sequence: FrameList, result: SlamResult) -> np.ndarray:
    """Return the error in metres of each frame along the wall, NaN without a pose."""
    first = sequence.poses[0]
    assert first is not None
    errors = []
    for true, pose in zip(sequence.poses, result.poses[0], strict=True):
        assert true is not None
        errors.append(
            np.nan if pose is None else (first @ pose).translation[0] - true.translation[0]
        )
    return np.array(errors)


def test_four_frames_lost_are_bridged_by_the_motion():
    walked = walk_along(*kept(18))
    result = run_slam(walked)
    assert (result.num_submaps, result.num_lost) == (1, 0)
    assert np.abs(along_the_wall(walked, result)).max() < 0.1


def test_eight_frames_lost_are_bridged_although_another_panel_is_nearer():
    """The camera moved on by a whole panel. A camera at rest would explain the
    image equally well."""
    walked = walk_along(*kept(22, range(10, 18)))
    result = run_slam(walked)
    assert result.num_submaps == 1
    assert np.abs(along_the_wall(walked, result)).max() < 0.1


def test_an_ambiguous_motion_begins_another_submap():
    """The camera is half a panel further than predicted, so that two panels are equally likely.
    SLAM selects neither."""
    walked = walk_along(*kept(20, jump=0.5 * PERIOD))
    result = run_slam(walked)
    assert (result.num_submaps, result.num_joined) == (2, 1)
    errors = along_the_wall(walked, result)
    assert np.nanmax(np.abs(errors)) < 0.1
    assert np.isfinite(errors[:10]).all()
    assert np.isnan(errors[10:]).all()


def test_a_submap_is_joined_by_unique_objects_and_not_by_panels():
    """The camera goes there and back. The gap is too long for prediction, and a board before it is
    seen again on return."""
    there, times = kept(24, jump=0.5)
    back = list(np.arange(there[-1] - STEP, 0.3, -STEP))
    walked = walk_along(
        [*there, *back], [*times, *(times[-1] + 0.1 * np.arange(1, len(back) + 1))], boards=(0.6,)
    )
    result = run_slam(walked)
    assert result.num_submaps == result.num_joined == 2
    assert result.num_loops > 0
    assert np.abs(along_the_wall(walked, result)).max() < 0.1


def worst_step(sequence: FrameList, result: SlamResult) -> float:
    """Return the largest error in metres of a step between two successive poses of one world."""
    worst = 0.0
    for poses in (result.poses[0], *result.apart[0]):
        rows = [row for row, pose in enumerate(poses) if pose is not None]
        for a, b in pairwise(rows):
            walked, found = (
                one[a].inverse() @ one[b]  # pyright: ignore[reportOptionalMemberAccess]
                for one in (sequence.poses, poses)
            )
            worst = max(worst, float(np.linalg.norm(walked.translation - found.translation)))
    return worst


STOPS = np.cumsum([0.5] * 8 + [0.0] * 3 + [0.5] * 3)
THERE_AND_BACK = 0.3 * np.concatenate([np.arange(10), np.arange(9)[::-1]])


@pytest.mark.parametrize(
    ("places", "boards"),
    [(0.6 * np.arange(12), ()), (STOPS, (0.5, 1.0, 2.5)), (THERE_AND_BACK, ())],
    ids=["begins fast", "stops", "turns back"],
)
def test_a_submap_ends_at_an_ambiguous_step(places: np.ndarray, boards: tuple[float, ...]):
    """No frame is lost. A step of more than half a panel looks like a shorter one back. Each of
    these walks once had an unreported error of a whole panel."""
    walked = walk_along(places.tolist(), (0.1 * np.arange(len(places))).tolist(), boards)
    result = run_slam(walked)
    assert result.num_submaps > 1
    assert worst_step(walked, result) < 0.1


def test_an_uneven_walk_is_tracked_with_boards_in_view():
    """Motion prediction cannot distinguish the steps, most of which are 0.2 to 0.7 m.
    The images can."""
    steps = 0.45 * (1.0 + 0.4 * np.random.default_rng(5).standard_normal(24))
    boards = tuple(np.arange(-0.5, 12.0, 1.5))
    walked = walk_along(np.cumsum(steps).tolist(), (0.1 * np.arange(24)).tolist(), boards)
    result = run_slam(walked)
    assert (result.num_submaps, result.num_lost) == (1, 0)
    assert worst_step(walked, result) < 0.1


@pytest.mark.parametrize(("step", "num_gone"), [(0.35, 4), (0.25, 8)])
def test_panels_between_boards_join_nothing(step: float, num_gone: int):
    """After the gap, the images show two new boards and panels like the earlier ones. Images that
    show one panel once joined the pieces four panels off."""
    rows = [k for k in range(24) if not 10 <= k < 10 + num_gone]
    boards = tuple(np.arange(-0.5, 9.0, 2.0))
    walked = walk_along([step * k for k in rows], [0.1 * k for k in rows], boards)
    result = run_slam(walked)
    assert (result.num_submaps, result.num_joined) == (2, 1)
    assert worst_step(walked, result) < 0.1


def test_a_camera_that_turns_back_is_not_lost():
    there = list(np.arange(0.0, 2.0, STEP))
    walked = walk_along([*there, *there[::-1]], list(0.1 * np.arange(2 * len(there))))
    result = run_slam(walked)
    assert (result.num_submaps, result.num_lost) == (1, 0)
    assert np.abs(along_the_wall(walked, result)).max() < 0.05


def test_a_jump_is_tracked_with_boards_on_the_panels():
    """Unique boards make motion prediction unnecessary, although the wall between them repeats."""
    walked = walk_along(*kept(18, jump=0.5), boards=tuple(np.arange(-2.0, 5.0, 0.65)))
    result = run_slam(walked)
    assert result.num_submaps == 1
    assert np.abs(along_the_wall(walked, result)).max() < 0.1


@pytest.mark.parametrize("is_stereo", [True, False])
@pytest.mark.parametrize("step", [0.06, 0.12, 0.18])
def test_equal_panels_do_not_refuse_right_poses(step: float, is_stereo: bool):
    """A step to the next panel matches the images as well as the right step, or better: after
    12 frames of 0.18 m only a sixth of the first image is left in view."""
    walked = walk_along([step * k for k in range(40)], [0.1 * k for k in range(40)])
    alone = [replace(frame, right=None, rig=None) for frame in walked.frames]
    check_poses(walked if is_stereo else FrameList(alone))


@pytest.mark.parametrize("is_stereo", [True, False])
def test_between_boards_wrong_poses_are_found(is_stereo: bool):
    walked = walk_along([0.03 * k for k in range(40)], [0.1 * k for k in range(40)], (1.0, 2.0))
    alone = [replace(frame, right=None, rig=None) for frame in walked.frames]
    frames = walked if is_stereo else FrameList(alone)
    check_poses(frames)
    inverse = [pose.inverse() for pose in frames.poses if pose is not None]
    with pytest.raises(TrajectoryError, match="inverse"):
        check_poses(with_poses(frames, list(inverse)))
