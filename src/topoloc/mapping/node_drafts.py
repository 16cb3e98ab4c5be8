"""Create nodes from frames: first measurements, observations in other images, and the refined
node."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Float32

from topoloc.disk_list import DiskList
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
from topoloc.mapping.storage.entries import NodeSummary, TopoNode
from topoloc.mapping.virtual_nodes import create_virtual_nodes
from topoloc.node_ids import NodeId, Row
from topoloc.recordings.frame_preparation import PreparedFrame
from topoloc.recordings.stored_images import encode_webp
from topoloc.retrieval.vlad import append_positions

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
