"""Create nodes from frames: first measurements, observations in other images, and the refined
node. Create virtual nodes from the walls beside the trajectory, for queries in the reverse
direction.

A node's points are found again only from similar directions. Its image also shows the walls on the
left and right at a slant. `features/extraction.py` renders them as seen from the front. Selected
nodes therefore get up to two virtual cameras at the same place that look to the sides, with their
own features and points. They are not nodes of Eq. 1. The localizer uses them only if nothing else
gives a pose (`localization/walls/`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Float32

from topoloc.disk_list import DiskList
from topoloc.features.extraction import FeatureConfig, extract_features, make_virtual_views
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.config import MapConfig
from topoloc.mapping.landmarks import (
    Observations,
    compute_session_statistics,
    observe_points,
    refine_points,
)
from topoloc.mapping.mapping_frames import MappingFrame, MappingImage, PointLocator, encode_small
from topoloc.mapping.nodes import NodePoses, select_node_frames
from topoloc.mapping.storage.entries import NodeSummary, TopoNode, VirtualNodes
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import NodeId, Row, as_rows
from topoloc.points.metric_points import locate_points
from topoloc.recordings.frame_preparation import PreparedFrame
from topoloc.recordings.stored_images import encode_webp
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
    poses, reach = NodePoses.from_poses(world_from_nodes), max_opposite * config.d_thresh
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


MIN_NODE_POINTS = 20  # an image with fewer located features becomes no node


@dataclass(frozen=True, eq=False)
class DraftPoints:
    """Hold a draft node's points as first measured, and their observations in other images so
    far."""

    features: Features
    points_cam: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    observations: list[Observations]


@dataclass(frozen=True, eq=False)
class NodeDraft:
    """Hold a draft node with its points by feature type. `summary` has no id and no points yet.
    `sources` are the frames that measured or observed them so far."""

    summary: NodeSummary
    frame: MappingFrame
    image: MappingImage
    template_image: bytes
    points: dict[str, DraftPoints]
    sides: list[TopoNode]
    sources: list[MappingFrame]
    raw_camera: Camera

    def add(self, observed: dict[str, Observations]) -> None:
        """Add the observations of one more image (`observe_draft`)."""
        for kind, observations in observed.items():
            self.points[kind].observations.append(observations)

    def vlad_descriptors(self, kind: str, config: MapConfig) -> Float32[np.ndarray, "n d"]:
        """Return the descriptors of a feature type for the coarse localizer
        (`append_positions`)."""
        return append_positions(
            self.points[kind].features,
            self.image.camera.width,
            self.image.camera.height,
            config.vlad_config_for(kind),
        )


@dataclass(frozen=True, eq=False)
class NodeDrafts:
    """Hold the draft nodes of a map by row. Most of them are on disk (`disk_list`).

    `rows` holds the row of each frame that is a node. `cameras` holds the first camera of each
    session, before rectification. `num_points` holds the number of points of each node, by feature
    type.
    """

    disk_list: DiskList[NodeDraft]
    world_from_nodes: list[Rigid3] = field(default_factory=list)
    rows: dict[MappingFrame, Row] = field(default_factory=dict)
    cameras: dict[int, Camera] = field(default_factory=dict)
    num_points: dict[str, list[int]] = field(default_factory=dict)

    def append(self, draft: NodeDraft) -> None:
        """Add a draft as the last row."""
        self.rows[draft.frame] = Row(len(self.disk_list))
        self.world_from_nodes.append(draft.image.world_from_cam)
        self.cameras.setdefault(draft.frame.session_id, draft.raw_camera)
        for kind, points in draft.points.items():
            self.num_points.setdefault(kind, []).append(len(points.features))
        self.disk_list.append(draft)


def create_node_draft(
    frame: MappingFrame,
    view: PreparedFrame,
    locator: PointLocator,
    has_virtual_views: bool,
    config: MapConfig,
) -> NodeDraft:
    """Create a draft node from a frame. `view` is the prepared frame."""
    image = locator.image(frame, view)
    located, sources = locator.locate(frame, view, image)
    points = {}
    for kind, features in image.features.items():
        rows = np.flatnonzero(located[kind].valid)
        positions, covariances = located[kind].points_cam[rows], located[kind].covariances[rows]
        points[kind] = DraftPoints(features.select(rows), positions, covariances, [])
    # correlation needs 400 pixels; as WebP they take little more than 240 as JPEG
    template_image = encode_small(view.picture, 400, partial(encode_webp, quality=70))
    summary = NodeSummary(
        NodeId(-1),
        frame.sequence.name,
        frame.name,
        frame.t_ns,
        image.world_from_cam,
        0,
        frame.session_id,
    )
    sides = (
        create_virtual_nodes(summary, view, config.feature_config_for(config.virtual_view_type))
        if has_virtual_views and (not sources or view.depth is not None)
        else []
    )
    raw_camera = view.raw_camera or image.camera
    draft = NodeDraft(
        summary, frame, image, template_image, points, sides, [frame, *sources], raw_camera
    )
    for source in sources if view.depth is not None else []:
        draft.add(observe_draft(draft, locator.image_of(source), frame.session_id))
    return draft


def observe_draft(
    draft: NodeDraft, image: MappingImage, session_id: int
) -> dict[str, Observations]:
    """Return an image's observations of a draft's points, by feature type."""
    cam_from_node = image.world_from_cam.inverse() @ draft.image.world_from_cam
    observed = {}
    for kind, features in image.features.items():
        points = draft.points[kind]
        known = points.features, points.points_cam, points.covariances
        observed[kind] = observe_points(*known, features, image.camera, cam_from_node, session_id)
    return observed


def observe_node(
    node: TopoNode, features: Features, camera: Camera, cam_from_node: Rigid3, session_id: int = 0
) -> Observations:
    """Search an image of `camera` for a finished node's landmarks near their projections. See
    `observe_points`. `features` are the image's, of the node's feature type."""
    roots = np.zeros((len(node.features), 3, 3))
    roots[:, *np.tril_indices(3)] = node.point_sqrt_covs
    known = (node.features, node.points_cam.astype(np.float64), roots @ roots.transpose(0, 2, 1))
    return observe_points(*known, features, camera, cam_from_node, session_id)


def finish_node(node_id: NodeId, draft: NodeDraft, kind: str, max_points: int = 800) -> TopoNode:
    """Refine the points of a feature type and return the node. Points observed again are preferred,
    then the strongest. At most `max_points` are kept."""
    points, first = draft.points[kind], draft.summary
    refined = refine_points(points.points_cam, points.covariances, points.observations)
    rows = np.flatnonzero(refined.is_consistent)
    best = np.argsort(-np.minimum(refined.num_observations[rows], 2), kind="stable")[:max_points]
    rows = np.sort(rows[best])
    sqrt_covs = np.linalg.cholesky(refined.covariances[rows])[:, *np.tril_indices(3)]
    session_statistics = compute_session_statistics(
        refined.points_cam,
        points.points_cam,
        points.covariances,
        points.observations,
        rows,
        first.session_id,
    )
    return TopoNode(
        replace(first, node_id=node_id, num_points=len(rows)),
        draft.image.camera,
        points.features.select(rows),
        refined.points_cam[rows].astype(np.float32),
        sqrt_covs.astype(np.float32),
        draft.template_image,
        session_statistics,
    )
