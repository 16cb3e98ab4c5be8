"""Constructing the topo-metric map: section III-A of the paper, read from the top.

The trajectory is discretised into nodes (Eq. 1). Each node keeps its template image, its global
pose, and its features with their 3-D positions. All mapping images, labelled with their node, teach
the coarse localizer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32

from topoloc.bounds import check_bounds
from topoloc.errors import EmptyMapError
from topoloc.features.bands import in_order
from topoloc.features.kinds import find_kind
from topoloc.geometry.camera import Camera
from topoloc.mapping.config import MapConfig
from topoloc.mapping.drafts import Drafts, NodeDraft, draft_node, finish_node, observe
from topoloc.mapping.entries import Edge, PlaceImage, TopoNode
from topoloc.mapping.landmarks import Observations
from topoloc.mapping.mapping_frames import (
    MappingFrame,
    MappingImage,
    PointLocator,
    mapping_image,
    posed_frames,
    view_of,
)
from topoloc.mapping.nodes import NearestNodes, NodeConfig, NodePoses, place_nodes
from topoloc.mapping.schema import SCHEMA_VERSION
from topoloc.mapping.sessions import (
    Edit,
    Light,
    Session,
    mean_light,
    path_of,
    poses_source_of,
    today,
)
from topoloc.mapping.side_nodes import gather_sides, nodes_with_sides
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.retrieval.coarse import CoarseModel
from topoloc.retrieval.vlad import SurfVlad, learn_words_of, placed, vlad
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
    """Build a topo-metric map from one or several recordings of one place whose poses share one
    world.

    Args:
        poses_from: where the poses of each recording come from (`truth`, `slam`, a file), for the
            map to remember; else what is known of that.

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
    frames = [
        frame
        for session_id, sequence in enumerate(sequences)
        for frame in posed_frames(sequence, session_id)
    ]
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
        sessions=[
            _session(k, sequence, frames, lights, poses_from[k], drafts.cameras)
            for k, sequence in enumerate(sequences)
        ],
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
    """What the map remembers of a recording; `lights` are those of the frames, `cameras` those of
    the sessions."""
    of_session = [k for k, frame in enumerate(frames) if frame.session_id == session_id]
    t_ns = [frames[k].t_ns for k in of_session]
    light = mean_light([lights[k] for k in of_session])
    camera = cameras.get(session_id)
    return Session(
        session_id,
        sequence.name,
        path_of(sequence),
        poses_from,
        min(t_ns),
        max(t_ns),
        camera,
        light,
    )


def _resolve_node_config(
    frames: list[MappingFrame], locator: PointLocator, config: BuildConfig
) -> NodeConfig:
    """D_thresh from the scene, where the user named none."""
    if config.nodes.d_thresh is not None:
        return config.nodes.resolved(0.0)
    samples, first = (
        [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, 7).astype(int))],
        replace(config, other_kinds=()),
    )

    def depths(read: tuple[MappingFrame, StereoFrame]) -> Float[np.ndarray, " n"]:
        frame, view = read[0], view_of(read[1])
        located = locator.locate(frame, view, mapping_image(frame, view, first))[0][
            config.features.kind
        ]
        return located.points_cam[located.valid, 2]

    all_depths = np.concatenate(list(locator.for_each(depths, samples)))
    if len(all_depths) == 0:
        raise EmptyMapError(
            f"{frames[0].sequence.name}: no feature with a 3-D position in {len(samples)} pictures"
            " tried"
        )
    return config.nodes.resolved(float(np.median(all_depths)))


def _draft_nodes(
    frames: list[MappingFrame],
    locator: PointLocator,
    node_config: NodeConfig,
    config: BuildConfig,
    progress: Progress,
) -> Drafts:
    """The trajectory discretised by Eq. 1; a picture with too few points (dark, blurred, blank)
    becomes no node."""
    chosen = [
        frames[i] for i in place_nodes([frame.world_from_cam for frame in frames], node_config)
    ]
    kind = find_kind(config.features.kind)
    rows = nodes_with_sides([frame.world_from_cam for frame in chosen], node_config, config.sides)
    with_sides = {chosen[row] for row in rows}
    drafts = Drafts(Shelf(by_reference=frames))

    def draft_of(read: tuple[MappingFrame, StereoFrame]) -> NodeDraft:
        return draft_node(read[0], view_of(read[1]), locator, read[0] in with_sides, config)

    for done, draft in enumerate(locator.for_each(draft_of, chosen)):
        if len(draft.points[kind.name].features) >= config.min_node_points:
            drafts.append(draft)
        progress("nodes", done + 1, len(chosen))
    if not drafts.rows:
        raise EmptyMapError(
            f"{frames[0].sequence.name}: no picture has {config.min_node_points} features with a"
            " 3-D position"
        )
    return drafts


