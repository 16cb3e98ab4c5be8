"""Test distances between views: they equal Eq. 1 for upright cameras and ignore quarter turns.
Nodes for a view beside the path are those that show it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tiny_world import CAMERA, path_pose
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.feature_map import FeatureMap
from topoloc.localization.guided import count_seen_points
from topoloc.mapping.nodes import NodePoses, node_distances, node_distances_for_any_roll
from topoloc.mapping.topomap import TopoMetricMap

NODES = NodePoses.from_poses(
    [Rigid3.identity(), Rigid3(exp_so3(np.array([0.0, 0.5, 0.0])), np.array([1.0, 0.0, 0.0]))]
)


def test_distances_of_upright_cameras_equal_eq_1():
    camera = Rigid3(exp_so3(np.array([0.2, -0.3, 0.1])), np.array([0.0, 0.0, 2.0]))
    np.testing.assert_array_equal(
        node_distances_for_any_roll(camera, NODES, 3.0), node_distances(camera, NODES, 3.0)
    )


@pytest.mark.parametrize("num_quarters", [1, 2, 3])
def test_quarter_turns_change_nothing(num_quarters: int):
    camera = Rigid3(exp_so3(np.array([0.1, -0.3, 0.0])), np.array([0.0, 0.0, 2.0]))
    roll = Rigid3(exp_so3(np.array([0.0, 0.0, num_quarters * np.pi / 2])), np.zeros(3))
    np.testing.assert_allclose(
        node_distances_for_any_roll(camera @ roll, NODES, 3.0),
        node_distances_for_any_roll(camera, NODES, 3.0),
        atol=1e-7,
    )


def test_a_view_aside_takes_nodes_that_show_it(room_map: Path):
    with TopoMetricMap.load(room_map) as topomap:
        opened = FeatureMap(topomap)
        on_path = path_pose(0.5)
        nearest = opened.nearest(on_path, 3)
        assert opened.showing(on_path.inverse(), CAMERA, 3) == nearest
        aside = on_path @ Rigid3(exp_so3(np.array([0.0, 0.9, 0.0])), np.zeros(3))
        cam_from_world, centres = aside.inverse(), opened.node_poses.centres
        counts = np.array(
            [
                count_seen_points(points, centres[row], cam_from_world, CAMERA)
                for row, points in enumerate(opened.local_maps(range(len(centres))))
            ]
        )
        chosen = opened.showing(cam_from_world, CAMERA, 3)
        assert chosen != opened.nearest(aside, 3), "the test must show a difference"
        assert counts[chosen].min() >= 0.5 * counts.max()
        distances = opened.distances(aside)
        others = np.setdiff1d(np.flatnonzero(counts >= 0.5 * counts.max()), chosen)
        assert distances[chosen].max() <= distances[others].min()
