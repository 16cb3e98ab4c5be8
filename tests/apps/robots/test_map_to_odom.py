"""Test the published transform: smooth correction about the robot, immediate correction,
and planar mode."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.apps.robots.map_to_odom import MapToOdom, project_to_plane, tilt
from topoloc.geometry.rigid import Rigid3

ODOM_FROM_BASE = Rigid3.exp(np.array([20.0, 0.0, 0.0, 0.0, 0.0, 0.2]))


def _moved(xi: list[float]) -> Rigid3:
    """Return map_from_base after a correction of the robot in its own axes."""
    return ODOM_FROM_BASE @ Rigid3.exp(np.array(xi))


def test_corrections_move_the_robot_no_faster_than_allowed():
    """The robot is 20 m from the origin of odom and is corrected by 10 cm and 0.1 rad. A rotation
    about that origin would move it by two metres."""
    followed = MapToOdom(speed=0.2, turn_rate=0.5)
    assert followed.advance(5.0) is None
    followed.set_target(ODOM_FROM_BASE, ODOM_FROM_BASE, at_once=False)
    first = followed.advance(5.1)
    assert first is not None
    assert np.allclose(first.matrix(), np.eye(4), atol=1e-12)
    target = _moved([0.1, 0.0, 0.0, 0.0, 0.0, 0.1])
    followed.set_target(target, ODOM_FROM_BASE, at_once=False)
    robots = [Rigid3.identity()]
    for k in range(7):
        pose = followed.advance(5.2 + 0.1 * k)
        assert pose is not None
        robots.append(pose @ ODOM_FROM_BASE)
    steps = np.diff([robot.translation for robot in robots[1:]], axis=0)
    assert np.linalg.norm(steps, axis=1).max() <= 0.02 + 1e-9
    assert np.allclose(robots[-1].matrix(), target.matrix(), atol=1e-9)


def test_a_jump_can_be_at_once():
    followed = MapToOdom()
    followed.set_target(ODOM_FROM_BASE, ODOM_FROM_BASE, at_once=False)
    followed.advance(1.0)
    target = _moved([3.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    followed.set_target(target, ODOM_FROM_BASE, at_once=True)
    pose = followed.advance(1.001)
    assert pose is not None
    assert np.allclose((pose @ ODOM_FROM_BASE).matrix(), target.matrix(), atol=1e-9)


def test_the_plane_keeps_x_y_and_yaw():
    pose = Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.7])) @ Rigid3.exp(
        np.array([0.0, 0.0, 0.0, 0.02, -0.03, 0.0])
    )
    flat = project_to_plane(Rigid3(pose.rotation, np.array([1.0, 2.0, 0.3])))
    assert flat.translation.tolist() == [1.0, 2.0, 0.0]
    assert flat.log()[3:] == pytest.approx([0.0, 0.0, 0.7], abs=1e-3)
    assert tilt(flat) == 0.0
    assert tilt(pose) == pytest.approx(np.hypot(0.02, 0.03), rel=1e-3)
