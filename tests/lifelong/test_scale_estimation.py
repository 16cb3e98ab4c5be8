"""Test the metric scale of a motion in unknown units. Some poses of the map are wrong, and
the unit drifts."""

from __future__ import annotations

import numpy as np

from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.lifelong.scale_estimation import (
    MotionTolerance,
    find_motion_consensus,
    scale_to_metres,
)
from topoloc.lifelong.single_camera_poses import align_stretch_to_map
from topoloc.localization.result import Localization

WORLD_FROM_OWN = Rigid3(exp_so3(np.array([0.4, -0.3, 1.0])), np.array([3.0, -2.0, 1.0]))
TRUTH = [
    Rigid3(exp_so3(np.array([0.0, 0.0, 0.02 * k])), np.array([0.2 * k, 0.5 * np.sin(0.1 * k), 0.0]))
    for k in range(80)
]
TOLERANCE = MotionTolerance(0.2, 2.0, 0.05, 1.0)
WRONG = Rigid3(np.eye(3), np.array([2.0, 1.0, 0.0]))


def _motion(drift: float) -> dict[int, Rigid3]:
    """Return the motion in units of about half a metre, which grow by `drift` over
    the whole path."""
    position, own = np.zeros(3), {0: TRUTH[0]}
    for k in range(1, len(TRUTH)):
        position = position + (TRUTH[k].translation - TRUTH[k - 1].translation) * 2.0 * (
            1.0 + drift * k / len(TRUTH)
        )
        own[k] = Rigid3(TRUTH[k].rotation, position)
    return own


def _answer(k: int) -> Localization:
    covariance = np.diag([1e-5] * 3 + [1e-10] * 3)
    return Localization(WORLD_FROM_OWN @ TRUTH[k], covariance, 0.99, 0, [], 100, 80)


def _answers(numbers: list[int], wrong: list[int]) -> dict[int, Localization]:
    answers = {k: _answer(k) for k in numbers}
    for k in wrong:
        answers[k] = Localization(
            WRONG @ answers[k].world_from_cam, answers[k].covariance, 0.99, 0, [], 100, 80
        )
    return answers


def test_wrong_answers_are_left_out():
    answers = _answers(list(range(0, 80, 4)), [8, 40, 64])
    agreeing = find_motion_consensus(_motion(0.05), answers, TOLERANCE, is_metric=False)
    assert agreeing == [k for k in answers if k not in (8, 40, 64)]


def test_a_drifting_unit_is_fixed_by_poses_and_wrong_ones_bend_nothing():
    answers = _answers([*range(0, 20, 2), 40, *range(60, 80, 2)], [40])
    poses, agreeing = align_stretch_to_map("walk", _motion(0.1), answers, 0.6)
    assert poses is not None
    assert agreeing == [k for k in answers if k != 40]
    off = [
        np.linalg.norm(poses[k].translation - (WORLD_FROM_OWN @ true).translation)
        for k, true in enumerate(TRUTH)
    ]
    assert max(off) < 0.1


def test_too_few_poses_fix_no_scale():
    poses, _ = align_stretch_to_map("walk", _motion(0.0), _answers([0, 30, 60], []), 0.6)
    assert poses is None


def test_frames_far_from_any_pose_are_dropped():
    answers = _answers(list(range(0, 20, 2)), [])
    metric = scale_to_metres(_motion(0.0), answers, drift=0.1, max_sigma=0.2)
    assert 0 in metric
    assert 25 in metric
    assert 79 not in metric


def test_frames_with_a_contradiction_of_map_and_motion_get_no_poses():
    """The start of the motion is wrong. The map localizes four of its images and not the
    one between them."""
    motion = _motion(0.0)
    for k in range(5):
        motion[k] = Rigid3(
            motion[k].rotation, motion[k].translation + np.array([0.0, 0.0, 0.6 - 0.1 * k])
        )
    answers = _answers([0, 1, 3, 4, *range(6, 60, 2)], [])
    poses, agreeing = align_stretch_to_map("walk", motion, answers, 0.6)
    assert poses is not None
    assert min(agreeing) >= 4
    assert poses.keys().isdisjoint(range(4))
    assert poses.keys() >= set(range(6, len(TRUTH)))


def test_two_consistent_sets_of_poses_give_no_result():
    """The map localizes most images at a similar place in reverse direction."""
    turned = Rigid3(np.diag([-1.0, -1.0, 1.0]), np.array([9.0, -3.0, 0.0]))
    answers = _answers([*range(0, 30, 2), *range(40, 60, 2)], [])
    for k in range(0, 30, 2):
        wrong = WORLD_FROM_OWN @ turned @ TRUTH[k]
        answers[k] = Localization(wrong, answers[k].covariance, 0.99, 0, [], 100, 80)
    poses, agreeing = align_stretch_to_map("walk", _motion(0.0), answers, 0.6)
    assert poses is None
    assert agreeing == []
