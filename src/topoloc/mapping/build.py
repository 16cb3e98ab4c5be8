"""Constructing the topo-metric map: section III-A of the paper, read from the top.

The trajectory is discretised into nodes (Eq. 1). Each node keeps its template image, its global pose, and its features
with their 3-D positions. All mapping images, labelled with their node, teach the coarse localizer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field

import cv2
import numpy as np

from topoloc.errors import EmptyMapError, TrajectoryError
from topoloc.features.extraction import FeatureConfig, extract_features
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.node_points import NodePointsConfig, locate_points
from topoloc.mapping.nodes import NodeConfig, label_frames, place_nodes
from topoloc.mapping.topomap import Edge, NodeSummary, PlaceImage, TopoMetricMap, TopoNode
from topoloc.mapping.views import MappingView, mapping_view
from topoloc.places.vlad import SurfVlad, VladConfig, learn_words, vlad
from topoloc.sequences.frame import Image, StereoSequence

Progress = Callable[[str, int, int], None]
"""Called with a stage's name, steps done and steps in all."""


@dataclass(frozen=True)
class BuildConfig:
    """All that decides what a map looks like; stored in the map."""

    nodes: NodeConfig = field(default_factory=NodeConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    points: NodePointsConfig = field(default_factory=NodePointsConfig)
    vlad: VladConfig = field(default_factory=VladConfig)
    max_node_points: int = 900
    """Features that a node keeps, the strongest ones."""
    min_node_points: int = 20
    """A picture with fewer located features becomes no node."""
    template_side_px: int = 320
    """Shorter side of the template picture that a node keeps, at most."""
    place_side_px: int = 160
    """Shorter side of the other mapping images, at most: what the coarse localizers of section III-B are trained with."""


@dataclass(frozen=True, eq=False)
class _MappingFrame:
    """A frame with a pose, not yet read."""

    sequence: StereoSequence
    index: int
    world_from_cam: Rigid3

    def view(self) -> MappingView:
        return mapping_view(self.sequence[self.index])

    @property
    def name(self) -> str:
        return self.sequence.names[self.index]


def build_map(sequences: StereoSequence | Sequence[StereoSequence], config: BuildConfig | None = None, progress: Progress | None = None) -> TopoMetricMap:
    """Build a topo-metric map from one or several recordings of one place whose poses share one world.

    Raises:
        TrajectoryError: no frame of a recording has a pose.
        EmptyMapError: no picture gave a usable node.
        RecordingError, CalibrationError, UnreadableImageError: from reading the recordings.
    """
    config = config or BuildConfig()
    progress = progress or (lambda stage, done, total: None)
    if isinstance(sequences, StereoSequence):
        sequences = [sequences]
    frames = [frame for sequence in sequences for frame in _posed_frames(sequence)]
    node_config = _resolve_node_config(frames, config)
    nodes = _make_nodes(frames, node_config, config, progress)
    place_images, coarse = _learn_places(frames, nodes, node_config, config, progress)
    return TopoMetricMap(
        summaries=[node.summary for node in nodes],
        nodes=nodes,
        edges=_edges_along([image.node_id for image in place_images]),
        place_images=place_images,
        coarse_models={SurfVlad.name: coarse.to_model()},
        config=asdict(config) | {"nodes": asdict(node_config)},
        length_m=_trajectory_length(frames),
    )


def _posed_frames(sequence: StereoSequence) -> list[_MappingFrame]:
    frames = [_MappingFrame(sequence, i, pose) for i, pose in enumerate(sequence.poses) if pose is not None]
    if not frames:
        raise TrajectoryError(f"{sequence.name}: no frame has a pose; give a trajectory (TUM or KITTI rows) of this recording")
    return frames


def _resolve_node_config(frames: list[_MappingFrame], config: BuildConfig) -> NodeConfig:
    """D_thresh from the scene, where the user named none."""
    if config.nodes.d_thresh is not None:
        return config.nodes.resolved(0.0)
    samples = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, 7).astype(int))]
    depths = []
    for frame in samples:
        view = frame.view()
        located = locate_points(extract_features(view.grey, config.features), view, config.points)
        depths.append(located.points_cam[located.valid, 2])
    all_depths = np.concatenate(depths)
    if len(all_depths) == 0:
        raise EmptyMapError(f"{frames[0].sequence.name}: no feature with a 3-D position in {len(samples)} pictures tried")
    return config.nodes.resolved(float(np.median(all_depths)))


