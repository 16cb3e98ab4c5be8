"""A map opened for queries: where its nodes stand, what names them, and their points in the world.
Nodes go by their rows."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int

from topoloc.errors import EmptyMapError
from topoloc.features.feature_types import find_feature_type
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.guided import predict_key_points
from topoloc.localization.local_map import LocalMap
from topoloc.localization.map_facts.repetition import (
    NUM_NEIGHBOURS,
    digest_of,
    find_copy_transform,
    find_repetition_shifts,
    has_repetitions,
)
from topoloc.localization.walls.virtual_view_index import VirtualViewIndex
from topoloc.mapping.node_cache import CachedNodes
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap, TopoNode, open_map_coarse_localizer
from topoloc.retrieval.coarse import CoarseLocalizer, Image, NodeScore
from topoloc.retrieval.vlad import SurfVlad

_NO_MOVES = np.zeros((0, 4, 4))
_MIN_SHIFT_REACH = 2.5  # metres: how far shifts are looked for, at least
_NUM_SIMILAR_NODES, _MAX_SIMILAR_GROUPS, _GROUP_RADIUS = (
    64,
    6,
    5.0,
)  # nodes that look alike; parts of the map that they make up; a part, in D_thresh (Eq. 1)


class OpenMap:
    """What a localizer keeps of a map between queries.

    Args:
        coarse: the map's coarse localizer of this name, or any object with `CoarseLocalizer.rank`;
            None for the map's default.

    Raises:
        EmptyMapError: the map has no node.
        MapError: the map has no such coarse localizer.
    """

    def __init__(self, topomap: TopoMetricMap, coarse: str | CoarseLocalizer | None = None) -> None:
        if len(topomap.summaries) == 0:
            raise EmptyMapError("the map has no nodes")
        self.topomap = topomap
        by_name = (
            open_map_coarse_localizer(topomap, coarse or topomap.default_coarse)
            if coarse is None or isinstance(coarse, str)
            else None
        )
        self.coarse: CoarseLocalizer = coarse if by_name is None else by_name  # pyright: ignore[reportAttributeAccessIssue]
        self.feature_config = topomap.config.features
        self.kind = find_feature_type(self.feature_config.kind)
        self.node_ids = [summary.node_id for summary in topomap.summaries]
        self.node_poses = NodePoses.of([summary.world_from_cam for summary in topomap.summaries])
        self.lambda_rot, self.d_thresh = topomap.config.lambda_rot, topomap.config.d_thresh
        self._local_map = CachedNodes(lambda row: LocalMap.of_node(topomap.nodes[row]))
        self._moves = CachedNodes(self._find_moves)
        self._stored_moves = _stored_moves(topomap)
        self.focal = _max_focal_length(topomap)
        self._predicted_at_nodes: tuple[Camera, CachedNodes[Float32[np.ndarray, "n 5"]]] | None = (
            None
        )
        self._masked_rows = list[int]()

    def without(self, rows: Iterable[int]) -> OpenMap:
        """The same map as if nobody had stood at these nodes, whose rows stay theirs; what was read
        is shared. Its walls are not asked."""
        other = copy.copy(self)
        other._masked_rows = sorted(set(rows))
        other.coarse = _MaskedCoarseLocalizer(self.coarse, frozenset(other._masked_rows))
        other.__dict__["walls"] = None
        return other

    @cached_property
    def walls(self) -> VirtualViewIndex | None:
        """The map's side nodes; None where it has none, or by features of another kind."""
        sides = self.topomap.sides
        return (
            VirtualViewIndex(self.topomap, sides)
            if sides is not None and sides.is_used_with(self.kind.name)
            else None
        )

    def with_node_ids(self, candidates: list[NodeScore]) -> list[NodeScore]:
        """Candidates as they are reported: until then a candidate's `node_id` is the row of its
        node."""
        return [
            NodeScore(self.node_ids[candidate.node_id], candidate.score) for candidate in candidates
        ]

    def cam_from_world(self, row: int) -> Rigid3:
        """Of a node's camera."""
        return self.topomap.summaries[row].world_from_cam.inverse()

    def local_map(self, rows: Sequence[int] | Int[np.ndarray, " n"]) -> LocalMap:
        """The points of these nodes together."""
        return LocalMap.concatenate([self._local_map(int(row)) for row in rows])

    def predict_at_node(self, row: int, camera: Camera) -> Float32[np.ndarray, "n 5"]:
        """What `predict_key_points` says of a node's points for a camera that stands where the
        node does."""
        kept = self._predicted_at_nodes
        if kept is None or kept[0] != camera:  # queries mostly come from one camera
            read = CachedNodes(
                lambda row: predict_key_points(
                    self._local_map(row), self.cam_from_world(row), camera
                )
            )
            self._predicted_at_nodes = kept = (camera, read)
        return kept[1](row)

    def repeats(self, row: int) -> Float[np.ndarray, "k 3"]:
        """The shifts (metres, world) by which what a node shows repeats itself, see
        `repetition.py`: of its moves those without a turn."""
        moves = self.moves(row)
        return moves[(moves[:, :3, :3] == np.eye(3)).all(axis=(1, 2)), :3, 3]

    def moves(self, row: int) -> Float[np.ndarray, "k 4 4"]:
        """The moves (world) by which what a node shows is found elsewhere in the map; as the map
        tells them, or found now."""
        known = self._stored_moves
        return self._moves(row) if known is None else known.get(self.node_ids[row], _NO_MOVES)

    def _find_moves(self, row: int) -> Float[np.ndarray, "k 4 4"]:
        node = self.topomap.nodes[row]
        found = [Rigid3(np.eye(3), shift) for shift in self._find_shifts(row)]
        found += [
            move
            for part in self._similar_distant_nodes(node)
            if (move := find_copy_transform(node, self.local_map(part))) is not None
        ]
        return np.array([move.matrix() for move in found]).reshape(-1, 4, 4)

    def _similar_distant_nodes(self, node: TopoNode) -> Iterator[list[int]]:
        """The rows of nodes that look like this one and are far from it, those near each other
        together, the most alike first."""
        if self._appearance_ranker is None:
            return
        blank = np.zeros((node.camera.height, node.camera.width), np.uint8)
        far = self.distances(node.summary.world_from_cam) > _GROUP_RADIUS * self.d_thresh
        left = [
            found.node_id
            for found in self._appearance_ranker.rank(blank, node.features, _NUM_SIMILAR_NODES)
            if far[found.node_id]
        ]
        for _ in range(_MAX_SIMILAR_GROUPS):
            if not left:
                return
            near = (
                self.distances(self.topomap.summaries[left[0]].world_from_cam)
                <= _GROUP_RADIUS * self.d_thresh
            )
            yield [row for row in left if near[row]][:3]
            left = [row for row in left if not near[row]]

    @cached_property
    def _appearance_ranker(self) -> CoarseLocalizer | None:
        """What ranks nodes by features alone, where the map has it."""
        return (
            open_map_coarse_localizer(self.topomap, SurfVlad.name)
            if SurfVlad.name in self.topomap.coarse_models
            else None
        )

    def _find_shifts(self, row: int) -> Float[np.ndarray, "k 3"]:
        node, poses = self._local_map(row), self.node_poses
        if not has_repetitions(node):
            return np.zeros((0, 3))
        depths = self.cam_from_world(row).apply(node.points_world)[:, 2]
        away = np.linalg.norm(poses.centres - poses.centres[row], axis=1)
        looks_alike = poses.rotations[:, :, 2] @ poses.rotations[row, :, 2] > 0.85
        near = np.flatnonzero(
            looks_alike & (away < max(_MIN_SHIFT_REACH, 1.5 * float(np.median(depths))))
        )
        near = near[np.argsort(away[near], kind="stable")]
        spread = np.unique(np.linspace(0, len(near) - 1, NUM_NEIGHBOURS).round().astype(int))
        return find_repetition_shifts(node, self.local_map(near[spread]))

    def distances(self, world_from_cam: Rigid3) -> Float[np.ndarray, " nodes"]:
        """D_total of Eq. 1 (metres) between a camera and each node, whichever side of the camera is
        up."""
        distances = roll_invariant_distances(world_from_cam, self.node_poses, self.lambda_rot)
        distances[self._masked_rows] = np.inf
        return distances

    def nearest(self, world_from_cam: Rigid3, num_nodes: int) -> Int[np.ndarray, " n"]:
        """The rows of the nodes nearest to a camera, the nearest first."""
        return np.argsort(self.distances(world_from_cam), kind="stable")[
            : min(num_nodes, len(self.node_ids) - len(self._masked_rows))
        ]


