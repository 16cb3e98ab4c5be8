"""Add a new session to a map. Start reading at `update_map`.

The session's poses in the map are estimated first (`session_poses.py`). If the map localizes an
image well, only its observations of existing landmarks are counted. These counts later show which
landmarks have vanished. Otherwise (new places, other light, a changed room) the session's images
become nodes, as in a new map. The images around them are added to the coarse localizers. Existing
content of the map is neither changed nor removed.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Int

from topoloc.errors import DuplicateSessionError
from topoloc.geometry.rigid import inverse_covariance, position_covariance
from topoloc.lifelong.coarse_model_update import PlaceFeatures, update_coarse_models
from topoloc.lifelong.lazy_sequences import OverlaySequence
from topoloc.lifelong.node_observation import observe_node
from topoloc.lifelong.recall_change import measure_recall_change
from topoloc.lifelong.session_poses import (
    Progress,
    SessionPoses,
    estimate_poses_by_motion,
)
from topoloc.lifelong.single_camera_poses import estimate_poses_by_map
from topoloc.lifelong.virtual_node_update import add_virtual_nodes, find_new_virtual_views
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import with_map_statistics
from topoloc.localization.result import Localization
from topoloc.mapping.landmarks import NODES_PER_IMAGE, Observations, count_session_observations
from topoloc.mapping.mapping_frames import (
    MappingFrame,
    MappingImage,
    PointLocator,
    encode_place_image,
    extract_mapping_image,
    select_posed_frames,
)
from topoloc.mapping.node_drafts import (
    MIN_NODE_POINTS,
    NodeDraft,
    create_node_draft,
    finish_node,
    observe_draft,
)
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.sessions import Illumination, Session, average_illumination
from topoloc.mapping.topomap import Edge, PlaceImage, TopoMetricMap, TopoNode
from topoloc.node_ids import NodeId
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.recording import SequenceView, find_source_path
from topoloc.retrieval.network_images import decode_stored_image
from topoloc.tracking.tracker import Tracker


@dataclass(frozen=True, eq=False)
class MapUpdate:
    """Hold the updated map, the session with its poses in the map's world, and the changes by
    name."""

    topomap: TopoMetricMap
    sequence: StereoSequence
    changes: dict[str, Any]


@dataclass(frozen=True, eq=False)
class _SessionContent:
    """Hold the new content of a session.

    This is: its nodes by feature type, its virtual nodes, its images with their nodes, its
    observations of existing nodes, and its illumination.
    """

    nodes: dict[str, list[TopoNode]]
    sides: list[TopoNode]
    images: list[PlaceImage]
    views: dict[str, list[PlaceFeatures]]
    observations: dict[tuple[str, int], list[Observations]]
    lights: list[Illumination]


def update_map(
    topomap: TopoMetricMap,
    sequence: StereoSequence,
    poses_from: str,
    localizer_config: LocalizerConfig | None = None,
    progress: Progress | None = None,
) -> MapUpdate:
    """Return the map with one more session.

    Args:
        topomap: the map.
        sequence: the session, with poses in any metric world. If `poses_from` is `map`, its images
            form a stream and need no poses.
        poses_from: the source of the poses, which the map records. `map` localizes every image in
            the map.
        localizer_config: the localizer's settings.
        progress: is called with a stage's name, steps done and all steps.

    Raises:
        ConfigError: a setting of the localizer is out of its bounds.
        DuplicateSessionError: the session is in the map already.
        TrajectoryError: the map recognises too little of it, or contradicts its poses.
        FeatureTypeError, MissingExtraError, WeightsError: the map's features cannot be extracted on
            this machine.
        RecordingError, CalibrationError, UnreadableImageError: the recording cannot be read.
    """
    progress = progress or (lambda stage, done, total: None)
    check_session_is_new(topomap, sequence)
    localizer = Localizer(topomap, localizer_config)
    if poses_from == "map":
        session_poses = estimate_poses_by_map(
            sequence, Tracker(localizer), topomap.config, progress
        )
    else:
        session_poses = estimate_poses_by_motion(sequence, localizer, topomap.config, progress)
    session_id = topomap.free_ids.session
    without = [None] * (len(sequence) - len(session_poses.world_from_cams))
    posed_sequence = SequenceView(
        sequence, list(range(len(sequence))), [*session_poses.world_from_cams, *without]
    )
    frames = select_posed_frames(posed_sequence, session_id)
    content = _create_session_content(topomap, frames, session_poses, progress)
    session = _create_session(session_id, sequence, frames, content, poses_from)
    changed = _add_session(topomap, session, frames, content)
    changed, not_updated = update_coarse_models(changed, content.views, content.images)
    changes = {
        "session": session_id,
        "recording": sequence.name,
        "frames": len(sequence),
        "frames_with_pose": len(frames),
    }
    changes |= (
        {"poses_from": poses_from}
        | _count_changes(session_poses, content, topomap.kind)
        | {"not_taught": not_updated}
    )
    changed = with_map_statistics(changed, progress)
    return MapUpdate(
        changed,
        posed_sequence,
        changes | measure_recall_change(topomap, changed, localizer_config),
    )


def _count_changes(
    session_poses: SessionPoses, content: _SessionContent, kind: str
) -> dict[str, Any]:
    return {
        "frames_by_odometry": len(session_poses.propagated_idx),
        "asked": len(session_poses.answers),
        "localized": sum(answer is not None for answer in session_poses.answers.values()),
        "agreeing": len(session_poses.inlier_idx),
        "nodes_added": len(content.nodes[kind]),
        "side_nodes_added": len(content.sides),
        "points_added": sum(len(node.features) for node in content.nodes[kind]),
        "place_images_added": len(content.images),
    }


def check_session_is_new(topomap: TopoMetricMap, sequence: StereoSequence) -> None:
    """Check that a session is not in the map already.

    Names and times may also be those of another day. So the check compares images or file paths,
    too. Raises DuplicateSessionError.
    """
    if len(sequence) == 0:
        return
    times, path = (min(sequence.t_ns), max(sequence.t_ns)), find_source_path(sequence)
    for session in topomap.sessions:
        if session.name != sequence.name or session.start_ns is None or session.end_ns is None:
            continue
        if min(times[1], session.end_ns) < max(times[0], session.start_ns):
            continue
        is_same_path = path is not None and path == session.recording
        is_same_file = is_same_path and (session.start_ns, session.end_ns) == times
        if is_same_file or _has_same_images(topomap, session.session_id, sequence, is_same_path):
            raise DuplicateSessionError(
                f"{sequence.name}: it is in the map already, as session {session.session_id}; the"
                " map stays as it is"
            )


def _has_same_images(
    topomap: TopoMetricMap, session_id: int, sequence: StereoSequence, is_same_path: bool
) -> bool:
    """Return whether images of the same name are identical, according to the small images in the
    map.

    Of the same folder (`is_same_path`), other images of the same time span count as the same
    session, too. This covers selections such as every second frame, then the frames between.
    """
    rows = {name: index for index, name in enumerate(sequence.names)}
    kept = [image for image in topomap.place_images if image.session_id == session_id]
    common = [image for image in kept if image.name in rows]
    if not common:
        return is_same_path and bool(kept)
    num_compared = 3  # images, evenly spaced
    tried = [
        common[k] for k in np.unique(np.linspace(0, len(common) - 1, num_compared).astype(int))
    ]
    return any(
        encode_place_image(
            prepare_frame(sequence[rows[image.name]], False).picture, _shorter_side(image.jpeg)
        )
        == image.jpeg
        for image in tried
    )


def _shorter_side(jpeg: bytes) -> int:
    return min(decode_stored_image(jpeg).shape[:2])


def _create_session_content(
    topomap: TopoMetricMap,
    frames: Sequence[MappingFrame],
    session_poses: SessionPoses,
    progress: Progress,
) -> _SessionContent:
    map_config = topomap.config
    d_thresh, lambda_rot = map_config.d_thresh, map_config.lambda_rot
    locator = PointLocator(frames, map_config)
    by_index = {frame.index: frame for frame in frames}
    wanted = [
        by_index[k]
        for k, answer in session_poses.answers.items()
        if k in by_index and not is_well_localized(answer, d_thresh)
    ]
    with_virtual_views = find_new_virtual_views(topomap, [frame.world_from_cam for frame in wanted])
    drafts = list[NodeDraft]()
    for done, frame in enumerate(wanted):
        draft = create_node_draft(
            frame, frame.view(), locator, done in with_virtual_views, map_config
        )
        if len(draft.points[topomap.kind].features) >= MIN_NODE_POINTS:
            drafts.append(draft)
        progress("new nodes", done + 1, len(wanted))
    covered = {by_index[k] for k in session_poses.answers if k in by_index} - {
        draft.frame for draft in drafts
    }
    content = _SessionContent(
        {kind: [] for kind in topomap.kinds},
        [],
        [],
        {kind: [] for kind in topomap.kinds},
        defaultdict(list),
        [],
    )
    old = topomap.node_poses
    new = NodePoses.of([draft.image.world_from_cam for draft in drafts]) if drafts else None
    drafted = {draft.frame: draft.image for draft in drafts}
    first_id = topomap.free_ids.node
    new_ids = [NodeId(first_id + k) for k in range(len(drafts))]
    for done, frame in enumerate(frames):
        to_old = node_distances(frame.world_from_cam, old, lambda_rot)
        to_new = (
            np.zeros(0) if new is None else node_distances(frame.world_from_cam, new, lambda_rot)
        )
        is_of_new = len(to_new) > 0 and (to_new.min() <= max(d_thresh, to_old.min()))
        if is_of_new or frame in covered:
            image = drafted.get(frame) or extract_mapping_image(
                frame, frame.view(with_depth=False), map_config
            )
            content.lights.append(image.light)
            if frame in covered:
                _observe_map_nodes(
                    topomap, image, frame.session_id, np.argsort(to_old, kind="stable"), content
                )
            if is_of_new:
                _observe_new_nodes(drafts, frame, image, np.argsort(to_new, kind="stable"), topomap)
                _add_place_image(content, frame, image, new_ids[int(to_new.argmin())])
        progress(f"pictures of {frame.sequence.name}", done + 1, len(frames))
    for kind in topomap.kinds:
        content.nodes[kind] = [finish_node(*one, kind) for one in zip(new_ids, drafts, strict=True)]
    for node_id, draft in zip(new_ids, drafts, strict=True):
        content.sides.extend(
            replace(side, summary=replace(side.summary, of_node=node_id)) for side in draft.sides
        )
    return content


def is_well_localized(answer: Localization | None, d_thresh: float, min_inliers: int = 60) -> bool:
    """Return whether the map localizes an image well enough that it needs no node."""
    # Maximum position sigma of a well localized image, in D_thresh. Correlated errors of the
    # map's points are left out, because a node aligned by the map would share them.
    max_sigma = 0.3
    if answer is None or answer.num_inliers < min_inliers:
        return False
    of_inverse = answer.noise_share * inverse_covariance(answer.world_from_cam, answer.covariance)
    at_camera = position_covariance(answer.world_from_cam.inverse(), of_inverse)
    return float(np.sqrt(np.linalg.eigvalsh(at_camera)[-1])) <= max_sigma * d_thresh


def _observe_new_nodes(
    drafts: Sequence[NodeDraft],
    frame: MappingFrame,
    image: MappingImage,
    nearest: Int[np.ndarray, " n"],
    topomap: TopoMetricMap,
) -> None:
    for k in nearest[:NODES_PER_IMAGE]:
        if frame not in drafts[k].sources:
            drafts[k].add(observe_draft(drafts[k], image, frame.session_id))


def _observe_map_nodes(
    topomap: TopoMetricMap,
    image: MappingImage,
    session_id: int,
    nearest: Int[np.ndarray, " n"],
    content: _SessionContent,
) -> None:
    """Add an image's observations of existing nodes to `content`."""
    for row in nearest[:NODES_PER_IMAGE].tolist():
        cam_from_node = image.world_from_cam.inverse() @ topomap.summaries[row].world_from_cam
        for kind, features in image.features.items():
            node = topomap.layers[kind].nodes[row]
            content.observations[kind, row].append(
                observe_node(node, features, image.camera, cam_from_node, session_id)
            )


