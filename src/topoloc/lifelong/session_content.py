"""Create the content that a session adds to a map: new nodes, mapping images, and observations of
the existing nodes. Add the images to the map's coarse localizers.

k-NN localizers receive new vectors. Their vocabulary or network stays the same.

Images of a single camera that are metres apart triangulate few points. But the map knows the
surfaces that they show, in whatever light. A feature lies at the depth of the landmarks that are
projected beside it, and its descriptor is that of the new light.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from topoloc.errors import MissingExtraError
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import points_from_depth
from topoloc.geometry.rigid import position_covariance
from topoloc.lifelong.session_poses import SessionPoses
from topoloc.localization.pose_fit import LocalMap
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
    find_new_virtual_views,
    finish_node,
    observe_draft,
    observe_node,
)
from topoloc.mapping.nodes import NodePoses, find_nearest_nodes, node_distances
from topoloc.mapping.storage.entries import Illumination
from topoloc.mapping.topomap import Layer, PlaceImage, TopoMetricMap, TopoNode
from topoloc.node_ids import NodeId, Row, as_rows
from topoloc.points.metric_points import MetricPoints, keypoint_sigmas, select_certain_points
from topoloc.recordings.frame_preparation import PreparedFrame
from topoloc.recordings.stored_images import decode_stored_image
from topoloc.retrieval.coarse import CoarseModel, ExtendableLocalizer, open_coarse_localizer
from topoloc.retrieval.vlad import SurfVlad


class MapPointLocator(PointLocator):
    """Locate the features of mapping frames in 3-D. What a single camera cannot triangulate in the
    images `learnt` (by index) is located by the landmarks of `topomap`."""

    MIN_IMAGES = 2  # so that a session with wrong poses adds nothing

    def __init__(
        self, frames: Sequence[MappingFrame], topomap: TopoMetricMap, learnt: Collection[int]
    ) -> None:
        super().__init__(frames, topomap.config)
        self._topomap, self._learnt = topomap, learnt

    def locate(
        self, frame: MappingFrame, view: PreparedFrame, image: MappingImage
    ) -> tuple[dict[str, MetricPoints], list[MappingFrame]]:
        """Return as `PointLocator.locate`."""
        located, others = super().locate(frame, view, image)
        is_single = view.right_grey is None and view.depth is None
        if is_single and frame.index in self._learnt:
            landmarks = _project_landmarks(self._topomap, image)
            for kind, features in image.features.items():
                own, by_map = located[kind], _locate_beside(landmarks, features, image)
                located[kind] = MetricPoints(
                    np.where(own.valid[:, None], own.points_cam, by_map.points_cam),
                    np.where(own.valid[:, None, None], own.covariances, by_map.covariances),
                    own.valid | by_map.valid,
                )
        return located, others


def _project_landmarks(topomap: TopoMetricMap, image: MappingImage) -> Float[np.ndarray, "m 4"]:
    """Return the pixel, the inverse depth (1/m) and its standard deviation of each landmark of the
    nearest nodes that an image shows."""
    num_nodes, min_depth, pose, config = 4, 0.1, image.world_from_cam, topomap.config
    nearest = as_rows(find_nearest_nodes(pose, topomap.node_poses, config.lambda_rot, num_nodes))
    shown = list[np.ndarray]()
    for node in (layer.nodes[row] for layer in topomap.layers.values() for row in nearest):
        known, axis = LocalMap.of_node(node), pose.rotation[:, 2]
        points = pose.inverse().apply(known.points_world)
        pixels, sigmas = image.camera.img_from_cam(points), np.sqrt(known.covariances @ axis @ axis)
        rows = (points[:, 2] > min_depth) & image.camera.is_in_image(pixels)
        z = points[rows, 2:]
        shown.append(np.hstack([pixels[rows], 1.0 / z, sigmas[rows, None] / z**2]))
    return np.concatenate(shown)


def _locate_beside(
    landmarks: Float[np.ndarray, "m 4"], features: Features, image: MappingImage
) -> MetricPoints:
    """Return the positions of an image's features (camera frame, metres) by its `landmarks`. They
    are invalid where landmarks are few or lie on several surfaces."""
    num_beside, radius_px, floor = 10, 25.0, 0.01  # floor: relative sigma of a depth, at least
    points_img, inverse = features.points_img.astype(np.float64), np.full(len(features), np.nan)
    spread = inverse
    if len(landmarks) > num_beside and len(features):
        offsets = landmarks[None, :, :2] - points_img[:, None]
        nearest = np.argpartition((offsets**2).sum(axis=2), num_beside, axis=1)[:, :num_beside]
        offsets = np.take_along_axis(offsets, nearest[:, :, None], axis=1)
        radii = offsets / (radius_px * image.camera.radius_scale)
        inverse, spread = _fit_surfaces(radii, landmarks[nearest, 2], landmarks[nearest, 3])
    points_cam = points_from_depth(points_img, 1.0 / inverse, image.camera)
    sigma_z = np.hypot(spread, floor * inverse) / inverse**2
    return select_certain_points(points_cam, sigma_z, image.camera, keypoint_sigmas(features))


def _fit_surfaces(
    offsets: Float[np.ndarray, "n k 2"],
    inverse_depths: Float[np.ndarray, "n k"],
    sigmas: Float[np.ndarray, "n k"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Fit a plane to the landmarks beside each feature. Return its inverse depth (1/m) at the
    feature, NaN without a surface, and the spread of the landmarks around it.

    `offsets` are pixels from the feature, in radii: landmarks outside of the circle do not count.
    The inverse depth of a plane is linear in the pixels.
    """
    # The largest spread of one surface, a landmark's sigma beyond its own, and the usual change of
    # the inverse depth within the radius: relative to the inverse depth.
    max_spread, own_sigma, slope = 0.06, 0.02, 0.2
    gate, min_beside, min_share = 3.0, 4, 0.7  # sigmas; landmarks on the surface, and their share
    squares = (offsets**2).sum(axis=2)
    is_near = agrees = squares < 1.0
    num_near = is_near.sum(axis=1)
    mean = (is_near * inverse_depths).sum(axis=1) / np.maximum(num_near, 1) + 1e-9
    sigmas = np.hypot(sigmas, own_sigma * mean[:, None])
    design = np.concatenate([np.ones_like(squares)[..., None], offsets], axis=2)
    prior = np.diag([1e-9, slope**-2, slope**-2]) / mean[:, None, None] ** 2
    fit, residuals = np.zeros((len(mean), 3, 1)), inverse_depths
    for _ in range(3):
        weights = agrees * np.exp(-2.0 * squares) / sigmas**2
        weighted = design.transpose(0, 2, 1) * weights[:, None]
        fit = np.linalg.solve(weighted @ design + prior, weighted @ inverse_depths[..., None])
        residuals = inverse_depths - (design @ fit)[..., 0]
        agrees = is_near & (np.abs(residuals) < gate * sigmas)
    num, inverse = agrees.sum(axis=1), fit[:, 0, 0]
    spread = np.sqrt((agrees * residuals**2).sum(axis=1) / np.maximum(num - 1, 1))
    is_surface = (num >= min_beside) & (num > min_share * num_near) & (inverse > 0.0)
    return np.where(is_surface & (spread < max_spread * inverse), inverse, np.nan), spread


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
    nodes. The others, and those in `learnt` (by index, `update.py`), become nodes. Frames
    near a new node become mapping images."""
    config, content, d = topomap.config, SessionContent(), topomap.config.d_thresh
    by_index = {frame.index: frame for frame in frames}
    queried = {by_index[k]: one for k, one in session_poses.answers.items() if k in by_index}
    weak = [f for f, a in queried.items() if f.index in learnt or not is_well_localized(a, d)]
    drafts = _draft_nodes(topomap, MapPointLocator(frames, topomap, learnt), weak, progress)
    drafted = {draft.frame: draft.image for draft in drafts}
    covered = queried.keys() - drafted.keys()
    new = NodePoses.from_poses([image.world_from_cam for image in drafted.values()])
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
