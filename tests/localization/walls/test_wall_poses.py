"""A first pose from what two views of one wall, both without slant, have in common."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from topoloc.features.features import Features, Matches
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.walls.wall_poses import agreeing_pose
from topoloc.map.topomap import NodeSummary, TopoNode

NODE_CAMERA = Camera.pinhole(480, 430, 240.0, 240.0, -240.0, 216.0)
QUERY_CAMERA = Camera.pinhole(600, 500, 310.0, 310.0, 900.0, 250.0)
WORLD_FROM_NODE = Rigid3(exp_so3(np.array([0.2, -1.1, 0.4])), np.array([3.0, -7.0, 1.5]))
NUM_POINTS, NODE_DEPTH = 60, 1.4


@dataclass(frozen=True, eq=False)
class Wall:
    """What a side node keeps of a wall, what a side view sees of it, and the matches between the two; row k is the same point."""

    node: TopoNode
    features: Features
    matches: Matches


def _features(points_img: np.ndarray, sizes_px: np.ndarray, angles: np.ndarray) -> Features:
    one = np.ones(len(points_img), np.float32)
    points_img, sizes_px, angles = (array.astype(np.float32) for array in (points_img, sizes_px, angles))
    return Features(points_img, sizes_px, angles, one, np.ones((len(one), 1), np.float32))


def _wall(side_from_node: Rigid3, share_wrong: float = 0.0, seed: int = 0, tilt: float = 0.0) -> Wall:
    """A wall 1.4 m before the node's side camera, turned by `tilt` out of its picture plane, and seen from `side_from_node`; a share of
    the matches is wrong."""
    rng = np.random.default_rng(seed)
    on_wall = np.column_stack([rng.uniform(1.5, 4.0, NUM_POINTS), rng.uniform(-1.0, 1.0, NUM_POINTS), np.zeros(NUM_POINTS)])
    middle = np.array([2.75, 0.0, NODE_DEPTH])
    points_node = (on_wall - [2.75, 0.0, 0.0]) @ exp_so3(np.array([0.0, tilt, 0.0])).T + middle
    points_side = side_from_node.apply(points_node)
    turn = np.arctan2(side_from_node.rotation[1, 0], side_from_node.rotation[0, 0])
    # alike in size and orientation, as things on walls are: where they lie must tell wrong matches from right ones
    metres, angles = rng.uniform(0.1, 0.2, NUM_POINTS), rng.uniform(-0.25, 0.25, NUM_POINTS)
    wrong = rng.random(NUM_POINTS) < share_wrong
    train_idx = np.arange(NUM_POINTS)
    train_idx[wrong] = rng.integers(0, NUM_POINTS, np.count_nonzero(wrong))
    node = TopoNode(
        NodeSummary(0, "walk", "a", 0, WORLD_FROM_NODE, NUM_POINTS),
        NODE_CAMERA,
        _features(NODE_CAMERA.img_from_cam(points_node), metres * NODE_CAMERA.fx / points_node[:, 2], angles),
        points_node.astype(np.float32),
        np.zeros((NUM_POINTS, 6), np.float32),
        b"",
    )
    seen = _features(QUERY_CAMERA.img_from_cam(points_side), metres * QUERY_CAMERA.fx / points_side[:, 2], angles + turn)
    rows = np.arange(NUM_POINTS, dtype=np.int32)
    return Wall(node, seen, Matches(rows, train_idx.astype(np.int32), np.zeros(NUM_POINTS, np.float32)))


def _asked(wall: Wall) -> tuple[int, Rigid3] | None:
    return agreeing_pose(wall.features, QUERY_CAMERA, wall.node, wall.matches)


def _side_from_node(found: tuple[int, Rigid3] | None) -> Rigid3:
    assert found is not None
    return found[1] @ WORLD_FROM_NODE


def _about_the_axis(turn: float, along: float, up: float, nearer: float) -> Rigid3:
    rotation = exp_so3(np.array([0.0, 0.0, turn]))
    return Rigid3(rotation, np.array([along, up, -nearer]))


@settings(max_examples=60, deadline=None)
@given(
    turn=st.floats(-0.3, 0.3),
    along=st.floats(-7.0, 1.0),
    up=st.floats(-0.5, 0.5),
    nearer=st.floats(-1.5, 0.7),
    share_wrong=st.floats(0.0, 0.6),
    seed=st.integers(0, 1000),
)
def test_the_pose_is_found_among_wrong_matches(turn: float, along: float, up: float, nearer: float, share_wrong: float, seed: int):
    truth = _about_the_axis(turn, along, up, nearer)
    wall = _wall(truth, share_wrong, seed)
    num_right = np.count_nonzero(wall.matches.train_idx == wall.matches.query_idx)
    found = _asked(wall)
    assert found is not None
    assert num_right <= found[0] <= NUM_POINTS
    apart = _side_from_node(found) @ truth.inverse()
    assert np.rad2deg(apart.angle()) < 5.0
    at_wall = _side_from_node(found).apply(np.array([[2.75, 0.0, NODE_DEPTH]])) - truth.apply(np.array([[2.75, 0.0, NODE_DEPTH]]))
    assert np.linalg.norm(at_wall) < 0.25 * (NODE_DEPTH - nearer)
    assert found[0] - num_right < 0.25 * NUM_POINTS


@pytest.mark.parametrize("tilt", [-0.12, -0.06, 0.06, 0.12])
def test_of_a_wall_that_is_seen_a_little_aslant_the_pose_is_the_right_one_of_two(tilt: float):
    """A plane's other pose has the slant of the other sign: it would be turned by twice the angle, and shifted along the wall."""
    truth = Rigid3(exp_so3(np.array([0.0, -2.0 * tilt, 0.0])), np.array([-4.5, 0.0, 0.3]))
    wall = _wall(truth, share_wrong=0.3, tilt=tilt)
    found = _side_from_node(_asked(wall))
    assert np.rad2deg((found @ truth.inverse()).angle()) < np.rad2deg(2.0 * abs(tilt)) + 1.0
    # no slant of its own: turned about the wall's normal alone, and before the wall
    np.testing.assert_allclose(found.rotation[2], [0.0, 0.0, 1.0], atol=1e-9)
    assert (found.apply(wall.node.points_cam.astype(np.float64))[:, 2] > 0.2).all()
    assert np.linalg.norm(found.inverse().translation - truth.inverse().translation) < 1.2


