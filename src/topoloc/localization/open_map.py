"""A map opened for queries: where its nodes stand, what names them, and their points in the world.
Nodes go by their rows."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int

from topoloc.errors import EmptyMapError
from topoloc.features.features import Features
from topoloc.features.kinds import find_kind
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.guided import expected_key_points
from topoloc.localization.local_map import LocalMap
from topoloc.localization.map_facts.repetition import (
    NUM_NEIGHBOURS,
    copy_of,
    digest_of,
    may_repeat,
    shifts_of,
)
from topoloc.localization.walls.wall_index import WallIndex
from topoloc.mapping.memory import RememberedNodes
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap, TopoNode, open_coarse_of
from topoloc.retrieval.coarse import CoarseLocalizer, Image, NodeScore
from topoloc.retrieval.vlad import SurfVlad

_NO_MOVES = np.zeros((0, 4, 4))
_LEAST_REACH = 2.5  # metres: how far shifts are looked for, at least
_NUM_ALIKE, _NUM_PARTS, _PART_REACH = (
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
            open_coarse_of(topomap, coarse or topomap.default_coarse)
            if coarse is None or isinstance(coarse, str)
            else None
        )
        self.coarse: CoarseLocalizer = coarse if by_name is None else by_name  # pyright: ignore[reportAttributeAccessIssue]
        self.feature_config = topomap.config.features
        self.kind = find_kind(self.feature_config.kind)
        self.node_ids = [summary.node_id for summary in topomap.summaries]
        self.node_poses = NodePoses.of([summary.world_from_cam for summary in topomap.summaries])
        self.lambda_rot, self.d_thresh = topomap.config.lambda_rot, topomap.config.d_thresh
        self._local_map = RememberedNodes(lambda row: LocalMap.of_node(topomap.nodes[row]))
        self._moves = RememberedNodes(self._find_moves)
        self._known_moves = _known_moves(topomap)
        self.focal = _finest_focal(topomap)
        self._expected: tuple[Camera, RememberedNodes[Float32[np.ndarray, "n 5"]]] | None = None
        self._hidden = list[int]()

    def without(self, rows: Iterable[int]) -> OpenMap:
        """The same map as if nobody had stood at these nodes, whose rows stay theirs; what was read
        is shared. Its walls are not asked."""
        other = copy.copy(self)
        other._hidden = sorted(set(rows))
        other.coarse = _Without(self.coarse, frozenset(other._hidden))
        other.__dict__["walls"] = None
        return other

    @cached_property
    def walls(self) -> WallIndex | None:
        """The map's side nodes; None where it has none, or by features of another kind."""
        sides = self.topomap.sides
        return (
            WallIndex(self.topomap, sides)
            if sides is not None and sides.is_asked_by(self.kind.name)
            else None
        )

    def with_ids(self, candidates: list[NodeScore]) -> list[NodeScore]:
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
        return LocalMap.pooled([self._local_map(int(row)) for row in rows])

    def expected_at_node(self, row: int, camera: Camera) -> Float32[np.ndarray, "n 5"]:
        """What `expected_key_points` says of a node's points for a camera that stands where the
        node does."""
        kept = self._expected
        if kept is None or kept[0] != camera:  # queries mostly come from one camera
            read = RememberedNodes(
                lambda row: expected_key_points(
                    self._local_map(row), self.cam_from_world(row), camera
                )
            )
            self._expected = kept = (camera, read)
        return kept[1](row)

    def repeats(self, row: int) -> Float[np.ndarray, "k 3"]:
        """The shifts (metres, world) by which what a node shows repeats itself, see
        `repetition.py`: of its moves those without a turn."""
        moves = self.moves(row)
        return moves[(moves[:, :3, :3] == np.eye(3)).all(axis=(1, 2)), :3, 3]

    def moves(self, row: int) -> Float[np.ndarray, "k 4 4"]:
        """The moves (world) by which what a node shows is found elsewhere in the map; as the map
        tells them, or found now."""
        known = self._known_moves
        return self._moves(row) if known is None else known.get(self.node_ids[row], _NO_MOVES)

    def _find_moves(self, row: int) -> Float[np.ndarray, "k 4 4"]:
        node = self.topomap.nodes[row]
        found = [Rigid3(np.eye(3), shift) for shift in self._shifts(row)]
        found += [
            move
            for part in self._alike(node)
            if (move := copy_of(node, self.local_map(part))) is not None
        ]
        return np.array([move.matrix() for move in found]).reshape(-1, 4, 4)

    def _alike(self, node: TopoNode) -> Iterator[list[int]]:
        """The rows of nodes that look like this one and are far from it, those near each other
        together, the most alike first."""
        if self._by_looks is None:
            return
        blank = np.zeros((node.camera.height, node.camera.width), np.uint8)
        far = self.distances(node.summary.world_from_cam) > _PART_REACH * self.d_thresh
        left = [
            found.node_id
            for found in self._by_looks.rank(blank, node.features, _NUM_ALIKE)
            if far[found.node_id]
        ]
        for _ in range(_NUM_PARTS):
            if not left:
                return
            near = (
                self.distances(self.topomap.summaries[left[0]].world_from_cam)
                <= _PART_REACH * self.d_thresh
            )
            yield [row for row in left if near[row]][:3]
            left = [row for row in left if not near[row]]

    @cached_property
    def _by_looks(self) -> CoarseLocalizer | None:
        """What ranks nodes by features alone, where the map has it."""
        return (
            open_coarse_of(self.topomap, SurfVlad.name)
            if SurfVlad.name in self.topomap.coarse_models
            else None
        )

    def _shifts(self, row: int) -> Float[np.ndarray, "k 3"]:
        node, poses = self._local_map(row), self.node_poses
        if not may_repeat(node):
            return np.zeros((0, 3))
        depths = self.cam_from_world(row).apply(node.points_world)[:, 2]
        away = np.linalg.norm(poses.centres - poses.centres[row], axis=1)
        looks_alike = poses.rotations[:, :, 2] @ poses.rotations[row, :, 2] > 0.85
        near = np.flatnonzero(
            looks_alike & (away < max(_LEAST_REACH, 1.5 * float(np.median(depths))))
        )
        near = near[np.argsort(away[near], kind="stable")]
        spread = np.unique(np.linspace(0, len(near) - 1, NUM_NEIGHBOURS).round().astype(int))
        return shifts_of(node, self.local_map(near[spread]))

    def distances(self, world_from_cam: Rigid3) -> Float[np.ndarray, " nodes"]:
        """D_total of Eq. 1 (metres) between a camera and each node, whichever side of the camera is
        up."""
        distances = viewing_distances(world_from_cam, self.node_poses, self.lambda_rot)
        distances[self._hidden] = np.inf
        return distances

    def nearest(self, world_from_cam: Rigid3, num_nodes: int) -> Int[np.ndarray, " n"]:
        """The rows of the nodes nearest to a camera, the nearest first."""
        return np.argsort(self.distances(world_from_cam), kind="stable")[
            : min(num_nodes, len(self.node_ids) - len(self._hidden))
        ]


