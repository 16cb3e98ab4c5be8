"""Constructing the topo-metric map: section III-A of the paper, read from the top.

The trajectory is discretised into nodes (Eq. 1). Each node keeps its template image, its global pose, and its features
with their 3-D positions. All mapping images, labelled with their node, teach the coarse localizer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float32

from topoloc.bounds import check_bounds
from topoloc.errors import EmptyMapError
from topoloc.features.kinds import find_kind
from topoloc.geometry.camera import Camera
from topoloc.map.config import MapConfig
from topoloc.map.drafts import Drafts, draft_node, finish_node, observe
from topoloc.map.entries import Edge, PlaceImage, TopoNode
from topoloc.map.mapping_frames import MappingFrame, PointLocator, mapping_image, posed_frames
from topoloc.map.nodes import NearestNodes, NodeConfig, NodePoses, place_nodes
from topoloc.map.schema import SCHEMA_VERSION
from topoloc.map.sessions import Edit, Light, Session, mean_light, path_of, poses_source_of, today
from topoloc.map.side_nodes import gather_sides, nodes_with_sides
from topoloc.map.topomap import TopoMetricMap
from topoloc.places.coarse import CoarseModel
from topoloc.places.vlad import SurfVlad, learn_words_of, placed, vlad
from topoloc.sequences.frame import StereoSequence
from topoloc.sequences.frame_view import FrameView
from topoloc.shelf import Shelf

BuildConfig = MapConfig
Progress = Callable[[str, int, int], None]
"""Called with a stage's name, steps done and steps in all."""


def build_map(
    sequences: StereoSequence | Sequence[StereoSequence],
    config: BuildConfig | None = None,
    progress: Progress | None = None,
    poses_from: Sequence[str] | None = None,
) -> TopoMetricMap:
    """Build a topo-metric map from one or several recordings of one place whose poses share one world.

    Args:
        poses_from: where the poses of each recording come from (`truth`, `slam`, a file), for the map to remember; else what is
            known of that.

    Raises:
        ConfigError: a value of `config` is out of its bounds.
        TrajectoryError: no frame of a recording has a pose.
        EmptyMapError: no picture gave a usable node.
        RecordingError, CalibrationError, UnreadableImageError: from reading the recordings.
    """
    config = config or BuildConfig()
    check_bounds(config)
    config = replace(config, other_kinds=tuple(config.kinds[1:]))
    progress = progress or (lambda stage, done, total: None)
    sequences = [sequences] if isinstance(sequences, StereoSequence) else sequences
    frames = [frame for session_id, sequence in enumerate(sequences) for frame in posed_frames(sequence, session_id)]
    locator = PointLocator(frames, config)
    node_config = _resolve_node_config(frames, locator, config)
    drafts = _draft_nodes(frames, locator, node_config, config, progress)
    place_images, lights, coarse = _visit_all_images(frames, drafts, node_config, config, progress)
    of_kind, sides = _finished(drafts, config)
    nodes = of_kind.pop(config.features.kind)
    poses_from = poses_from or [poses_source_of(sequence) for sequence in sequences]
    return TopoMetricMap(
        summaries=[node.summary for node in nodes],
        nodes=nodes,
        edges=_edges_along(frames, [image.node_id for image in place_images]),
        place_images=place_images,
        coarse_models={model.name: model for model in coarse},
        config=replace(config, nodes=node_config),
        length_m=_trajectory_length(frames),
        sides=gather_sides(sides, config.kind_of_sides, config.sides),
        sessions=[_session(k, sequence, frames, lights, poses_from[k], drafts.cameras) for k, sequence in enumerate(sequences)],
        edits=[Edit(1, "build", today(), SCHEMA_VERSION)],
        other_kinds=of_kind,
    )


def _session(
    session_id: int,
    sequence: StereoSequence,
    frames: list[MappingFrame],
    lights: list[Light],
    poses_from: str,
    cameras: dict[int, Camera],
) -> Session:
    """What the map remembers of a recording; `lights` are those of the frames, `cameras` those of the sessions."""
    of_session = [k for k, frame in enumerate(frames) if frame.session_id == session_id]
    t_ns = [frames[k].t_ns for k in of_session]
    light = mean_light([lights[k] for k in of_session])
    camera = cameras.get(session_id)
    return Session(session_id, sequence.name, path_of(sequence), poses_from, min(t_ns), max(t_ns), camera, light)


def _resolve_node_config(frames: list[MappingFrame], locator: PointLocator, config: BuildConfig) -> NodeConfig:
    """D_thresh from the scene, where the user named none."""
    if config.nodes.d_thresh is not None:
        return config.nodes.resolved(0.0)
    samples = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, 7).astype(int))]
    depths = []
    for frame in samples:
        view, first = frame.view(), replace(config, other_kinds=())
        located = locator.locate(frame, view, mapping_image(frame, view, first))[0][config.features.kind]
        depths.append(located.points_cam[located.valid, 2])
    all_depths = np.concatenate(depths)
    if len(all_depths) == 0:
        raise EmptyMapError(f"{frames[0].sequence.name}: no feature with a 3-D position in {len(samples)} pictures tried")
    return config.nodes.resolved(float(np.median(all_depths)))


