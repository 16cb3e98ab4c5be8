"""Test absolute error and drift with trajectories of known error."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.errors import TrajectoryError
from topoloc.geometry.alignment import absolute_trajectory_errors, relative_drift
from topoloc.geometry.rigid import Rigid3, exp_so3


def circle(
    num: int, radius: float = 10.0, yaw_error: float = 0.0, scale: float = 1.0
) -> list[Rigid3]:
    """Return a camera path around a circle in equal steps, with a yaw error per step or a
    wrong step length."""
    step = Rigid3(
        exp_so3(np.array([0.0, 2 * np.pi / num + yaw_error, 0.0])),
        np.array([0.0, 0.0, scale * 2 * np.pi * radius / num]),
    )
    poses = [Rigid3.identity()]
    for _ in range(num - 1):
        poses.append(poses[-1] @ step)
    return poses


def test_a_trajectory_in_another_world_is_perfect():
    truth = circle(60)
    other = Rigid3.exp(np.array([3.0, -1.0, 2.0, 0.4, -0.2, 1.0]))
    moved = [other @ pose for pose in truth]
    np.testing.assert_allclose(absolute_trajectory_errors(truth, moved), 0.0, atol=1e-9)
    drift = relative_drift(truth, moved)
    assert drift is not None
    assert drift.translation == pytest.approx(0.0, abs=1e-9)
    assert drift.rotation == pytest.approx(0.0, abs=1e-9)


def test_steps_two_percent_too_long_are_two_percent_of_drift():
    straight = [Rigid3(np.eye(3), np.array([0.0, 0.0, float(i)])) for i in range(60)]
    longer = [Rigid3(np.eye(3), 1.02 * pose.translation) for pose in straight]
    assert relative_drift(straight, longer) is not None
    # positions on a line fix no rotation about it: the errors are along it, centred
    np.testing.assert_allclose(
        absolute_trajectory_errors(straight, longer), 0.02 * np.abs(np.arange(60) - 29.5), atol=1e-6
    )


def test_rotation_drift_is_a_metre():
    num, radius, yaw_error = 200, 10.0, 1e-3
    drift = relative_drift(circle(num, radius), circle(num, radius, yaw_error))
    assert drift is not None
    assert drift.rotation == pytest.approx(yaw_error / (2 * np.pi * radius / num), rel=0.05)


def test_too_short_a_path_has_no_drift_and_unequal_lengths_are_refused():
    assert relative_drift(circle(3, 0.5), circle(3, 0.5)) is None
    with pytest.raises(TrajectoryError, match="3 and 4"):
        relative_drift(circle(3), circle(4))
