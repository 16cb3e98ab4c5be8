"""Test transforms along chains of static and moving frames."""

from __future__ import annotations

import numpy as np

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
