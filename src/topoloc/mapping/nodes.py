"""Where nodes are placed: the paper's Eq. 1.

A new node is created when ``D_total = D_translation + lambda * D_rot > D_thresh``, where the distances are those to the
nearest node there is: on a first pass that is the last node, on a second lap the images join the nodes of the first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from topoloc.geometry.rigid import Rigid3

# D_thresh as a share of the scene's median depth, where the user names none: parallax of one node to the next then
# stays near a quarter whatever the size of the place (0.5 m in a kitchen, 4 m in a street).
DEPTH_SHARE = 0.25
# lambda as a share of D_thresh, where the user names none: a turn of 25 degrees alone makes a node, since with the
# usual field of view (60 to 90 degrees) more of it loses half of the picture.
RADIANS_PER_NODE = np.deg2rad(25.0)


@dataclass(frozen=True)
class NodeConfig:
    """Eq. 1 of the paper. What is None follows from the scene: see `resolved`."""

    d_thresh: float | None = None
    """D_thresh, metres: the distance at which a new node is placed (None: a quarter of the scene's median depth)."""
    lambda_rot: float | None = None
    """lambda, metres a radian: how much rotation counts (None: so much that 25 degrees alone make a node)."""

    def resolved(self, median_depth: float) -> NodeConfig:
        """The same with every value set, for a scene of this median depth (metres)."""
        d_thresh = self.d_thresh if self.d_thresh is not None else DEPTH_SHARE * median_depth
        lambda_rot = self.lambda_rot if self.lambda_rot is not None else d_thresh / RADIANS_PER_NODE
        return NodeConfig(float(d_thresh), float(lambda_rot))


@dataclass(frozen=True, eq=False)
class NodePoses:
    """The poses (world_from_cam) of all nodes, stacked."""

    centres: Float[np.ndarray, "nodes 3"]
    rotations: Float[np.ndarray, "nodes 3 3"]

    @staticmethod
    def of(world_from_nodes: list[Rigid3]) -> NodePoses:
        return NodePoses(np.array([p.translation for p in world_from_nodes]), np.array([p.rotation for p in world_from_nodes]))


def node_distances(world_from_cam: Rigid3, nodes: NodePoses, lambda_rot: float) -> Float[np.ndarray, " nodes"]:
    """D_total of Eq. 1 (metres) between a camera and each node."""
    d_translation = np.linalg.norm(nodes.centres - world_from_cam.translation, axis=1)
    traces = np.einsum("nij,ij->n", nodes.rotations, world_from_cam.rotation)
    d_rot = np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0))
    return d_translation + lambda_rot * d_rot


def place_nodes(world_from_cams: list[Rigid3], config: NodeConfig) -> Int[np.ndarray, " nodes"]:
    """Walk along the trajectory and place a node wherever Eq. 1 holds: the frames that become nodes.

    `config` must be resolved.
    """
    assert config.d_thresh is not None and config.lambda_rot is not None, "resolve the configuration first"
    poses = NodePoses.of(world_from_cams)
    frame_idx = [0]
    for k, world_from_cam in enumerate(world_from_cams):
        nodes = NodePoses(poses.centres[frame_idx], poses.rotations[frame_idx])
        if node_distances(world_from_cam, nodes, config.lambda_rot).min() > config.d_thresh:
            frame_idx.append(k)
    return np.array(frame_idx)
