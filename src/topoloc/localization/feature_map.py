"""Open a map for queries: node poses, coarse localizer, and points in the world frame.

Nodes are identified by their rows.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32

from topoloc.errors import EmptyMapError
from topoloc.features.feature_types import find_feature_type
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.exact.templates import NodeTemplate
from topoloc.localization.guided import count_seen_points, predict_key_points
from topoloc.localization.map_facts.repetition import (
    NUM_NEIGHBOURS,
    digest_of,
    find_copy_transform,
    find_repetition_shifts,
)
from topoloc.localization.pose_fit import LocalMap
from topoloc.localization.walls.virtual_view_index import VirtualViewIndex
from topoloc.mapping.coarse_models import open_map_coarse_localizer
from topoloc.mapping.node_cache import CachedNodes
from topoloc.mapping.nodes import node_distances_for_any_roll
from topoloc.mapping.topomap import TopoMetricMap, TopoNode
from topoloc.node_ids import NodeId, Row, as_rows
from topoloc.retrieval.coarse import CoarseLocalizer, Image, NodeScore
from topoloc.retrieval.vlad import SurfVlad


@dataclass(frozen=True, eq=False)
class _ReadNode:
    """Hold a node that was read once: its points, and the node without them, for its image."""

    local_map: LocalMap
    pictured: TopoNode

    @staticmethod
    def of_node(node: TopoNode) -> _ReadNode:
        no_points = replace(
            node,
            features=Features.empty(node.features.descriptors.shape[1]),
            points_cam=node.points_cam[:0],
            point_sqrt_covs=node.point_sqrt_covs[:0],
            session_statistics=(),
            stored_descriptors=None,
        )
        return _ReadNode(LocalMap.of_node(node), no_points)


class FeatureMap:
    """Hold the data of a map that a localizer keeps between queries.

    Args:
        coarse: name of one of the map's coarse localizers, or any object with
            `CoarseLocalizer.rank`. None: the map's default.
        kind: the feature type of the points that are used. None: the map's first.

    Raises:
        EmptyMapError: the map has no node.
        FeatureTypeError: the map has no such feature type.
        MapError: the map has no such coarse localizer.
    """

    def __init__(
        self,
        topomap: TopoMetricMap,
        coarse: str | CoarseLocalizer | None = None,
        kind: str | None = None,
    ) -> None:
        if len(topomap.summaries) == 0:
            raise EmptyMapError("the map has no nodes")
        kind = kind or topomap.kind
        self.topomap, self._nodes = topomap, topomap.find_layer(kind).nodes
        by_name = (
            open_map_coarse_localizer(topomap, coarse or topomap.default_coarse, kind)
            if coarse is None or isinstance(coarse, str)
            else None
        )
        self.coarse: CoarseLocalizer = coarse if by_name is None else by_name  # pyright: ignore[reportAttributeAccessIssue]
        self.feature_config = topomap.config.feature_config_for(kind)
        self.kind = find_feature_type(kind)
        self.node_ids = [summary.node_id for summary in topomap.summaries]
        self.node_poses = topomap.node_poses
        self.lambda_rot, self.d_thresh = topomap.config.lambda_rot, topomap.config.d_thresh
        self._read = CachedNodes(lambda row: _ReadNode.of_node(self._nodes[row]))
        self._moves = CachedNodes(self._find_moves)
        self._template = CachedNodes(lambda row: NodeTemplate.of_node(self._read(row).pictured))
        known = topomap.repetitions
        is_current = known is not None and known.digest == digest_of(topomap.summaries)
        self._stored_moves = dict(known.moves) if known is not None and is_current else None
        self.focal = topomap.max_focal_length_px()
        self._predicted_at_nodes: tuple[Camera, CachedNodes[Float32[np.ndarray, "n 5"]]] | None = (
            None
        )
        self._masked_rows = list[Row]()

    def without(self, rows: Iterable[Row]) -> FeatureMap:
        """Return the same map without these nodes. The other rows keep their numbers.

        Loaded nodes are shared. Virtual views are not used. Raises EmptyMapError if none remains.
        """
        other = copy.copy(self)
        other._masked_rows = sorted({*self._masked_rows, *rows})
        if len(other._masked_rows) == len(self.node_ids):
            raise EmptyMapError("no node of the map remains")
        other.coarse = _MaskedCoarseLocalizer(self.coarse, frozenset(other._masked_rows))
        other.__dict__["walls"] = None
        return other

    @cached_property
    def walls(self) -> VirtualViewIndex | None:
        """Return the map's virtual views, None if it has none for this feature type."""
        sides = self.topomap.sides_for(self.kind.name)
        return None if sides is None else VirtualViewIndex(self.topomap, sides)

    def cam_from_world(self, row: Row) -> Rigid3:
        """Return cam_from_world of a node."""
        return self.node_poses.world_from_node(row).inverse()

    def local_map(self, rows: Sequence[Row]) -> LocalMap:
        """Return the points of these nodes, pooled."""
        return LocalMap.concatenate(self.local_maps(rows))

    def local_maps(self, rows: Sequence[Row]) -> list[LocalMap]:
        """Return the points of each of these nodes."""
        return [one.local_map for one in self._read.pool(rows)]

    def templates(self, node_ids: Iterable[NodeId]) -> list[NodeTemplate]:
        """Return the images of these nodes."""
        return self._template.pool(self.topomap.rows_of(node_ids))

    def predict_at_nodes(
        self, rows: Sequence[Row], camera: Camera
    ) -> list[Float32[np.ndarray, "n 5"]]:
        """Return `predict_key_points` of each node's points for a camera at the node's pose.

        The predictions are cached for one camera.
        """
        kept = self._predicted_at_nodes
        if kept is None or kept[0] != camera:  # most queries share one camera
            read = CachedNodes(
                lambda row: predict_key_points(
                    self._read(row).local_map, self.cam_from_world(row), camera
                )
            )
            self._predicted_at_nodes = kept = (camera, read)
        return kept[1].pool(rows)

    def repeats(self, row: Row) -> Float[np.ndarray, "k 3"]:
        """Return the repetition shifts (metres, world) of a node: its moves without rotation.

        See `repetition.py`.
        """
        moves = self.moves(row)
        return moves[(moves[:, :3, :3] == np.eye(3)).all(axis=(1, 2)), :3, 3]

    def moves(self, row: Row) -> Float[np.ndarray, "k 4 4"]:
        """Return the transforms (world) that move a node's content onto copies of it in the map.

        They are read from the map if it stores them, and computed otherwise.
        """
        if self._stored_moves is None:
            return self._moves(row)
        return self._stored_moves.get(self.node_ids[row], np.zeros((0, 4, 4)))

    def _find_moves(self, row: Row) -> Float[np.ndarray, "k 4 4"]:
        node = self._nodes[row]
        found = [Rigid3(np.eye(3), shift) for shift in self._find_shifts(row)]
        found += [
            move
            for part in self._similar_distant_nodes(node)
            if (move := find_copy_transform(node, self.local_map(part))) is not None
        ]
        return np.array([move.matrix() for move in found]).reshape(-1, 4, 4)

    def _similar_distant_nodes(self, node: TopoNode) -> Iterator[list[Row]]:
        """Generate groups of rows of distant nodes that look like this one, most similar first.

        The 64 most similar nodes form up to six groups of up to three nodes near each other.
        """
        if self._appearance_ranker is None:
            return
        blank = np.zeros((node.camera.height, node.camera.width), np.uint8)
        radius = 5.0 * self.d_thresh  # of a group, Eq. 1
        far = self.distances(node.summary.world_from_cam) > radius
        similar = self._appearance_ranker.rank(blank, node.features, 64)
        left = [found.row for found in similar if far[found.row]]
        for _ in range(6):
            if not left:
                return
            near = self.distances(self.node_poses.world_from_node(left[0])) <= radius
            yield [row for row in left if near[row]][:3]
            left = [row for row in left if not near[row]]

    @cached_property
    def _appearance_ranker(self) -> CoarseLocalizer | None:
        """Return the coarse localizer that needs features only, None if the map has none."""
        kind = self.kind.name
        if SurfVlad.name not in self.topomap.layers[kind].coarse_models:
            return None
        return open_map_coarse_localizer(self.topomap, SurfVlad.name, kind)

    def _find_shifts(self, row: Row) -> Float[np.ndarray, "k 3"]:
        node, poses = self._read(row).local_map, self.node_poses
        # in most repetitive places a node's own image shows some part twice
        if len(find_repetition_shifts(node, node, min_share=0.15)) == 0:
            return np.zeros((0, 3))
        depths = self.cam_from_world(row).apply(node.points_world)[:, 2]
        away = np.linalg.norm(poses.centres - poses.centres[row], axis=1)
        looks_alike = poses.rotations[:, :, 2] @ poses.rotations[row, :, 2] > 0.85
        near = np.flatnonzero(
            looks_alike & (away < max(2.5, 1.5 * float(np.median(depths))))  # metres
        )
        near = near[np.argsort(away[near], kind="stable")]
        spread = np.unique(np.linspace(0, len(near) - 1, NUM_NEIGHBOURS).round().astype(int))
        return find_repetition_shifts(node, self.local_map(as_rows(near[spread])))

    def distances(self, world_from_cam: Rigid3) -> Float[np.ndarray, " nodes"]:
        """Return D_total of Eq. 1 (metres) between a camera and each node, for any camera roll."""
        distances = node_distances_for_any_roll(world_from_cam, self.node_poses, self.lambda_rot)
        distances[self._masked_rows] = np.inf
        return distances

    def remoteness(self, world_from_cam: Rigid3) -> float:
        """Return the distance to the nearest node by Eq. 1 over 5 D_thresh. Above 1 a camera is far
        from all nodes: recorded frames are within 1 D_thresh of one."""
        return float(self.distances(world_from_cam).min()) / (5.0 * self.d_thresh)

    def nearest(self, world_from_cam: Rigid3, num_nodes: int) -> list[Row]:
        """Return the rows of the nodes nearest to a camera, nearest first."""
        order = np.argsort(self.distances(world_from_cam), kind="stable")
        num_nodes = min(num_nodes, len(self.node_ids) - len(self._masked_rows))
        return [Row(row) for row in order[:num_nodes].tolist()]

    def showing(self, cam_from_world: Rigid3, camera: Camera, num_nodes: int) -> list[Row]:
        """Return the rows of the nodes nearest to a camera of those that show what it sees.

        Beside the path the nearest nodes by Eq. 1 look past what the camera sees, and nodes farther
        back show it. Those count that show half as many points as the best one.
        """
        max_read, min_share = 24, 0.5
        world_from_cam = cam_from_world.inverse()
        if self.remoteness(world_from_cam) <= 1.0:
            return self.nearest(world_from_cam, num_nodes)
        distances = self.distances(world_from_cam)
        centres = self.node_poses.centres
        apart = np.linalg.norm(centres - world_from_cam.translation, axis=1)
        apart[np.isinf(distances)] = np.inf
        near = as_rows(np.argsort(apart, kind="stable")[: min(max_read, np.isfinite(apart).sum())])
        counts = np.array(
            [
                count_seen_points(points, centres[row], cam_from_world, camera)
                for row, points in zip(near, self.local_maps(near), strict=True)
            ]
        )
        shows = counts >= min_share * counts.max()
        order = np.lexsort((distances[near], ~shows))
        return [near[k] for k in order[:num_nodes]]


class _MaskedCoarseLocalizer:
    """Rank nodes with another coarse localizer and leave out some rows."""

    def __init__(self, coarse: CoarseLocalizer, masked_rows: frozenset[Row]) -> None:
        self._coarse, self._masked_rows = coarse, masked_rows

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """See `CoarseLocalizer.rank`."""
        ranked = self._coarse.rank(image, features, num_candidates + len(self._masked_rows))
        return [candidate for candidate in ranked if candidate.row not in self._masked_rows][
            :num_candidates
        ]
