"""Where nodes are placed: the paper's Eq. 1.

A new node is created when ``D_total = D_translation + lambda * D_rot > D_thresh``, where the
distances are those to the nearest node there is: on a first pass that is the last node, on a second
lap the images join the nodes of the first.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from topoloc.bounds import Above, AtLeast
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.entries import NodeSummary

# Where the user names no D_thresh, it is this share of the scene's median depth: the parallax from
# one node to the next is then the same in a kitchen (0.25 m) and in a street (3 m).
DEPTH_SHARE = 0.15
# Where the user names no lambda, a turn by this angle alone makes a node. Nodes are cheap (100 KB)
# and a query asks only the few around it; the closer they are in view, the more of the map's own
# error they share with it
# (docs/journal/mapping.md).
RADIANS_PER_NODE = np.deg2rad(2.0)
_STEPS = list(product((-1, 0, 1), repeat=3))  # to a cube and those around it


@dataclass(frozen=True)
class NodeConfig:
    """Eq. 1 of the paper. What is None follows from the scene: see `resolved`."""

    d_thresh: Annotated[float | None, Above(0)] = None
    """D_thresh, metres: the distance at which a new node is placed (None: 15 % of the scene's
    median depth)."""
    lambda_rot: Annotated[float | None, AtLeast(0)] = None
    """lambda, metres a radian: how much rotation counts (None: so much that 2 degrees alone make a
    node)."""

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
        return NodePoses(
            np.array([p.translation for p in world_from_nodes]),
            np.array([p.rotation for p in world_from_nodes]),
        )

    def rows(self, rows: Sequence[int] | Int[np.ndarray, " some"]) -> NodePoses:
        """Those of some nodes."""
        return NodePoses(self.centres[rows], self.rotations[rows])


def node_distances(
    world_from_cam: Rigid3, nodes: NodePoses, lambda_rot: float
) -> Float[np.ndarray, " nodes"]:
    """D_total of Eq. 1 (metres) between a camera and each node."""
    d_translation = np.linalg.norm(nodes.centres - world_from_cam.translation, axis=1)
    traces = np.einsum("nij,ij->n", nodes.rotations, world_from_cam.rotation)
    d_rot = np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0))
    return d_translation + lambda_rot * d_rot


def select_node_frames(
    world_from_cams: list[Rigid3], config: NodeConfig
) -> Int[np.ndarray, " nodes"]:
    """Walk along the trajectory and place a node wherever Eq. 1 holds: the frames that become
    nodes.

    `config` must be resolved.
    """
    assert config.d_thresh is not None, "resolve the configuration first"
    assert config.lambda_rot is not None, "resolve the configuration first"
    poses, frame_idx = NodePoses.of(world_from_cams), list[int]()
    cells: dict[
        tuple[int, ...], list[int]
    ] = {}  # frames that became nodes, by the cube of D_thresh that they stand in
    for k, (world_from_cam, cell) in enumerate(
        zip(world_from_cams, np.floor(poses.centres / config.d_thresh).tolist(), strict=True)
    ):
        near = [
            frame
            for step in _STEPS
            for frame in cells.get((cell[0] + step[0], cell[1] + step[1], cell[2] + step[2]), ())
        ]
        if (
            not near
            or node_distances(world_from_cam, poses.rows(near), config.lambda_rot).min()
            > config.d_thresh
        ):
            frame_idx.append(k)
            cells.setdefault(tuple(cell), []).append(k)
    return np.array(frame_idx)


class NearestNodeSearch:
    """The nodes nearest to a camera by Eq. 1, of which few are turned towards it: no node is nearer
    than the metres to it."""

    def __init__(self, poses: NodePoses, lambda_rot: float) -> None:
        self._poses, self._lambda_rot = poses, lambda_rot

    def rows(self, world_from_cam: Rigid3, count: int) -> Int[np.ndarray, " nodes"]:
        """Up to `count` nodes, the nearest first; of equal ones the first."""
        metres = np.linalg.norm(self._poses.centres - world_from_cam.translation, axis=1)
        num_checked = 8 * count
        while True:
            is_all = num_checked >= len(metres)
            rows = (
                np.arange(len(metres))
                if is_all
                else np.sort(np.argpartition(metres, num_checked)[:num_checked])
            )
            distances = node_distances(world_from_cam, self._poses.rows(rows), self._lambda_rot)
            order = np.argsort(distances, kind="stable")[:count]
            if is_all or distances[order[-1]] < metres[rows].max():
                return rows[order]
            num_checked *= 4


def compute_nodes_digest(summaries: Sequence[NodeSummary], method: bytes) -> str:
    """A short name for what follows from the nodes, by their poses and numbers of points, and from
    how it was found (`method`)."""
    digest = hashlib.sha256(method)
    for summary in summaries:
        digest.update(
            summary.world_from_cam.matrix().astype("<f8").tobytes()
            + summary.num_points.to_bytes(4, "little")
        )
    return digest.hexdigest()[:16]