class _MaskedCoarseLocalizer:
    """A coarse localizer that does not name some nodes, by their rows."""

    def __init__(self, coarse: CoarseLocalizer, masked_rows: frozenset[int]) -> None:
        self._coarse, self._masked_rows = coarse, masked_rows

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """See `CoarseLocalizer.rank`."""
        ranked = self._coarse.rank(image, features, num_candidates + len(self._masked_rows))
        return [candidate for candidate in ranked if candidate.node_id not in self._masked_rows][
            :num_candidates
        ]


def _stored_moves(topomap: TopoMetricMap) -> Mapping[int, Float[np.ndarray, "k 4 4"]] | None:
    """The moves that the map tells by the ids of its nodes, where they were found of the nodes that
    it has."""
    known = topomap.repetitions
    return (
        dict(known.moves)
        if known is not None and known.digest == digest_of(topomap.summaries)
        else None
    )


def _max_focal_length(topomap: TopoMetricMap) -> float:
    """Focal length (pixels) of the finest camera that mapped; each recording is taken to have one
    camera."""
    first_rows = {
        topomap.summaries[row].session_id: row for row in reversed(range(len(topomap.summaries)))
    }
    return max(topomap.nodes[row].camera.fx for row in first_rows.values())


QUARTER_TURN = Rigid3(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
"""A quarter turn about the optical axis."""


def roll_invariant_distances(
    world_from_cam: Rigid3, nodes: NodePoses, lambda_rot: float
) -> Float[np.ndarray, " nodes"]:
    """D_total of Eq. 1 (metres) between a camera and each node, whichever side of the camera is up:
    the least of four quarter turns."""
    distances = node_distances(world_from_cam, nodes, lambda_rot)
    for _ in range(3):
        world_from_cam = world_from_cam @ QUARTER_TURN
        distances = np.minimum(distances, node_distances(world_from_cam, nodes, lambda_rot))
    return distances
