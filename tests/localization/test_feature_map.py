"""Test distances between views: they equal Eq. 1 for upright cameras and ignore quarter turns."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.mapping.nodes import NodePoses, node_distances, node_distances_for_any_roll

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
