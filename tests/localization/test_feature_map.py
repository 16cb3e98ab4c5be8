"""Test distances between views: they equal Eq. 1 for upright cameras and ignore quarter turns.
Nodes for a view beside the path are those that show it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import CAMERA, path_pose
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.feature_map import FeatureMap
from topoloc.localization.guided import count_seen_points
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.result import Localization
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


def test_shared_errors_grow_with_the_distance_from_all_nodes(
    room_map: Path, monkeypatch: pytest.MonkeyPatch
):
    image, truth = unseen_views()[0]
    sigmas = list[float]()
    with TopoMetricMap.load(room_map) as topomap:
        opened = FeatureMap(topomap)
        assert opened.remoteness(opened.node_poses.world_from_node(3)) == pytest.approx(0, abs=1e-6)
        expected = opened.distances(truth).min() / (5.0 * opened.d_thresh)
        assert opened.remoteness(truth) == pytest.approx(expected)
        for remoteness in (0.2, 1.0, 4.0):
            monkeypatch.setattr(FeatureMap, "remoteness", lambda *_, value=remoteness: value)
            found = Localizer(topomap, LocalizerConfig(exactness="fast")).localize(image, CAMERA)
            assert isinstance(found, Localization)
            sigmas.append(found.position_sigma_m)
    assert sigmas[0] == sigmas[1]
    assert sigmas[2] > 1.01 * sigmas[1]
