"""Test transforms along chains of static and moving frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from topoloc.apps.formats.bags.bag_poses import TransformTree
from topoloc.apps.formats.bags.messages import StampedTransform
from topoloc.geometry.rigid import Rigid3

ODOM_FROM_BASE = [
    Rigid3.exp(np.array([0.5 * step, 0.1, 0.0, 0.0, 0.0, 0.2 * step])) for step in range(4)
]
MAP_FROM_ODOM = Rigid3.exp(np.array([3.0, 1.0, 0.0, 0.0, 0.0, 0.7]))
BASE_FROM_LINK, LINK_FROM_LEFT, LINK_FROM_RIGHT = (
    Rigid3.exp(0.1 * np.arange(6) + start) for start in (0.0, 0.3, -0.4)
)


def timed(pose: Rigid3, t_ns: int, parent: str, child: str) -> StampedTransform:
    w, x, y, z = pose.quat_wxyz().tolist()
    tx, ty, tz = pose.translation.tolist()
    return StampedTransform(t_ns, parent, child, (tx, ty, tz), (x, y, z, w))


def robot() -> TransformTree:
    tree = TransformTree()
    for step, pose in enumerate(ODOM_FROM_BASE):
        tree.add(timed(pose, step * 100_000_000, "odom", "base"), is_static=False)
    tree.add(timed(MAP_FROM_ODOM, 0, "map", "odom"), is_static=False)
    for child, pose in (("left", LINK_FROM_LEFT), ("right", LINK_FROM_RIGHT)):
        tree.add(timed(pose, 0, "link", child), is_static=True)
    tree.add(timed(BASE_FROM_LINK, 0, "base", "link"), is_static=True)
    return tree


def test_a_camera_at_the_end_of_a_chain():
    tree = robot()
    poses = tree.poses("left", [100_000_000, 150_000_000, 900_000_000])
    assert poses[0] is not None
    expected = MAP_FROM_ODOM @ ODOM_FROM_BASE[1] @ BASE_FROM_LINK @ LINK_FROM_LEFT
    np.testing.assert_allclose(poses[0].matrix(), expected.matrix(), atol=1e-12)
    assert poses[1] is not None
    between = (
        MAP_FROM_ODOM
        @ ODOM_FROM_BASE[1].interpolate(ODOM_FROM_BASE[2], 0.5)
        @ BASE_FROM_LINK
        @ LINK_FROM_LEFT
    )
    np.testing.assert_allclose(poses[1].matrix(), between.matrix(), atol=1e-12)
    assert poses[2] is None
    assert tree.is_moving("left")
    assert not tree.is_moving("odom")
    assert not tree.is_moving("nowhere")


def test_fixed_transforms_meet_below_moving_frames():
    tree = robot()
    right_from_left = tree.find_static_transform("right", "left")
    assert right_from_left is not None
    np.testing.assert_allclose(
        right_from_left.matrix(), (LINK_FROM_RIGHT.inverse() @ LINK_FROM_LEFT).matrix(), atol=1e-12
    )
    base_from_left = tree.find_static_transform("base", "left")
    assert base_from_left is not None
    np.testing.assert_allclose(
        base_from_left.matrix(), (BASE_FROM_LINK @ LINK_FROM_LEFT).matrix(), atol=1e-12
    )
    assert tree.find_static_transform("map", "left") is None
    assert tree.find_static_transform("left", "nowhere") is None
    same = tree.find_static_transform("nowhere", "nowhere")
    assert same is not None
    assert same.angle() == 0.0


def test_a_circle_and_a_second_parent():
    tree = TransformTree()
    tree.add(timed(MAP_FROM_ODOM, 0, "a", "b"), is_static=True)
    tree.add(timed(MAP_FROM_ODOM, 0, "b", "a"), is_static=True)
    tree.add(timed(LINK_FROM_LEFT, 0, "other", "b"), is_static=True)
    assert len(tree.transforms["b"]) == 1
    assert tree.poses("a", [0])[0] is not None


def test_a_transform_that_is_sent_again_with_the_same_numbers_is_fixed():
    """It comes once in 2 s, with a quaternion of the other sign and as text rounds."""
    tree = TransformTree()
    for step in range(40):
        pose = Rigid3.exp(np.array([0.1 * step, 0.0, 0.0, 0.0, 0.0, 0.01 * step]))
        tree.add(timed(pose, step * 200_000_000, "odom", "base"), is_static=False)
        if step % 10 == 0:
            tree.add(timed(LINK_FROM_LEFT, step * 200_000_000, "base", "left"), is_static=False)
            last = tree.transforms["left"][-1]
            x, y, z, w = last.quat_xyzw
            turned = replace(last, t_ns=last.t_ns + 1, quat_xyzw=(-x, -y, -z, -w + 1e-8))
            tree.add(turned, is_static=False)
    poses = tree.poses("left", [step * 200_000_000 for step in range(40)])
    assert all(pose is not None for pose in poses)
    assert tree.is_moving("left")
    base_from_left = tree.find_static_transform("base", "left")
    assert base_from_left is not None
    np.testing.assert_allclose(base_from_left.matrix(), LINK_FROM_LEFT.matrix(), atol=1e-6)
    tree.add(timed(LINK_FROM_RIGHT, 9_000_000_000, "base", "left"), is_static=False)
    assert tree.find_static_transform("base", "left") is None


def corrected_robot(period_s: float, drift: float, jump: float = 0.0) -> TransformTree:
    """Return odometry at 10 Hz for 20 s, and its slow correction in the map."""
    tree = TransformTree()
    for step in range(200):
        base = Rigid3.exp(np.array([0.05 * step, 0.0, 0.0, 0.0, 0.0, 0.01 * step]))
        tree.add(timed(base, step * 100_000_000, "odom", "base"), is_static=False)
    for t_s in np.arange(0.0, 20.0, period_s):
        odom = Rigid3.exp(np.array([drift * t_s + jump * (t_s > 10.0), 0.0, 0.0, 0.0, 0.0, 0.3]))
        tree.add(timed(odom, round(1e9 * t_s), "map", "odom"), is_static=False)
    return tree


@pytest.mark.parametrize("period_s", [0.5, 1.0, 7.0])
def test_a_slow_correction_of_odometry_is_interpolated(period_s: float):
    tree = corrected_robot(period_s, drift=0.02)
    t_ns = [step * 100_000_000 for step in range(200)]
    poses = tree.poses("base", t_ns)
    last_s = np.arange(0.0, 20.0, period_s)[-1]
    for time, pose in zip(t_ns, poses, strict=True):
        assert pose is not None
        t_s = time / 1e9
        odom = Rigid3.exp(np.array([0.02 * min(t_s, last_s), 0.0, 0.0, 0.0, 0.0, 0.3]))
        base = Rigid3.exp(np.array([0.5 * t_s, 0.0, 0.0, 0.0, 0.0, 0.1 * t_s]))
        np.testing.assert_allclose(pose.matrix(), (odom @ base).matrix(), atol=1e-3)


def test_poses_during_a_relocalization_are_unknown():
    tree = corrected_robot(1.0, drift=0.0, jump=2.0)
    poses = tree.poses("base", [step * 100_000_000 for step in range(200)])
    assert [row for row, pose in enumerate(poses) if pose is None] == list(range(101, 110))


def test_slow_odometry_and_gaps_in_it_are_not_bridged():
    tree = corrected_robot(1.0, drift=0.02)
    del tree.transforms["base"][50:80]
    assert tree.poses("base", [6_000_000_000]) == [None]
    assert tree.describe_slow_edge("base") == "TF from map to odom comes once in 1 s"
    slow = TransformTree()
    for step in range(10):
        pose = Rigid3.exp(np.array([0.3 * step, 0.0, 0.0, 0.0, 0.0, 0.0]))
        slow.add(timed(pose, step * 1_000_000_000, "odom", "base"), is_static=False)
    assert slow.poses("base", [500_000_000]) == [None]
    assert slow.describe_slow_edge("base") == "TF from odom to base comes once in 1 s"