def _visit_all_images(
    frames: list[MappingFrame],
    drafts: Drafts,
    node_config: NodeConfig,
    config: BuildConfig,
    progress: Progress,
) -> tuple[list[PlaceImage], list[Light], list[CoarseModel]]:
    """Label every mapping image with its nearest node, let it observe the points of the nodes
    around, and teach the coarse localizer of each kind of features with it; its light is measured
    on the way."""
    assert node_config.lambda_rot is not None
    words = {kind: _words(drafts, kind, config) for kind in config.kinds}
    nodes = NearestNodes(NodePoses.of(drafts.world_from_nodes), node_config.lambda_rot)
    images: list[PlaceImage] = []
    lights, vlads, cells = (
        [],
        {kind: Shelf[np.ndarray]() for kind in config.kinds},
        {kind: [] for kind in config.kinds},
    )
    read = ((frame, None if frame in drafts.rows else frame.read_left()) for frame in frames)
    visits = in_order(lambda one: _visit(*one, drafts, nodes, words, config), read)
    for done, (frame, visit) in enumerate(zip(frames, visits, strict=True)):
        for row, observed in visit.observed.items():
            draft = drafts.shelf[row]
            draft.add(observed)
            drafts.shelf[row] = draft
        image = visit.image
        for kind, features in image.features.items():
            vlads[kind].append(visit.vlads[kind])
            cells[kind].append(features.cells)
        of_image = (
            visit.nearest,
            image.world_from_cam,
            image.place_jpeg,
            frame.session_id,
            done + 1,
        )
        images.append(PlaceImage(frame.sequence.name, frame.name, *of_image))
        lights.append(image.light)
        progress("images", done + 1, len(frames))
    node_ids = np.array([image.node_id for image in images])
    learnt = {
        kind: (words[kind], vlads[kind], node_ids, config.vlad_of(kind), cells[kind])
        for kind in config.kinds
    }
    first, models = (
        config.features.kind,
        {kind: SurfVlad.fit(*of_kind).to_model() for kind, of_kind in learnt.items()},
    )
    return (
        images,
        lights,
        [
            model if kind == first else replace(model, name=f"{model.name}@{kind}")
            for kind, model in models.items()
        ],
    )


@dataclass(frozen=True, eq=False)
class _Visit:
    """What a mapping image gives: its nearest node's row, what it sees of the nodes around, by
    their rows, and its VLADs by kind."""

    image: MappingImage
    nearest: int
    observed: dict[int, dict[str, Observations]]
    vlads: dict[str, Float32[np.ndarray, " v"]]


def _visit(
    frame: MappingFrame,
    read: StereoFrame | None,
    drafts: Drafts,
    nodes: NearestNodes,
    words: dict[str, Float32[np.ndarray, "k d"]],
    config: BuildConfig,
) -> _Visit:
    """`read` is None for a frame that is a node: what it shows is known already. Changes nothing,
    so that several may run at a time."""
    image = (
        drafts.image(frame)
        if read is None
        else mapping_image(frame, view_of(read, with_depth=False), config)
    )
    nearest = nodes.rows(image.world_from_cam, max(1, config.landmarks.nodes_per_image)).tolist()
    around = {row: drafts.shelf[row] for row in nearest[: config.landmarks.nodes_per_image]}
    observed = {
        row: observe(draft, image, frame.session_id, config)
        for row, draft in around.items()
        if frame not in draft.sources
    }
    placed_of = {
        kind: placed(of, image.camera.width, image.camera.height, config.vlad_of(kind))
        for kind, of in image.features.items()
    }
    return _Visit(
        image,
        nearest[0],
        observed,
        {kind: vlad(described, words[kind]) for kind, described in placed_of.items()},
    )


def _words(drafts: Drafts, kind: str, config: BuildConfig) -> Float32[np.ndarray, "k d"]:
    return learn_words_of(
        drafts.num_points[kind], lambda row: drafts.shelf[row].described(kind, config), config.vlad
    )


def _finished(
    drafts: Drafts, config: BuildConfig
) -> tuple[dict[str, Sequence[TopoNode]], Sequence[TopoNode]]:
    """The nodes by their kinds of features, and all side nodes; each draft is looked at once."""
    of_kind, sides = {kind: Shelf[TopoNode]() for kind in config.kinds}, Shelf[TopoNode]()

    def finished(node_id: int) -> tuple[list[TopoNode], list[TopoNode]]:
        draft = drafts.shelf[node_id]
        return [finish_node(node_id, draft, kind, config) for kind in config.kinds], draft.sides

    for node_id, (nodes, of_node) in enumerate(in_order(finished, range(len(drafts.shelf)))):
        for kind, node in zip(config.kinds, nodes, strict=True):
            of_kind[kind].append(node)
        for side in of_node:
            sides.append(replace(side, summary=replace(side.summary, of_node=node_id)))
    return dict(of_kind), sides


def _edges_along(frames: list[MappingFrame], node_ids: list[int]) -> list[Edge]:
    """An edge wherever a recording went from one node to another."""
    steps = pairwise(zip(frames, node_ids, strict=True))
    edges = {
        (source, target)
        for (a, source), (b, target) in steps
        if a.sequence is b.sequence and source != target
    }
    return [Edge(source, target) for source, target in sorted(edges)]


def _trajectory_length(frames: list[MappingFrame]) -> float:
    steps = [
        b.world_from_cam.translation - a.world_from_cam.translation
        for a, b in pairwise(frames)
        if a.sequence is b.sequence
    ]
    return float(sum(np.linalg.norm(step) for step in steps))
