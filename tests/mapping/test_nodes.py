"""Test the selection of nodes by Eq. 1 and its two parameters."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, strategies as st

from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.mapping.nodes import (
    DEPTH_SHARE,
    RADIANS_PER_NODE,
    NodeConfig,
    NodePoses,
    find_nearest_nodes,
    node_distances,
    select_node_frames,
)
from topoloc.mapping.topomap import TopoMetricMap

SHAPES = ("circle", "text")


def moved(x: float, yaw: float = 0.0) -> Rigid3:
    return Rigid3(exp_so3(np.array([0.0, 0.0, yaw])), np.array([x, 0.0, 0.0]))


def test_distance_is_translation_plus_lambda_times_angle():
    nodes = NodePoses.from_poses([moved(0.0), moved(3.0, 0.5)])
    np.testing.assert_allclose(
        node_distances(moved(1.0, 0.2), nodes, lambda_rot=2.0),
        [1.0 + 2.0 * 0.2, 2.0 + 2.0 * 0.3],
        atol=1e-12,
    )


def test_angle_is_that_of_the_relative_rotation_up_to_half_a_turn():
    rng = np.random.default_rng(1)
    for angle in (0.0, 1e-6, 0.3, np.pi - 1e-6, np.pi):
        axis = rng.standard_normal(3)
        base = exp_so3(rng.standard_normal(3))
        turned = Rigid3(base @ exp_so3(axis / np.linalg.norm(axis) * angle), np.zeros(3))
        distance = node_distances(turned, NodePoses.from_poses([Rigid3(base, np.zeros(3))]), 1.0)[0]
        assert distance == pytest.approx(angle, abs=1e-7)


def test_a_straight_walk_places_a_node_at_each_passed_threshold():
    walk = [moved(0.25 * k) for k in range(9)]
    # 0.5 m is not more than the threshold of 0.5 m
    assert select_node_frames(walk, 0.5, 1.0).tolist() == [0, 3, 6]


def test_a_turn_on_the_spot_places_nodes_by_lambda():
    turn = [moved(0.0, 0.1 * k) for k in range(7)]
    assert select_node_frames(turn, 0.5, 2.0).tolist() == [0, 3, 6]
    assert select_node_frames(turn, 0.5, 0.0).tolist() == [0]


def test_a_second_lap_joins_the_nodes_of_the_first():
    lap = [moved(float(k)) for k in range(6)]
    assert len(select_node_frames(lap + lap[::-1], 0.9, 1.0)) == len(lap)


def test_one_frame_is_one_node():
    assert select_node_frames([moved(0.0)], 1.0, 1.0).tolist() == [0]


@given(
    st.lists(st.tuples(st.floats(-20, 20), st.floats(-3, 3)), min_size=1, max_size=40),
    st.floats(0.1, 5),
    st.floats(0, 5),
)
def test_every_frame_is_near_a_node_and_no_two_nodes_are_near(
    steps: list[tuple[float, float]], d_thresh: float, lambda_rot: float
):
    poses = [moved(x, yaw) for x, yaw in steps]
    frame_idx = select_node_frames(poses, d_thresh, lambda_rot)
    nodes = NodePoses.from_poses([poses[i] for i in frame_idx])
    # a step of 1e-124 may count or not, depending on the order of the sums
    rounding = 1.0 + 1e-12
    assert all(
        node_distances(pose, nodes, lambda_rot).min() <= d_thresh * rounding for pose in poses
    )
    between = np.array([node_distances(poses[i], nodes, lambda_rot) for i in frame_idx])
    assert (between[~np.eye(len(frame_idx), dtype=bool)] > d_thresh / rounding).all()


@given(
    st.lists(st.tuples(st.floats(-20, 20), st.floats(-3, 3)), min_size=1, max_size=120),
    st.tuples(st.floats(-30, 30), st.floats(-3, 3)),
    st.integers(1, 4),
    st.floats(0, 30),
)
def test_the_nearest_nodes_are_those_of_all(
    nodes: list[tuple[float, float]], camera: tuple[float, float], count: int, lambda_rot: float
):
    poses = NodePoses.from_poses(
        [moved(round(x, 1), round(yaw, 1)) for x, yaw in nodes]
    )  # equal ones among them
    right = np.argsort(node_distances(moved(*camera), poses, lambda_rot), kind="stable")[:count]
    assert find_nearest_nodes(moved(*camera), poses, lambda_rot, count).tolist() == right.tolist()


def test_unset_parameters_follow_from_the_scene():
    resolved = NodeConfig().resolved(median_depth=4.0)
    assert resolved.d_thresh == pytest.approx(4.0 * DEPTH_SHARE)
    assert resolved.lambda_rot == pytest.approx(4.0 * DEPTH_SHARE / RADIANS_PER_NODE)
    assert NodeConfig(d_thresh=1.5).resolved(100.0).lambda_rot == pytest.approx(
        1.5 / RADIANS_PER_NODE
    )
    assert NodeConfig(0.7, 0.2).resolved(100.0) == NodeConfig(0.7, 0.2)


@pytest.mark.parametrize(
    ("num", "spacing", "bar"), [(1, 1.0, "0.01 m"), (40, 0.2, "1 m"), (9000, 0.1, "100 m")]
)
def test_a_plan_shows_the_nodes_and_a_length(num: int, spacing: float, bar: str):
    steps = np.arange(num) * spacing
    poses = NodePoses(np.column_stack([steps, np.sin(steps), 0.1 * steps]), np.zeros((num, 3, 3)))
    root = ElementTree.fromstring(poses.plan_svg())
    circles, texts = (list(root.iter(f"{{http://www.w3.org/2000/svg}}{one}")) for one in SHAPES)
    assert [one.text for one in texts] == [bar]
    assert min(num, 250) <= len(circles) <= 500
    assert all(0 <= float(one.attrib["cx"]) <= 320 for one in circles)


def test_a_map_in_a_notebook_is_a_line_and_a_plan(room_map: Path):
    text = TopoMetricMap.load(room_map)._repr_html_()
    assert "nodes along" in text
    assert "<svg" in text
    assert len(text) < 30_000
