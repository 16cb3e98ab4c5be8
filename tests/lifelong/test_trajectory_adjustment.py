"""Test the adjustment of a whole walk of a single camera: its mapped part fixes the
scale of the rest."""

from __future__ import annotations

import numpy as np
import pytest

from tiny_world import CAMERA, path_pose, render, room
from topoloc.geometry.rigid import Rigid3
from topoloc.lifelong.trajectory_adjustment import adjust_trajectory
from topoloc.localization.result import Localization
from topoloc.recordings.frame import StereoFrame
from topoloc.slam.monocular_odometry import MonocularOdometry, MonocularSubmap

TRUTH = [path_pose(0.5 * number) for number in range(20)]
KNOWN = range(8)


@pytest.fixture
def stretch() -> MonocularSubmap:
    odometry, panels = MonocularOdometry(), room()
    for number, pose in enumerate(TRUTH):
        odometry.process(
            number,
            StereoFrame(
                f"{number}",
                number * 100_000_000,
                render(panels, pose, noise_seed=number)[0],
                CAMERA,
            ),
        )
    (found,) = odometry.submaps
    return found


def _too_long(by: float) -> dict[int, Rigid3]:
    """Return the truth with the part beyond the mapped one stretched."""
    last = TRUTH[KNOWN[-1]].translation
    beyond = [
        Rigid3(pose.rotation, last + by * (pose.translation - last)) for pose in TRUTH[len(KNOWN) :]
    ]
    return dict(enumerate([*TRUTH[: len(KNOWN)], *beyond]))


def _off(poses: dict[int, Rigid3]) -> float:
    return max(
        float(np.linalg.norm(poses[k].translation - true.translation))
        for k, true in enumerate(TRUTH)
    )


def _answers() -> dict[int, Localization]:
    covariance = np.diag([1e-5] * 3 + [1e-7] * 3)
    return {k: Localization(TRUTH[k], covariance, 0.99, 0, [], 100, 80) for k in KNOWN}


def test_the_mapped_part_fixes_the_scale_of_the_rest(stretch: MonocularSubmap):
    held = _too_long(1.15)
    adjusted = adjust_trajectory(stretch, held, _answers())
    assert _off(held) > 0.08
    assert _off(adjusted) < 0.03


def test_frames_without_a_pose_stay_without(stretch: MonocularSubmap):
    held = {k: pose for k, pose in _too_long(1.02).items() if 1 <= k < 15}
    adjusted = adjust_trajectory(stretch, held, _answers())
    assert adjusted.keys() == held.keys()