def _draft_nodes(
    frames: list[MappingFrame], locator: PointLocator, node_config: NodeConfig, config: BuildConfig, progress: Progress
) -> Drafts:
    """The trajectory discretised by Eq. 1; a picture with too few points (dark, blurred, blank) becomes no node."""
    frame_idx = place_nodes([frame.world_from_cam for frame in frames], node_config)
    kind = find_kind(config.features.kind)
    with_sides = nodes_with_sides([frames[i].world_from_cam for i in frame_idx], node_config, config.sides)
    drafts = Drafts(Shelf(by_reference=frames))
    for done, i in enumerate(frame_idx):
        draft = draft_node(frames[i], locator, done in with_sides, config)
        if len(draft.points[kind.name].features) >= config.min_node_points:
            drafts.append(draft)
        progress("nodes", done + 1, len(frame_idx))
    if not drafts.rows:
        raise EmptyMapError(f"{frames[0].sequence.name}: no picture has {config.min_node_points} features with a 3-D position")
    return drafts


def _visit_all_images(
    frames: list[MappingFrame], drafts: Drafts, node_config: NodeConfig, config: BuildConfig, progress: Progress
) -> tuple[list[PlaceImage], list[Light], list[CoarseModel]]:
    """Label every mapping image with its nearest node, let it observe the points of the nodes around, and teach the
    coarse localizer of each kind of features with it; its light is measured on the way."""
    assert node_config.lambda_rot is not None
    words = {kind: _words(drafts, kind, config) for kind in config.kinds}
    nodes = NearestNodes(NodePoses.of(drafts.world_from_nodes), node_config.lambda_rot)
    images: list[PlaceImage] = []
    lights, vlads, cells = [], {kind: Shelf[np.ndarray]() for kind in config.kinds}, {kind: [] for kind in config.kinds}
    for done, (frame, view) in enumerate(_read_ahead(frames, drafts)):
        image = drafts.image(frame) if view is None else mapping_image(frame, view, config)
        nearest = nodes.rows(image.world_from_cam, max(1, config.landmarks.nodes_per_image)).tolist()
        for row in nearest[: config.landmarks.nodes_per_image]:
            draft = drafts.shelf[row]
            if frame not in draft.sources:
                observe(draft, image, frame.session_id, config)
                drafts.shelf[row] = draft
        for kind, features in image.features.items():
            described = placed(features, image.camera.width, image.camera.height, config.vlad_of(kind))
            vlads[kind].append(vlad(described, words[kind]))
            cells[kind].append(features.cells)
        of_image = (nearest[0], image.world_from_cam, image.place_jpeg, frame.session_id, done + 1)
        images.append(PlaceImage(frame.sequence.name, frame.name, *of_image))
        lights.append(image.light)
        progress("images", done + 1, len(frames))
    node_ids = np.array([image.node_id for image in images])
    learnt = {kind: (words[kind], vlads[kind], node_ids, config.vlad_of(kind), cells[kind]) for kind in config.kinds}
    first, models = config.features.kind, {kind: SurfVlad.fit(*of_kind).to_model() for kind, of_kind in learnt.items()}
    return images, lights, [model if kind == first else replace(model, name=f"{model.name}@{kind}") for kind, model in models.items()]


def _read_ahead(frames: list[MappingFrame], drafts: Drafts) -> Iterator[tuple[MappingFrame, FrameView | None]]:
    """The frames, each read while the one before is worked on; None of those that are nodes: they are known already."""
    with ThreadPoolExecutor(max_workers=1) as reader:

        def begin(frame: MappingFrame) -> Future[FrameView | None]:
            return reader.submit(lambda: None if frame in drafts.rows else frame.view(with_depth=False))

        coming = begin(frames[0])
        for frame, after in zip(frames, [*frames[1:], None], strict=True):
            view = coming.result()
            if after is not None:
                coming = begin(after)
            yield frame, view


def _words(drafts: Drafts, kind: str, config: BuildConfig) -> Float32[np.ndarray, "k d"]:
    return learn_words_of(drafts.num_points[kind], lambda row: drafts.shelf[row].described(kind, config), config.vlad)


def _finished(drafts: Drafts, config: BuildConfig) -> tuple[dict[str, Sequence[TopoNode]], Sequence[TopoNode]]:
    """The nodes by their kinds of features, and all side nodes; each draft is looked at once."""
    of_kind, sides = {kind: Shelf[TopoNode]() for kind in config.kinds}, Shelf[TopoNode]()
    for node_id, draft in enumerate(drafts.shelf):
        for kind, nodes in of_kind.items():
            nodes.append(finish_node(node_id, draft, kind, config))
        for side in draft.sides:
            sides.append(replace(side, summary=replace(side.summary, of_node=node_id)))
    return dict(of_kind), sides


def _edges_along(frames: list[MappingFrame], node_ids: list[int]) -> list[Edge]:
    """An edge wherever a recording went from one node to another."""
    steps = pairwise(zip(frames, node_ids, strict=True))
    edges = {(source, target) for (a, source), (b, target) in steps if a.sequence is b.sequence and source != target}
    return [Edge(source, target) for source, target in sorted(edges)]


def _trajectory_length(frames: list[MappingFrame]) -> float:
    steps = [b.world_from_cam.translation - a.world_from_cam.translation for a, b in pairwise(frames) if a.sequence is b.sequence]
    return float(sum(np.linalg.norm(step) for step in steps))
