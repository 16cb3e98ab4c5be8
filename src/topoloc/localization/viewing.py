"""How differently two cameras look at a place. Eq. 1 asks how far a robot has turned; a camera held on its side sees the same."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.map.nodes import NodePoses, node_distances

QUARTER = Rigid3(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
"""A quarter turn about the optical axis."""


def viewing_distances(world_from_cam: Rigid3, nodes: NodePoses, lambda_rot: float) -> Float[np.ndarray, " nodes"]:
    """D_total of Eq. 1 (metres) between a camera and each node, whichever side of the camera is up: the least of four quarter turns."""
    distances = node_distances(world_from_cam, nodes, lambda_rot)
    for _ in range(3):
        world_from_cam = world_from_cam @ QUARTER
        distances = np.minimum(distances, node_distances(world_from_cam, nodes, lambda_rot))
    return distances
