"""Place the nodes of a map by the paper's Eq. 1.

A new node is created if ``D_total = D_translation + lambda * D_rot > D_thresh``. The distances are
to the nearest node. In a first pass that is usually the last node. In a second lap, images belong
to the nodes of the first.
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
from topoloc.geometry.rigid import Rigid3, positions_of
from topoloc.mapping.storage.entries import NodeSummary

# The default D_thresh is this share of the scene's median depth. The parallax between nodes is then
# the same in a kitchen (0.25 m) and in a street (3 m).
DEPTH_SHARE = 0.15
# By default, a rotation by this angle alone creates a node. Nodes are cheap (100 KB), and a query
# matches only a few. Nodes with nearly the query's view share the map's errors with it
# (docs/journal/mapping.md).
RADIANS_PER_NODE = np.deg2rad(2.0)
_STEPS = list(product((-1, 0, 1), repeat=3))  # steps to a cube and its neighbours


@dataclass(frozen=True)
class NodeConfig:
    """Configure Eq. 1 of the paper. None values follow from the scene, see `resolved`."""

    d_thresh: Annotated[float | None, Above(0)] = None
    """D_thresh in metres: the distance at which a new node is placed. None: 15 % of the scene's
    median depth."""
    lambda_rot: Annotated[float | None, AtLeast(0)] = None
    """lambda in metres per radian: the weight of rotation. None: a rotation by 2 degrees alone
    creates a node."""

    def resolved(self, median_depth: float) -> NodeConfig:
        """Return the settings with every value set, for a scene of this median depth (metres)."""
        d_thresh = self.d_thresh if self.d_thresh is not None else DEPTH_SHARE * median_depth
        lambda_rot = self.lambda_rot if self.lambda_rot is not None else d_thresh / RADIANS_PER_NODE
        return NodeConfig(float(d_thresh), float(lambda_rot))


@dataclass(frozen=True, eq=False)
class NodePoses:
    """Hold the poses (world_from_cam) of all nodes as arrays."""

    centres: Float[np.ndarray, "nodes 3"]
    rotations: Float[np.ndarray, "nodes 3 3"]

    @staticmethod
    def from_poses(world_from_nodes: list[Rigid3]) -> NodePoses:
        """Stack poses (world_from_node) into arrays."""
        return NodePoses(
            positions_of(world_from_nodes),
            np.array([p.rotation for p in world_from_nodes]).reshape(-1, 3, 3),
        )

    def world_from_node(self, row: int) -> Rigid3:
        """Return the pose of a node."""
        return Rigid3(self.rotations[row], self.centres[row])

    def rows(self, rows: Sequence[int] | Int[np.ndarray, " some"]) -> NodePoses:
        """Return the poses of some nodes."""
        return NodePoses(self.centres[rows], self.rotations[rows])

    def has_opposite(self, row: int, reach_m: float, max_cos: float) -> bool:
        """Return whether a node within reach (metres) of a node looks in the opposite direction.
        The cosine of the angle between their axes is then at most `max_cos`."""
        is_near = np.linalg.norm(self.centres - self.centres[row], axis=1) <= reach_m
        axes = self.rotations[:, :, 2]
        return bool((is_near & (axes @ axes[row] <= max_cos)).any())

    def plan_svg(self, size_px: int = 320) -> str:
        """Return a plan of the nodes in the plane of their main directions, with a bar whose length
        is written beside it, as SVG of some kilobytes."""
        max_nodes, margin = 500, 24.0
        centred = (self.centres - self.centres.mean(axis=0))[:: len(self.centres) // max_nodes + 1]
        points = centred @ np.linalg.svd(centred.T @ centred)[0][:, :2]
        extents = np.ptp(points, axis=0)
        scale = (size_px - 2.0 * margin) / max(extents.max(), 0.1)
        xy = (points - points.min(axis=0)) * scale + margin
        metres = 10.0 ** np.floor(np.log10(0.7 * max(extents.max(), 0.1)))
        height = extents[1] * scale + 2.0 * margin + 16.0
        bar, end = metres * scale, margin + metres * scale + 6.0
        dots = "".join(f'<circle cx="{x:.0f}" cy="{y:.0f}" r="2"/>' for x, y in xy)
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{size_px}" height="{height:.0f}"'
            f' fill="#3f6ea5" font-family="sans-serif" font-size="12">{dots}<path stroke="#6b7786"'
            f' stroke-width="2" d="M{margin} {height - 12:.0f}h{bar:.0f}"/><text fill="#6b7786"'
            f' x="{end:.0f}" y="{height - 8:.0f}">{metres:g} m</text></svg>'
        )


def node_distances(
    world_from_cam: Rigid3, nodes: NodePoses, lambda_rot: float
) -> Float[np.ndarray, " nodes"]:
    """Return D_total of Eq. 1 (metres) between a camera and each node."""
    traces = np.einsum("nij,ij->n", nodes.rotations, world_from_cam.rotation)
    return _total_distances(world_from_cam, nodes, traces, lambda_rot)


def node_distances_for_any_roll(
    world_from_cam: Rigid3, nodes: NodePoses, lambda_rot: float
) -> Float[np.ndarray, " nodes"]:
    """Return D_total of Eq. 1 (metres) between a camera and each node, for any camera roll.

    It is the minimum over four rolls, 90 degrees apart.
    """
    x, y, z = world_from_cam.rotation.T
    rolls = np.stack([(x, y, z), (y, -x, z), (-x, -y, z), (-y, x, z)])
    traces = np.einsum("nij,rji->rn", nodes.rotations, rolls).max(axis=0)
    return _total_distances(world_from_cam, nodes, traces, lambda_rot)


def _total_distances(
    world_from_cam: Rigid3,
    nodes: NodePoses,
    traces: Float[np.ndarray, " nodes"],
    lambda_rot: float,
) -> Float[np.ndarray, " nodes"]:
    """Return D_total of Eq. 1 (metres) from the traces of the rotations between camera and node."""
    d_translation = np.linalg.norm(nodes.centres - world_from_cam.translation, axis=1)
    return d_translation + lambda_rot * np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0))


def select_node_frames(
    world_from_cams: list[Rigid3], d_thresh: float, lambda_rot: float
) -> Int[np.ndarray, " nodes"]:
    """Return the frames along a trajectory that become nodes by Eq. 1."""
    poses, frame_idx = NodePoses.from_poses(world_from_cams), list[int]()
    cells: dict[tuple[int, ...], list[int]] = {}  # selected frames by their cube of side D_thresh
    for k, (world_from_cam, cell) in enumerate(
        zip(world_from_cams, np.floor(poses.centres / d_thresh).tolist(), strict=True)
    ):
        near = [
            frame
            for step in _STEPS
            for frame in cells.get((cell[0] + step[0], cell[1] + step[1], cell[2] + step[2]), ())
        ]
        distances = node_distances(world_from_cam, poses.rows(near), lambda_rot)
        if distances.min(initial=np.inf) > d_thresh:
            frame_idx.append(k)
            cells.setdefault(tuple(cell), []).append(k)
    return np.array(frame_idx)


def find_nearest_nodes(
    world_from_cam: Rigid3, nodes: NodePoses, lambda_rot: float, count: int
) -> Int[np.ndarray, " nearest"]:
    """Return the rows of up to `count` nodes nearest to a camera by Eq. 1, the nearest first. Ties
    keep the order of rows. The distance in metres is a lower bound, so only a few are compared."""
    metres = np.linalg.norm(nodes.centres - world_from_cam.translation, axis=1)
    num_checked = 8 * count
    while True:
        is_all = num_checked >= len(metres)
        near = slice(None) if is_all else np.argpartition(metres, num_checked)[:num_checked]
        rows = np.sort(np.arange(len(metres))[near])
        distances = node_distances(world_from_cam, nodes.rows(rows), lambda_rot)
        order = np.argsort(distances, kind="stable")[:count]
        if is_all or distances[order[-1]] < metres[rows].max():
            return rows[order]
        num_checked *= 4


def compute_nodes_digest(summaries: Sequence[NodeSummary], method: bytes) -> str:
    """Return a short digest of the nodes' poses and numbers of points, and of `method`. It
    identifies results computed from the nodes."""
    digest = hashlib.sha256(method)
    for summary in summaries:
        digest.update(summary.world_from_cam.matrix().astype("<f8").tobytes())
        digest.update(summary.num_points.to_bytes(4, "little"))
    return digest.hexdigest()[:16]