def _add_place_image(
    content: _SessionContent, frame: MappingFrame, image: MappingImage, node_id: NodeId
) -> None:
    content.images.append(
        PlaceImage(
            frame.sequence.name,
            frame.name,
            node_id,
            image.world_from_cam,
            image.place_jpeg,
            frame.session_id,
        )
    )
    for kind, features in image.features.items():
        content.views[kind].append(
            PlaceFeatures(features, image.camera.width, image.camera.height, node_id)
        )


def _create_session(
    session_id: int,
    sequence: StereoSequence,
    frames: Sequence[MappingFrame],
    content: _SessionContent,
    poses_from: str,
) -> Session:
    t_ns = [frame.t_ns for frame in frames]
    camera = sequence[frames[0].index].camera
    return Session(
        session_id,
        sequence.name,
        find_source_path(sequence),
        poses_from,
        min(t_ns),
        max(t_ns),
        camera,
        average_illumination(content.lights),
    )


def _add_session(
    topomap: TopoMetricMap,
    session: Session,
    frames: Sequence[MappingFrame],
    content: _SessionContent,
) -> TopoMetricMap:
    layers = {
        kind: replace(layer, nodes=_merge_nodes(layer.nodes, kind, content))
        for kind, layer in topomap.layers.items()
    }
    summaries = [*topomap.summaries, *(node.summary for node in content.nodes[topomap.kind])]
    steps = [
        b.world_from_cam.translation - a.world_from_cam.translation for a, b in pairwise(frames)
    ]
    return replace(
        topomap,
        summaries=summaries,
        layers=layers,
        edges=sorted(
            {*topomap.edges, *_find_traversed_edges(topomap, summaries, frames)},
            key=lambda edge: (edge.source_id, edge.target_id),
        ),
        place_images=OverlaySequence(topomap.place_images, {}, content.images),
        sides=add_virtual_nodes(topomap, content.sides),
        length_m=topomap.length_m + float(sum(np.linalg.norm(step) for step in steps)),
        sessions=[*topomap.sessions, session],
    )


def _merge_nodes(
    before: Sequence[TopoNode], kind: str, content: _SessionContent
) -> OverlaySequence[TopoNode]:
    """Return the existing nodes of a feature type with the session's statistics, followed by the
    new nodes."""
    changed = {}
    for (of_kind, row), observations in content.observations.items():
        if of_kind == kind:
            node = before[row]
            session_statistics = count_session_observations(
                len(node.features), observations, observations[0].session_id
            )
            changed[row] = (
                replace(node, session_statistics=[*node.session_statistics, session_statistics])
                if session_statistics is not None
                else node
            )
    return OverlaySequence(before, changed, content.nodes[kind])


def _find_traversed_edges(
    topomap: TopoMetricMap, summaries: Sequence[Any], frames: Sequence[MappingFrame]
) -> set[Edge]:
    """Return an edge for each transition of the session between two nodes."""
    poses = NodePoses.of([summary.world_from_cam for summary in summaries])
    nearest = [
        summaries[
            int(node_distances(frame.world_from_cam, poses, topomap.config.lambda_rot).argmin())
        ].node_id
        for frame in frames
    ]
    return {Edge(source, target) for source, target in pairwise(nearest) if source != target}
