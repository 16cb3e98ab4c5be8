"""Build the topo-metric map (section III-A of the paper). Start reading at `build_node_map`.

The trajectory is discretised into nodes (Eq. 1). Each node keeps its template image, its global
pose, and its features with their 3-D positions. All mapping images, labelled with their node, train
the coarse localizer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from topoloc.bounds import check_bounds
from topoloc.compiled import parallel_map
from topoloc.disk_list import DiskList
from topoloc.errors import EmptyMapError
from topoloc.mapping.config import MapConfig, Progress
from topoloc.mapping.landmarks import NODES_PER_IMAGE, Observations
from topoloc.mapping.mapping_frames import (
    MappingFrame,
    MappingImage,
    PointLocator,
    compute_trajectory_length,
    connect_nodes,
    create_place_image,
    create_session,
    extract_mapping_image,
    prepare_view,
    select_posed_frames,
)
from topoloc.mapping.node_drafts import (
    MIN_NODE_POINTS,
    NodeDraft,
    NodeDrafts,
    collect_virtual_nodes,
    create_node_draft,
    finish_node,
    observe_draft,
    select_virtual_view_nodes,
)
from topoloc.mapping.nodes import NodeConfig, NodePoses, find_nearest_nodes, select_node_frames
from topoloc.mapping.storage.entries import (
    Edit,
    Illumination,
    Layer,
    PlaceImage,
    Session,
    TopoNode,
    today,
)
from topoloc.mapping.storage.schema import SCHEMA_VERSION
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import NodeId, Row, as_rows
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.recording import find_pose_source, read_left_frame
from topoloc.retrieval.coarse import CoarseModel
from topoloc.retrieval.vlad import SurfVlad, append_positions, learn_words_from_parts, vlad

BuildConfig = MapConfig


def build_node_map(
    sequences: StereoSequence | Sequence[StereoSequence],
    config: BuildConfig | None = None,
    progress: Progress | None = None,
    poses_from: Sequence[str] | None = None,
) -> TopoMetricMap:
    """Build a topo-metric map from one or several recordings of one place whose poses share one
    world.

    Args:
        sequences: the recordings.
        config: the settings. Defaults to `BuildConfig()`.
        progress: is called with a stage's name, steps done and all steps.
        poses_from: the source of each recording's poses (`truth`, `slam`, a file), which the map
            records. None detects it.

    Raises:
        ConfigError: a value of `config` is out of its bounds.
        TrajectoryError: no frame of a recording has a pose.
        EmptyMapError: no image gave a usable node.
        RecordingError, CalibrationError, UnreadableImageError: a recording cannot be read.
    """
    config = config or BuildConfig()
    check_bounds(config)
    config = replace(config, other_kinds=tuple(config.kinds[1:]))
    progress = progress or (lambda stage, done, total: None)
    sequences = [sequences] if isinstance(sequences, StereoSequence) else sequences
    frames = [
        frame
        for session_id, sequence in enumerate(sequences)
        for frame in select_posed_frames(sequence, session_id)
    ]
    locator = PointLocator(frames, config)
    config = replace(config, nodes=_resolve_node_config(frames, locator, config))
    drafts = _draft_nodes(frames, locator, config, progress)
    place_images, lights, models = _process_mapping_images(frames, drafts, config, progress)
    of_kind, sides = _finish_nodes(drafts, config)
    layers = {
        kind: Layer(nodes, {models[kind].name: models[kind]}) for kind, nodes in of_kind.items()
    }
    poses_from = poses_from or [find_pose_source(sequence) for sequence in sequences]
    sessions = list[Session]()
    for k, sequence in enumerate(sequences):
        rows = [row for row, frame in enumerate(frames) if frame.session_id == k]
        own, camera = [frames[row] for row in rows], drafts.cameras.get(k)
        own_lights = [lights[row] for row in rows]
        sessions.append(create_session(sequence, own, poses_from[k], camera, own_lights))
    return TopoMetricMap(
        summaries=[node.summary for node in of_kind[config.features.kind]],
        layers=layers,
        edges=sorted(connect_nodes(frames, [image.node_id for image in place_images])),
        place_images=place_images,
        config=config,
        length_m=compute_trajectory_length(frames),
        sides=collect_virtual_nodes(sides, config.virtual_view_type),
        sessions=sessions,
        edits=[Edit(1, "build", today(), SCHEMA_VERSION)],
    )


def _resolve_node_config(
    frames: list[MappingFrame], locator: PointLocator, config: BuildConfig
) -> NodeConfig:
    """Set D_thresh from the depth of the scene, if the user set none."""
    if config.nodes.d_thresh is not None:
        return config.nodes.resolved(0.0)
    samples = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, 7).astype(int))]
    first = replace(config, other_kinds=())

    def depths(read: tuple[MappingFrame, StereoFrame]) -> Float[np.ndarray, " n"]:
        frame, view = read[0], prepare_view(read[1])
        points, _ = locator.locate(frame, view, extract_mapping_image(frame, view, first))
        located = points[config.features.kind]
        return located.points_cam[located.valid, 2]

    all_depths = np.concatenate(list(locator.map_frames(depths, samples)))
    if len(all_depths) == 0:
        raise EmptyMapError(
            f"{frames[0].sequence.name}: no feature with a 3-D position in {len(samples)} pictures"
            f" tried{_why_unlocated(frames[0])}"
        )
    return config.nodes.resolved(float(np.median(all_depths)))


def _draft_nodes(
    frames: list[MappingFrame], locator: PointLocator, config: BuildConfig, progress: Progress
) -> NodeDrafts:
    """Discretise the trajectory by Eq. 1. Images with too few points (dark, blurred, blank) become
    no nodes."""
    poses = [frame.world_from_cam for frame in frames]
    chosen = [frames[i] for i in select_node_frames(poses, config.d_thresh, config.lambda_rot)]
    rows = select_virtual_view_nodes([frame.world_from_cam for frame in chosen], config)
    virtual_view_frames = {chosen[row] for row in rows}
    drafts = NodeDrafts(DiskList(shared_objects=frames))

    def make_draft(read: tuple[MappingFrame, StereoFrame]) -> NodeDraft:
        return create_node_draft(
            read[0], prepare_view(read[1]), locator, read[0] in virtual_view_frames, config
        )

    for done, draft in enumerate(locator.map_frames(make_draft, chosen)):
        if len(draft.points[config.features.kind].features) >= MIN_NODE_POINTS:
            drafts.append(draft)
        progress("nodes", done + 1, len(chosen))
    if not drafts.rows:
        raise EmptyMapError(
            f"{frames[0].sequence.name}: no picture has {MIN_NODE_POINTS} features with a"
            f" 3-D position{_why_unlocated(frames[0])}"
        )
    return drafts


def _why_unlocated(frame: MappingFrame) -> str:
    depth = frame.view().depth
    if depth is None or np.isfinite(depth).any():
        return ""
    return f"; depth is unknown (0) in all of {frame.name}, so record it again with depth"


def _process_mapping_images(
    frames: list[MappingFrame], drafts: NodeDrafts, config: BuildConfig, progress: Progress
) -> tuple[list[PlaceImage], list[Illumination], dict[str, CoarseModel]]:
    """Process every mapping image after the nodes are drafted.

    Each image is labelled with its nearest node and observes the points of near nodes. Its
    illumination is measured. Finally the coarse localizers of all feature types are fitted.
    """
    words = {
        kind: learn_words_from_parts(
            drafts.num_points[kind],
            lambda row, kind=kind: drafts.disk_list[row].vlad_descriptors(kind, config),
            config.vlad,
        )
        for kind in config.kinds
    }
    nodes = NodePoses.from_poses(drafts.world_from_nodes)
    images, lights = list[PlaceImage](), list[Illumination]()
    vlads = {kind: DiskList[np.ndarray]() for kind in config.kinds}
    cells = {kind: [] for kind in config.kinds}
    read = (  # feature extraction needs no right or depth image
        (frame, None if frame in drafts.rows else read_left_frame(frame.sequence, frame.index))
        for frame in frames
    )
    visits = parallel_map(lambda one: _observe_image(*one, drafts, nodes, words, config), read)
    for done, (frame, visit) in enumerate(zip(frames, visits, strict=True)):
        image, nearest, observations, own_vlads = visit
        for row, observed in observations.items():
            draft = drafts.disk_list[row]
            draft.add(observed)
            drafts.disk_list[row] = draft
        for kind, features in image.features.items():
            vlads[kind].append(own_vlads[kind])
            cells[kind].append(features.cells)
        images.append(create_place_image(frame, image, NodeId(nearest), done + 1))
        lights.append(image.light)
        progress("images", done + 1, len(frames))
    node_ids, models = np.array([image.node_id for image in images]), dict[str, CoarseModel]()
    for kind in config.kinds:
        vlad_config = config.vlad_config_for(kind)
        fitted = SurfVlad.fit(words[kind], vlads[kind], node_ids, vlad_config, cells[kind])
        models[kind] = fitted.to_model()
    return images, lights, models


def _observe_image(
    frame: MappingFrame,
    read: StereoFrame | None,
    drafts: NodeDrafts,
    nodes: NodePoses,
    words: dict[str, Float32[np.ndarray, "k d"]],
    config: BuildConfig,
) -> tuple[MappingImage, Row, dict[Row, dict[str, Observations]], dict[str, np.ndarray]]:
    """Process one mapping image. Changes no shared state, so several calls may run in parallel.
    `read` is None for a frame that is a node, whose features are known already.

    Return the image, the row of its nearest node, its observations of near nodes by row, and its
    VLADs by feature type.
    """
    image = (
        drafts.disk_list[drafts.rows[frame]].image
        if read is None
        else extract_mapping_image(frame, prepare_view(read, with_depth=False), config)
    )
    nearest = as_rows(
        find_nearest_nodes(image.world_from_cam, nodes, config.lambda_rot, NODES_PER_IMAGE)
    )
    around = {row: drafts.disk_list[row] for row in nearest}
    observed = {
        row: observe_draft(draft, image, frame.session_id)
        for row, draft in around.items()
        if frame not in draft.sources
    }
    size = image.camera.width, image.camera.height
    vlads = {
        kind: vlad(append_positions(of, *size, config.vlad_config_for(kind)), words[kind])
        for kind, of in image.features.items()
    }
    return image, nearest[0], observed, vlads


def _finish_nodes(
    drafts: NodeDrafts, config: BuildConfig
) -> tuple[dict[str, Sequence[TopoNode]], Sequence[TopoNode]]:
    """Return the nodes by feature type and all virtual nodes. Each draft is read once."""
    of_kind, sides = {kind: DiskList[TopoNode]() for kind in config.kinds}, DiskList[TopoNode]()

    def finish_nodes(row: Row) -> tuple[list[TopoNode], list[TopoNode]]:
        draft = drafts.disk_list[row]
        return [finish_node(NodeId(row), draft, kind) for kind in config.kinds], draft.sides

    for row, (nodes, of_node) in enumerate(
        parallel_map(finish_nodes, as_rows(range(len(drafts.disk_list))))
    ):
        for kind, node in zip(config.kinds, nodes, strict=True):
            of_kind[kind].append(node)
        for side in of_node:
            sides.append(replace(side, summary=replace(side.summary, of_node=NodeId(row))))
    return dict(of_kind), sides
