"""Test the noise scales of a session's motion and the map's poses, estimated from each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.lifelong.scale_estimation import LocalizedStep, NoiseScale, fit_noise_scale
from topoloc.lifelong.session_poses import align_motion_to_map
from topoloc.localization.result import Localization

FACTORS = (0.5, 1.0, 3.0, 10.0), (1.0 / 3.0, 1.0)
D_THRESH, SIGMA_M = 0.3, 0.02
TRUTH = {
    k: Rigid3(exp_so3(np.array([0.0, 0.01 * k, 0.0])), np.array([0.0, 0.0, 0.2 * k]))
    for k in range(150)
}


def _answers(sigma_m: float, seed: int = 0) -> dict[int, Localization | None]:
    """Return poses of a map that states an error of `SIGMA_M` and has an error of `sigma_m`."""
    rng = np.random.default_rng(seed)
    scatter = np.diag([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])
    answers = dict[int, Localization | None]()
    for k, true in TRUTH.items():
        pose = true @ Rigid3.exp(sigma_m * scatter @ rng.normal(size=6))
        adjoint = pose.adjoint()
        answers[k] = Localization(
            pose, adjoint @ (SIGMA_M * scatter) ** 2 @ adjoint.T, 0.99, 0, [], 100, 80
        )
    return answers


def _motion(sigma_m: float, seed: int = 1) -> dict[int, Rigid3]:
    """Return the walk in its own world frame, with an error of `sigma_m` per step."""
    rng = np.random.default_rng(seed)
    poses = {0: Rigid3.identity()}
    for k in range(1, len(TRUTH)):
        off = Rigid3.exp(sigma_m * rng.normal(size=6) * [1.0, 1.0, 1.0, 0.3, 0.3, 0.3])
        poses[k] = poses[k - 1] @ (TRUTH[k - 1].inverse() @ TRUTH[k]) @ off
    return poses


def _rms(
    own: dict[int, Rigid3], answers: dict[int, Localization | None], trust: NoiseScale | None
) -> float:
    held = align_motion_to_map("walk", own, answers, D_THRESH, trust).world_from_cams
    return float(
        np.sqrt(
            np.mean(
                [
                    np.sum(np.square(pose.translation - TRUTH[k].translation))
                    for k, pose in held.items()
                ]
            )
        )
    )


@pytest.mark.parametrize(
    ("of_motion", "of_answers", "share"),
    [(0.0003, SIGMA_M, 0.92), (0.015, 0.004, 0.5)],
    ids=["a lap without drift, asked by night", "a walk that drifts, in a map that knows it well"],
)
def test_estimated_noise_scales_improve_the_poses_of_a_session(
    of_motion: float, of_answers: float, share: float
):
    own, answers = _motion(of_motion), _answers(of_answers)
    assert _rms(own, answers, None) < share * _rms(own, answers, NoiseScale())


def test_nothing_is_lost_if_the_noise_is_as_assumed():
    own, answers = _motion(0.003), _answers(SIGMA_M)
    assert _rms(own, answers, None) < 1.1 * _rms(own, answers, NoiseScale())


def _steps(own: dict[int, Rigid3], answers: dict[int, Localization | None]) -> list[LocalizedStep]:
    steps = []
    for k, answer in answers.items():
        assert answer is not None
        moved = own[k].inverse() @ own[k - 1] if k else Rigid3.identity()
        spread = np.diag([0.003**2] * 3 + [0.001**2] * 3)
        steps.append(
            LocalizedStep(moved, spread, answer.world_from_cam.inverse(), answer.camera_covariance)
        )
    return steps


def test_one_wrong_pose_changes_nothing():
    steps = _steps(_motion(0.0003), _answers(SIGMA_M))
    trust = fit_noise_scale(steps, *FACTORS)
    assert trust == NoiseScale(0.5, 1.0)
    steps[20] = replace(
        steps[20],
        cam_from_world=Rigid3(np.eye(3), np.array([0.4, 0.0, 0.0])) @ steps[20].cam_from_world,
    )
    assert fit_noise_scale(steps, *FACTORS) == trust


def test_a_single_pose_gives_no_scale():
    steps = _steps(_motion(0.01), _answers(SIGMA_M))
    assert fit_noise_scale(steps[:1], *FACTORS) == NoiseScale()
