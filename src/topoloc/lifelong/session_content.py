"""Create the content that a session adds to a map: new nodes, mapping images, and observations of
the existing nodes. Add the images to the map's coarse localizers.

k-NN localizers receive new vectors. Their vocabulary or network stays the same.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from topoloc.errors import MissingExtraError
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import position_covariance
from topoloc.lifelong.map_depth import MapPointLocator
from topoloc.lifelong.session_poses import SessionPoses
from topoloc.localization.result import Localization
from topoloc.mapping.config import Progress
from topoloc.mapping.landmarks import NODES_PER_IMAGE, Observations
from topoloc.mapping.mapping_frames import (
    MappingFrame,
    MappingImage,
    PointLocator,
    create_place_image,
    extract_mapping_image,
)
from topoloc.mapping.node_drafts import (
    MIN_NODE_POINTS,
    NodeDraft,
    create_node_draft,
    finish_node,
    observe_draft,
    observe_node,
)
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.sessions import Illumination
from topoloc.mapping.topomap import Layer, PlaceImage, TopoMetricMap, TopoNode
from topoloc.mapping.virtual_nodes import find_new_virtual_views
from topoloc.node_ids import NodeId, Row, as_rows
from topoloc.retrieval.coarse import CoarseModel, ExtendableLocalizer, open_coarse_localizer
from topoloc.retrieval.network_images import decode_stored_image
from topoloc.retrieval.vlad import SurfVlad

DescribedPlace = tuple[Features, Camera, NodeId]
"""The local features of a mapping image, its camera model, and the id of its node."""


def update_coarse_models(
    topomap: TopoMetricMap,
    views: Mapping[str, Sequence[DescribedPlace]],
    images: Sequence[PlaceImage],
) -> tuple[TopoMetricMap, list[str]]:
    """Return the map with new places added to its coarse localizers, and the names of those that
    were not updated.

    Localizers that use local features are extended with `views`, those that compare network
    descriptors with `images`. A localizer with one output per node (cnn-fc) cannot be extended,
    because it would need training. No network localizer is extended if PyTorch is missing. Raises
    MapError if a coarse localizer of the map, or an image, is damaged.
    """
    layers, not_updated = dict[str, Layer](), list[str]()
    for kind, layer in topomap.layers.items():
        models = dict(layer.coarse_models)
        for name, model in models.items():
            if name == SurfVlad.name:
                models[name] = _add_features(model, views.get(kind, []))
            elif images:
                extended = _add_images(model, images)
                models[name] = extended or model
                not_updated += [] if extended else [name]
        layers[kind] = replace(layer, coarse_models=models)
    return replace(topomap, layers=layers), sorted(not_updated)


def _add_features(model: CoarseModel, views: Sequence[DescribedPlace]) -> CoarseModel:
    if not views:
        return model
    described = [(features, camera.width, camera.height) for features, camera, _ in views]
    node_ids = np.array([node_id for *_, node_id in views])
    return SurfVlad.from_model(model).extend_with_features(described, node_ids).to_model()


def _add_images(model: CoarseModel, images: Sequence[PlaceImage]) -> CoarseModel | None:
    try:
        localizer = open_coarse_localizer(model)
    except MissingExtraError:
        return None
    if not isinstance(localizer, ExtendableLocalizer):
        return None
    return localizer.extend_with_images(
        [decode_stored_image(image.jpeg) for image in images],
        np.array([image.node_id for image in images]),
    )


@dataclass(frozen=True, eq=False)
class SessionContent:
    """Hold the new content of a session.

    This is: its nodes and places by feature type, its virtual nodes, its images with their nodes,
    its observations of existing nodes by feature type and row, and its illuminations.
    """

    nodes: dict[str, list[TopoNode]] = field(default_factory=dict)
    sides: list[TopoNode] = field(default_factory=list)
    images: list[PlaceImage] = field(default_factory=list)
    views: dict[str, list[DescribedPlace]] = field(default_factory=lambda: defaultdict(list))
    observations: dict[tuple[str, int], list[Observations]] = field(
        default_factory=lambda: defaultdict(list)
    )
    lights: list[Illumination] = field(default_factory=list)


def create_session_content(
    topomap: TopoMetricMap,
    frames: Sequence[MappingFrame],
    session_poses: SessionPoses,
    progress: Progress,
    learnt: Collection[int] = (),
) -> SessionContent:
    """Create the content of a session. Queried frames that the map localizes well observe its
    nodes. The others, and those in `learnt` (by index, `light_learning.py`), become nodes. Frames
    near a new node become mapping images."""
    config, content, d = topomap.config, SessionContent(), topomap.config.d_thresh
    by_index = {frame.index: frame for frame in frames}
    queried = {by_index[k]: one for k, one in session_poses.answers.items() if k in by_index}
    weak = [f for f, a in queried.items() if f.index in learnt or not is_well_localized(a, d)]
    drafts = _draft_nodes(topomap, MapPointLocator(frames, topomap, learnt), weak, progress)
    drafted = {draft.frame: draft.image for draft in drafts}
    covered = queried.keys() - drafted.keys()
    new = NodePoses.of([image.world_from_cam for image in drafted.values()])
    first_id = topomap.free_ids.node
    new_ids = [NodeId(first_id + k) for k in range(len(drafts))]
    for done, frame in enumerate(frames):
        to_old, to_new = (
            node_distances(frame.world_from_cam, nodes, config.lambda_rot)
            for nodes in (topomap.node_poses, new)
        )
        is_of_new = to_new.min(initial=np.inf) <= max(config.d_thresh, to_old.min())
        if is_of_new or frame in covered:
            image = drafted.get(frame) or extract_mapping_image(
                frame, frame.view(with_depth=False), config
            )
            content.lights.append(image.light)
            if frame in covered:
                nearest = as_rows(np.argsort(to_old, kind="stable")[:NODES_PER_IMAGE])
                _observe_map_nodes(topomap, frame, image, nearest, content)
            if is_of_new:
                for k in np.argsort(to_new, kind="stable")[:NODES_PER_IMAGE]:
                    if frame not in drafts[k].sources:
                        drafts[k].add(observe_draft(drafts[k], image, frame.session_id))
                node_id = new_ids[int(to_new.argmin())]
                content.images.append(create_place_image(frame, image, node_id))
                for kind, features in image.features.items():
                    content.views[kind].append((features, image.camera, node_id))
        progress(f"pictures of {frame.sequence.name}", done + 1, len(frames))
    for kind in topomap.kinds:
        content.nodes[kind] = [
            finish_node(node_id, draft, kind, 400 if draft.frame.index in learnt else 800)
            for node_id, draft in zip(new_ids, drafts, strict=True)
        ]
    content.sides.extend(
        replace(side, summary=replace(side.summary, of_node=node_id))
        for node_id, draft in zip(new_ids, drafts, strict=True)
        for side in draft.sides
    )
    return content


def _draft_nodes(
    topomap: TopoMetricMap,
    locator: PointLocator,
    frames: Sequence[MappingFrame],
    progress: Progress,
) -> list[NodeDraft]:
    """Draft a node for each frame with enough points."""
    virtual_view_rows = find_new_virtual_views(topomap, [frame.world_from_cam for frame in frames])
    drafts = list[NodeDraft]()
    for row, frame in enumerate(frames):
        has_virtual_views = row in virtual_view_rows
        draft = create_node_draft(frame, frame.view(), locator, has_virtual_views, topomap.config)
        if len(draft.points[topomap.kind].features) >= MIN_NODE_POINTS:
            drafts.append(draft)
        progress("new nodes", row + 1, len(frames))
    return drafts


def _observe_map_nodes(
    topomap: TopoMetricMap,
    frame: MappingFrame,
    image: MappingImage,
    nearest: Sequence[Row],
    content: SessionContent,
) -> None:
    """Add a frame's observations of the nearest existing nodes to `content`."""
    for row in nearest:
        cam_from_node = image.world_from_cam.inverse() @ topomap.summaries[row].world_from_cam
        for kind, features in image.features.items():
            node = topomap.layers[kind].nodes[row]
            seen = observe_node(node, features, image.camera, cam_from_node, frame.session_id)
            content.observations[kind, row].append(seen)


def is_well_localized(answer: Localization | None, d_thresh: float, min_inliers: int = 60) -> bool:
    """Return whether the map localizes an image well enough that it needs no node."""
    # Maximum position sigma of a well localized image, in D_thresh. Correlated errors of the
    # map's points are left out, because a node aligned by the map would share them.
    max_sigma = 0.3
    if answer is None or answer.num_inliers < min_inliers:
        return False
    noise = answer.noise_share * answer.camera_covariance
    at_camera = position_covariance(answer.world_from_cam.inverse(), noise)
    return float(np.sqrt(np.linalg.eigvalsh(at_camera)[-1])) <= max_sigma * d_thresh
