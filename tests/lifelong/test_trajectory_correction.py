"""Test the correction of a trajectory towards poses in the map."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.lifelong.trajectory_adjustment import correct_trajectory
from topoloc.localization.result import Localization

D_THRESH = 0.3
TRUTH = [Rigid3(np.eye(3), np.array([0.0, 0.05 * k, 0.0])) for k in range(100)]
ANSWERED = range(60)


def _localized(pose: Rigid3, sigma_m: float = 0.03, sigma_deg: float = 1.0) -> Localization:
    """Return a result whose `camera_covariance` has these sigmas."""
    of_camera = np.diag([sigma_m**2 / 3.0] * 3 + [np.radians(sigma_deg) ** 2 / 3.0] * 3)
    adjoint = pose.adjoint()
    return Localization(pose, adjoint @ of_camera @ adjoint.T, 0.99, 0, [], 100, 80)


def _bent(by_m: float, by_deg: float) -> dict[int, Rigid3]:
    """Return the truth with this error at both ends and none in the middle."""
    bend = np.cos(np.linspace(0.0, 2.0 * np.pi, len(TRUTH)))
    turns = [exp_so3(np.array([0.0, 0.0, np.radians(by_deg) * share])) for share in bend]
    return {
        k: Rigid3(turn @ TRUTH[k].rotation, TRUTH[k].translation + np.array([by_m * share, 0, 0]))
        for k, (turn, share) in enumerate(zip(turns, bend, strict=True))
    }


def _off(poses: dict[int, Rigid3]) -> np.ndarray:
    """Return metres and degrees from the truth, one row per frame."""
    apart = [poses[k].inverse() @ true for k, true in enumerate(TRUTH)]
    return np.array([(np.linalg.norm(one.translation), np.degrees(one.angle())) for one in apart])


def test_the_trajectory_follows_the_poses_of_the_map():
    walk, answers = _bent(0.05, 1.5), {k: _localized(TRUTH[k], 0.03, 0.6) for k in ANSWERED}
    straight = correct_trajectory(walk, answers, D_THRESH)
    known, before = _off(straight)[:60], _off(walk)[:60]
    assert np.all(before.max(axis=0) > (0.049, 1.49))
    assert np.all(known.max(axis=0) < 0.5 * before.max(axis=0))


def test_far_from_poses_the_trajectory_keeps_its_shape():
    walk, answers = _bent(0.05, 1.5), {k: _localized(TRUTH[k]) for k in ANSWERED}
    straight = correct_trajectory(walk, answers, D_THRESH)
    np.testing.assert_allclose(_off(straight)[90:], _off(walk)[90:], atol=1e-6)


def test_single_and_uncertain_poses_hardly_move_it():
    walk = dict(enumerate(TRUTH))
    beside = Rigid3(np.eye(3), TRUTH[30].translation + np.array([0.08, 0.0, 0.0]))
    answers = {k: _localized(TRUTH[k]) for k in ANSWERED} | {30: _localized(beside)}
    assert _off(correct_trajectory(walk, answers, D_THRESH))[:, 0].max() < 0.012
    unsure = {
        k: _localized(Rigid3(np.eye(3), TRUTH[k].translation + np.array([0.1, 0.0, 0.0])), 0.5)
        for k in range(0, 60, 6)
    }
    assert _off(correct_trajectory(walk, unsure, D_THRESH))[:, 0].max() < 0.005


def test_certain_poses_that_contradict_the_walk_do_not_bend_it():
    walk = dict(enumerate(TRUTH))
    elsewhere = {
        k: _localized(Rigid3(np.eye(3), TRUTH[k].translation + np.array([0.2, 0.0, 0.0])))
        for k in range(50, 60)
    }
    np.testing.assert_array_equal(_off(correct_trajectory(walk, elsewhere, D_THRESH)), _off(walk))


@pytest.mark.parametrize("answers", [{}, {3: _localized(TRUTH[3])}])
def test_frames_without_a_pose_stay_without(answers: dict[int, Localization]):
    walk = {k: pose for k, pose in enumerate(TRUTH) if k != 3}
    assert correct_trajectory(walk, answers, D_THRESH).keys() == walk.keys()
