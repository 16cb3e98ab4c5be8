"""Create virtual nodes: the walls beside the trajectory as virtual cameras see them, for queries in
the reverse direction.

A node's points are found again only from similar directions. Its image also shows the walls on the
left and right at a slant. `features/virtual_views.py` renders them as seen from the front. Selected
nodes therefore get up to two virtual cameras at the same place that look to the sides, with their
own features and points. They are not nodes of Eq. 1. The localizer uses them only if nothing else
gives a pose (`localization/walls/`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from topoloc.disk_list import DiskList
from topoloc.features.extraction import FeatureConfig, extract_features
from topoloc.features.virtual_views import make_virtual_views
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.config import MapConfig
from topoloc.mapping.nodes import NodePoses, select_node_frames
from topoloc.mapping.storage.entries import NodeSummary, TopoNode, VirtualNodes
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import NodeId, Row, as_rows
from topoloc.points.metric_points import locate_points
from topoloc.recordings.frame_preparation import PreparedFrame
from topoloc.retrieval.coarse import VladConfig
from topoloc.retrieval.vlad import SurfVlad, append_positions, learn_words_from_parts, vlad


def select_virtual_view_nodes(world_from_nodes: list[Rigid3], config: MapConfig) -> set[Row]:
    """Return the rows of the poses that need virtual views. `config` is that of the map."""
    # A node needs no virtual nodes if another node within this many D_thresh looks in the
    # opposite direction.
    max_opposite = 10.0
    spacing = config.sides.spacing
    if spacing == 0.0:
        return set()
    poses, reach = NodePoses.of(world_from_nodes), max_opposite * config.d_thresh
    d_thresh, lambda_rot = spacing * config.d_thresh, config.lambda_rot / 2.0
    rows = as_rows(select_node_frames(world_from_nodes, d_thresh, lambda_rot))
    return {row for row in rows if not poses.has_opposite(row, reach, -0.7)}


def find_new_virtual_views(topomap: TopoMetricMap, world_from_cams: Sequence[Rigid3]) -> set[int]:
    """Return which of the poses need virtual views that no virtual node of the map provides. Return
    an empty set if the map's virtual nodes have another feature type than new images."""
    if topomap.sides is not None and topomap.sides.kind != topomap.config.virtual_view_type:
        return set()
    old = [summary.world_from_cam for summary in topomap.summaries]
    chosen = select_virtual_view_nodes([*old, *world_from_cams], topomap.config)
    return {row - len(old) for row in chosen if row >= len(old)}


def add_virtual_nodes(topomap: TopoMetricMap, new_nodes: Sequence[TopoNode]) -> VirtualNodes | None:
    """Return the map's virtual nodes with new ones of the same feature type. The retrieval model is
    learned anew from all of them."""
    before = topomap.sides
    if not new_nodes:
        return before
    if before is None:
        return collect_virtual_nodes(new_nodes, topomap.config.virtual_view_type)
    return collect_virtual_nodes([*before.nodes, *new_nodes], before.kind)


def create_virtual_nodes(
    of_node: NodeSummary,
    view: PreparedFrame,
    feature_config: FeatureConfig,
    max_points: int = 400,
    min_points: int = 20,
) -> list[TopoNode]:
    """Return the virtual nodes of a node's image, at most two, without ids. Each keeps the
    `max_points` strongest features. A virtual view with fewer than `min_points` becomes none."""
    nodes = list[TopoNode]()
    for virtual_view in make_virtual_views(view.camera):
        extracted = extract_features(virtual_view.picture(view.grey), feature_config)
        features = virtual_view.select_inside(extracted)
        located = locate_points(virtual_view.to_image_pixels(features, view.camera), view)
        # points too slanted from the virtual camera are not on the wall in front of it
        side_from_cam = virtual_view.cam_from_virtual.inverse()
        points_side = side_from_cam.apply(located.points_cam)
        with np.errstate(invalid="ignore"):
            in_front = located.valid & (points_side[:, 2] > 0.1 * located.points_cam[:, 2])
        rows = np.flatnonzero(in_front)[:max_points]
        if len(rows) >= min_points:
            pose = of_node.world_from_cam @ virtual_view.cam_from_virtual
            summary = replace(of_node, world_from_cam=pose, num_points=len(rows))
            turn, points = side_from_cam.rotation, points_side[rows].astype(np.float32)
            roots = np.linalg.cholesky(turn @ located.covariances[rows] @ turn.T)
            roots = roots[:, *np.tril_indices(3)].astype(np.float32)
            seen = features.select(rows)
            nodes.append(TopoNode(summary, virtual_view.camera, seen, points, roots, b""))
    return nodes


def collect_virtual_nodes(described: Sequence[TopoNode], kind: str) -> VirtualNodes | None:
    """Number all virtual nodes of a map, of one feature type, and fit their retrieval model. Return
    None if there are none. `of_node` must be set."""
    if len(described) == 0:
        return None
    nodes = DiskList(
        replace(node, summary=replace(node.summary, node_id=NodeId(k)))
        for k, node in enumerate(described)
    )
    model, centres = _fit_vlad(nodes).to_model(), np.array([*map(_median_point_world, nodes)])
    model = replace(model, arrays={**model.arrays, "centres": centres})
    return VirtualNodes([node.summary for node in nodes], nodes, {model.name: model}, kind)


def _median_point_world(node: TopoNode) -> Float[np.ndarray, " 3"]:
    """Return the median point of a node in the world."""
    median = np.median(node.points_cam.astype(np.float64), axis=0)
    return node.summary.world_from_cam.apply(median[None])[0]


def _fit_vlad(nodes: Sequence[TopoNode]) -> SurfVlad:
    # Positions have no weight: they depend on the camera's position along the wall.
    config = VladConfig(position_weight=0.0)

    def described(row: int) -> Float32[np.ndarray, "n d"]:
        return append_positions(
            nodes[row].features, nodes[row].camera.width, nodes[row].camera.height, config
        )

    words = learn_words_from_parts([len(node.features) for node in nodes], described, config)
    return SurfVlad.fit(
        words,
        DiskList(vlad(described(row), words) for row in range(len(nodes))),
        np.arange(len(nodes)),
        config,
    )