class _Without:
    """A coarse localizer that does not name some nodes, by their rows."""

    def __init__(self, coarse: CoarseLocalizer, hidden: frozenset[int]) -> None:
        self._coarse, self._hidden = coarse, hidden

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """See `CoarseLocalizer.rank`."""
        ranked = self._coarse.rank(image, features, num_candidates + len(self._hidden))
        return [candidate for candidate in ranked if candidate.node_id not in self._hidden][
            :num_candidates
        ]


def _known_moves(topomap: TopoMetricMap) -> Mapping[int, Float[np.ndarray, "k 4 4"]] | None:
    """The moves that the map tells by the ids of its nodes, where they were found of the nodes that
    it has."""
    known = topomap.repetitions
    return (
        dict(known.moves)
        if known is not None and known.digest == digest_of(topomap.summaries)
        else None
    )


def _finest_focal(topomap: TopoMetricMap) -> float:
    """Focal length (pixels) of the finest camera that mapped; each recording is taken to have one
    camera."""
    first_rows = {
        topomap.summaries[row].session_id: row for row in reversed(range(len(topomap.summaries)))
    }
    return max(topomap.nodes[row].camera.fx for row in first_rows.values())


QUARTER = Rigid3(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
"""A quarter turn about the optical axis."""


def viewing_distances(
    world_from_cam: Rigid3, nodes: NodePoses, lambda_rot: float
) -> Float[np.ndarray, " nodes"]:
    """D_total of Eq. 1 (metres) between a camera and each node, whichever side of the camera is up:
    the least of four quarter turns."""
    distances = node_distances(world_from_cam, nodes, lambda_rot)
    for _ in range(3):
        world_from_cam = world_from_cam @ QUARTER
        distances = np.minimum(distances, node_distances(world_from_cam, nodes, lambda_rot))
    return distances