def test_a_wall_and_its_mirror_image_have_no_pose_in_common():
    wall = _wall(_about_the_axis(0.0, -4.0, 0.0, 0.2))
    points_img, angles = wall.features.points_img.copy(), np.pi - wall.features.angles
    points_img[:, 0] = 2.0 * points_img[:, 0].mean() - points_img[:, 0]
    right, mirrored = _asked(wall), _asked(replace(wall, features=replace(wall.features, points_img=points_img, angles=angles)))
    assert right is not None
    assert right[0] == NUM_POINTS
    assert mirrored is None or mirrored[0] < 0.25 * NUM_POINTS


def test_chance_agrees_little():
    wall = _wall(_about_the_axis(0.0, -4.0, 0.0, 0.2), share_wrong=1.0)
    found = _asked(wall)
    assert found is None or found[0] < 0.25 * NUM_POINTS


@pytest.mark.parametrize("num_matches", [0, 1, 2])
def test_too_few_matches_give_none(num_matches: int):
    wall = _wall(_about_the_axis(0.1, -4.0, 0.0, 0.2))
    rows = np.arange(num_matches, dtype=np.int32)
    assert _asked(replace(wall, matches=Matches(rows, rows, np.zeros(num_matches, np.float32)))) is None


def test_three_that_agree_are_enough_and_three_that_do_not_are_none():
    wall = _wall(_about_the_axis(0.1, -4.0, 0.0, 0.2))
    rows, distances = np.array([3, 20, 41], np.int32), np.zeros(3, np.float32)
    found = _asked(replace(wall, matches=Matches(rows, rows, distances)))
    assert found is not None
    assert found[0] == 3
    angles = wall.features.angles.copy()
    angles[rows] += np.array([0.0, 2.0, -2.0], np.float32)
    turned = replace(wall, features=replace(wall.features, angles=angles), matches=Matches(rows, rows, distances))
    assert _asked(turned) is None


@pytest.mark.parametrize(("turn", "nearer"), [(0.8, 0.0), (2.5, 0.0), (0.0, 1.1), (0.0, -8.0)], ids=["turned", "over", "larger", "smaller"])
def test_walls_turned_or_scaled_by_too_much_are_not_considered(turn: float, nearer: float):
    assert _asked(_wall(_about_the_axis(turn, -4.0, 0.0, nearer))) is None


def test_matches_of_one_point_alone_give_none():
    wall = _wall(_about_the_axis(0.0, -4.0, 0.0, 0.2))
    same = np.full(10, 5, np.int32)
    assert _asked(replace(wall, matches=Matches(same, same, np.zeros(10, np.float32)))) is None
