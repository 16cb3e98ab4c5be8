"""Test the pose proposal from matches of one wall in two upright cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.walls.propose_virtual_views import estimate_upright_pose

NUM_POINTS, NODE_DEPTH = 60, 1.4


@dataclass(frozen=True, eq=False)
class Wall:
    """Hold points of a wall and their projections in another upright camera. Row k of both is a
    match, right if `is_right`."""

    points: np.ndarray
    seen: np.ndarray
    is_right: np.ndarray


def _wall(
    side_from_node: Rigid3, share_wrong: float = 0.0, seed: int = 0, thickness: float = 0.0
) -> Wall:
    """Return a wall 1.4 m in front of the virtual camera of a node, as seen from `side_from_node`.
    Objects stand out by up to `thickness`, and a share of the matches is wrong."""
    rng = np.random.default_rng(seed)
    across, up = rng.uniform(-1.25, 1.25, NUM_POINTS), rng.uniform(-1.0, 1.0, NUM_POINTS)
    points_node = np.column_stack(
        [across + 2.75, up, NODE_DEPTH - rng.uniform(0.0, thickness, NUM_POINTS)]
    )
    wrong = rng.random(NUM_POINTS) < share_wrong
    rows = np.arange(NUM_POINTS)
    rows[wrong] = rng.integers(0, NUM_POINTS, np.count_nonzero(wrong))
    seen = side_from_node.apply(points_node)
    return Wall(points_node[rows], seen[:, :2] / seen[:, 2:], rows == np.arange(NUM_POINTS))


def _asked(wall: Wall) -> tuple[int, Rigid3] | None:
    return estimate_upright_pose(wall.seen, wall.points)


def _side_from_node(found: tuple[int, Rigid3] | None) -> Rigid3:
    assert found is not None
    return found[1]


def _upright(turn: float, along: float, up: float, nearer: float) -> Rigid3:
    """Return a rotation about the vertical and a shift, about the middle of the wall, which
    stays in view."""
    rotation, middle = exp_so3(np.array([0.0, turn, 0.0])), np.array([2.75, 0.0, NODE_DEPTH])
    return Rigid3(rotation, middle - rotation @ middle + np.array([along, up, -nearer]))


def test_the_pose_is_found_among_wrong_matches():
    """Require nearly all views: with half of the matches wrong, some may agree on another
    pose equally well."""
    rng, near = np.random.default_rng(0), list[bool]()
    while len(near) < 400:
        turn, along, up, nearer, share_wrong = rng.uniform(
            [-0.35, -7.0, -0.5, -1.5, 0.0], [0.35, 1.0, 0.5, 0.5, 0.6]
        )
        truth = _upright(turn, along, up, nearer)
        wall = _wall(truth, share_wrong, seed=len(near))
        if not (truth.apply(wall.points)[:, 2] > 0.3).all():
            continue
        num_right = np.count_nonzero(wall.is_right)
        found = _asked(wall)
        assert found is not None
        assert (
            num_right - 1 <= found[0] < num_right + 0.25 * NUM_POINTS
        )  # of many pairs not the very best may be drawn
        angle = np.rad2deg((_side_from_node(found) @ truth.inverse()).angle())
        metres = np.linalg.norm(
            _side_from_node(found).inverse().translation - truth.inverse().translation
        )
        near.append(bool(angle < 6.0 and metres < 0.15 * (NODE_DEPTH - nearer) + 0.1))
    assert np.mean(near) > 0.98


@pytest.mark.parametrize("turn", [-0.24, -0.12, 0.12, 0.24])
def test_of_the_two_poses_of_a_plane_the_upright_one_is_found(turn: float):
    truth = _upright(turn, -4.5, 0.0, 0.3)
    found = _side_from_node(_asked(_wall(truth, share_wrong=0.3)))
    assert np.rad2deg((found @ truth.inverse()).angle()) < 2.0
    assert np.linalg.norm(found.inverse().translation - truth.inverse().translation) < 0.1
    np.testing.assert_allclose(found.rotation[1], [0.0, 1.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("not_level", [(0.03, 0.0), (0.0, 0.03), (-0.02, -0.02)])
def test_a_camera_that_is_not_quite_level_is_found_all_the_same(not_level: tuple[float, float]):
    pitch, roll = not_level
    truth = Rigid3(exp_so3(np.array([pitch, 0.0, roll])), np.zeros(3)) @ _upright(
        0.1, -4.0, 0.0, 0.2
    )
    found = _asked(_wall(truth, share_wrong=0.3, thickness=0.1))
    assert found is not None
    assert found[0] > 0.4 * NUM_POINTS
    assert (
        np.linalg.norm(_side_from_node(found).inverse().translation - truth.inverse().translation)
        < 0.35
    )


def test_a_wall_and_its_mirror_image_have_no_pose_in_common():
    wall = _wall(_upright(0.0, -4.0, 0.0, 0.2))
    turned = wall.seen * np.array([-1.0, 1.0]) + np.array([2.0 * wall.seen[:, 0].mean(), 0.0])
    right, mirrored = _asked(wall), _asked(replace(wall, seen=turned))
    assert right is not None
    assert right[0] == NUM_POINTS
    assert mirrored is None or mirrored[0] < 0.3 * NUM_POINTS


def test_chance_agrees_little():
    found = _asked(_wall(_upright(0.0, -4.0, 0.0, 0.2), share_wrong=1.0))
    assert found is None or found[0] < 0.3 * NUM_POINTS


@pytest.mark.parametrize("num_matches", [0, 1, 2])
def test_too_few_matches_give_none(num_matches: int):
    wall = _wall(_upright(0.1, -4.0, 0.0, 0.2))
    assert estimate_upright_pose(wall.seen[:num_matches], wall.points[:num_matches]) is None


def test_three_agreeing_matches_are_enough_and_others_are_not():
    wall, rows = _wall(_upright(0.1, -4.0, 0.0, 0.2)), [3, 20, 41]
    found = estimate_upright_pose(wall.seen[rows], wall.points[rows])
    assert found is not None
    assert found[0] == 3
    moved = wall.seen[rows] + np.array([[0.0, 0.0], [0.0, 0.8], [0.0, -0.8]])
    assert estimate_upright_pose(moved, wall.points[rows]) is None


@pytest.mark.parametrize("turn", [0.9, -0.9])
def test_cameras_turned_by_too_much_are_not_considered(turn: float):
    found = _asked(_wall(_upright(turn, 0.0, 0.0, -2.5)))
    assert (
        found is None or np.rad2deg(_side_from_node(found).angle()) < 35.1
    )  # the other pose of a plane may be turned by less


def test_matches_of_one_point_alone_give_none():
    wall, same = _wall(_upright(0.0, -4.0, 0.0, 0.2)), [5] * 10
    assert estimate_upright_pose(wall.seen[same], wall.points[same]) is None