def _make_nodes(frames: list[_MappingFrame], node_config: NodeConfig, config: BuildConfig, progress: Progress) -> list[TopoNode]:
    """The trajectory discretised by Eq. 1; a picture with too few points (dark, blurred, blank) becomes no node."""
    assignment = place_nodes([frame.world_from_cam for frame in frames], node_config)
    nodes: list[TopoNode] = []
    for done, frame_idx in enumerate(assignment.node_frame_idx):
        progress("nodes", done, len(assignment.node_frame_idx))
        node = _make_node(len(nodes), frames[frame_idx], config)
        if node is not None:
            nodes.append(node)
    progress("nodes", len(assignment.node_frame_idx), len(assignment.node_frame_idx))
    if not nodes:
        raise EmptyMapError(f"{frames[0].sequence.name}: no picture has {config.min_node_points} features with a 3-D position")
    return nodes


def _make_node(node_id: int, frame: _MappingFrame, config: BuildConfig) -> TopoNode | None:
    view = frame.view()
    features = extract_features(view.grey, config.features)
    located = locate_points(features, view, config.points)
    rows = np.flatnonzero(located.valid)[: config.max_node_points]
    if len(rows) < config.min_node_points:
        return None
    sqrt_covs = np.linalg.cholesky(located.covariances[rows])[:, *np.tril_indices(3)]
    return TopoNode(
        NodeSummary(node_id, frame.sequence.name, frame.name, frame.sequence.t_ns[frame.index], view.world_from_cam, len(rows)),
        view.camera,
        features.select(rows),
        located.points_cam[rows].astype(np.float32),
        sqrt_covs.astype(np.float32),
        _encode_jpeg(view.picture, config.template_side_px, quality=75),
    )


def _learn_places(
    frames: list[_MappingFrame], nodes: list[TopoNode], node_config: NodeConfig, config: BuildConfig, progress: Progress
) -> tuple[list[PlaceImage], SurfVlad]:
    """Label every mapping image with its nearest node, and teach the coarse localizer."""
    assert node_config.lambda_rot is not None
    node_ids = label_frames([f.world_from_cam for f in frames], [n.summary.world_from_cam for n in nodes], node_config.lambda_rot)
    words = learn_words(np.concatenate([node.features.descriptors for node in nodes]), config.vlad)
    images: list[PlaceImage] = []
    vlads = []
    for frame, node_id in zip(frames, node_ids, strict=True):
        progress("places", len(images), len(frames))
        view = frame.view()
        vlads.append(vlad(extract_features(view.grey, config.features).descriptors, words))
        jpeg = _encode_jpeg(view.picture, config.place_side_px, quality=70)
        images.append(PlaceImage(frame.sequence.name, frame.name, int(node_id), view.world_from_cam, jpeg))
    progress("places", len(frames), len(frames))
    return images, SurfVlad.fit(words, np.stack(vlads), node_ids, config.vlad)


def _edges_along(node_ids: Iterable[int]) -> list[Edge]:
    """An edge wherever the robot went from one node to another."""
    visited = list(node_ids)
    steps = {(a, b) for a, b in zip(visited, visited[1:], strict=False) if a != b}
    return [Edge(a, b) for a, b in sorted(steps)]


def _trajectory_length(frames: list[_MappingFrame]) -> float:
    steps = [
        float(np.linalg.norm(b.world_from_cam.translation - a.world_from_cam.translation))
        for a, b in zip(frames, frames[1:], strict=False)
        if a.sequence is b.sequence
    ]
    return sum(steps)


def _encode_jpeg(picture: Image, side_px: int, quality: int) -> bytes:
    """The picture as JPEG, its shorter side at most `side_px`."""
    scale = side_px / min(picture.shape[:2])
    if scale < 1.0:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    bgr = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
