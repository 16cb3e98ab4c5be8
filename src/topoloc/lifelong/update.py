"""Add a new session to a map. `update` changes a map file. Start reading at `update_map`.

The session's poses in the map are estimated first (`session_poses.py`). If the map localizes an
image well, only its observations of existing landmarks are counted. These counts later show which
landmarks have vanished. Otherwise (new places, other light, a changed room) the session's images
become nodes, as in a new map. The images around them are added to the coarse localizers. Nothing
that the map had is moved.

The map recognises little of an image in another light, although it knows the surfaces. Such images
become nodes, whose landmarks have the depths of the map (`session_content.py`) and the descriptors
of the new light. They stay only if the images recognise more of each other than of the map. They
take the room of landmarks that are seen least.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.errors import MapError
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import OneLine
from topoloc.lifelong.node_localization import measure_recall_change
from topoloc.lifelong.prune import measure_file_size, prune_map
from topoloc.lifelong.session_content import (
    SessionContent,
    create_session_content,
    update_coarse_models,
)
from topoloc.lifelong.session_poses import (
    SessionPoses,
    check_session_is_new,
    estimate_poses_by_motion,
)
from topoloc.lifelong.single_camera_poses import estimate_poses_by_map
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import with_map_statistics
from topoloc.mapping.config import Progress
from topoloc.mapping.edit import WaitCallback, edit_map
from topoloc.mapping.landmarks import count_session_observations
from topoloc.mapping.mapping_frames import (
    MappingFrame,
    compute_trajectory_length,
    connect_nodes,
    create_session,
    select_posed_frames,
)
from topoloc.mapping.node_drafts import add_virtual_nodes, observe_node
from topoloc.mapping.nodes import NodePoses, find_nearest_nodes, node_distances
from topoloc.mapping.storage.entries import Session, overlay
from topoloc.mapping.topomap import TopoMetricMap, TopoNode
from topoloc.node_ids import Row
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import with_poses
from topoloc.slam.input_checks import check_stereo
from topoloc.slam.pose_checks import check_poses
from topoloc.slam.slam import run_slam
from topoloc.tracking.tracker import Tracker


def find_poorly_recognised(topomap: TopoMetricMap, session_poses: SessionPoses) -> set[int]:
    """Return the queried frames with a pose that see surfaces of the map, of which the map
    recognises little."""
    min_inliers = 150  # an image with more is localized in all likelihood from beside it, too
    reach = 4.0  # to the nearest node by Eq. 1, in D_thresh: farther ones show other surfaces
    nodes, config = topomap.node_poses, topomap.config
    return {
        index
        for index, answer in session_poses.answers.items()
        if (pose := session_poses.world_from_cams.get(index)) is not None
        and (answer is None or answer.num_inliers < min_inliers)
        and node_distances(pose, nodes, config.lambda_rot).min() <= reach * config.d_thresh
    }


def select_learnable(
    poor: Set[int], motion: Sequence[Rigid3 | None], session_poses: SessionPoses, d_thresh: float
) -> set[int]:
    """Return the frames `poor` and the queried ones beside each, if their poses are certain: the
    map's answers agree with them. Without an answer, the session's own `motion` must agree with the
    answers from image to image. None is returned without one of `poor`."""
    max_error_m, num_sigmas = 0.1 * d_thresh, 3.0  # the answer's sigmas are added
    poses = session_poses.world_from_cams
    answers = {index: one for index, one in session_poses.answers.items() if one is not None}
    known = [(pose, answers[k].world_from_cam) for k in answers if (pose := motion[k]) is not None]
    errors_m = [
        np.linalg.norm((a.inverse() @ b).translation - (c.inverse() @ d).translation)
        for (a, c), (b, d) in pairwise(known)
    ]
    is_motion_good = bool(np.median(errors_m or [0.0]) <= max_error_m)

    def is_certain(index: int) -> bool:
        if (answer := answers.get(index)) is None:
            return is_motion_good
        tolerance_m = max_error_m + num_sigmas * answer.position_sigma_m
        return poses[index].is_same(answer.world_from_cam, tolerance_m, math.pi)

    queried = filter(poses.__contains__, session_poses.answers)
    beside = {one for pair in pairwise(queried) if not poor.isdisjoint(pair) for one in pair}
    certain = set(filter(is_certain, beside | poor))
    return certain if certain & poor else set()


def find_learned_images(
    changed: TopoMetricMap, num_old: int, indices: Mapping[str, int], poor: Set[int]
) -> tuple[set[int], dict[str, int]]:
    """Look in the images of new nodes (`indices`: their frames by name) for landmarks of the map
    that it was before (the first `num_old` nodes), and for landmarks of the other images.

    Return the frames that stay and the numbers of recognised landmarks by the names of the map's
    history. All stay or none, as the frames `poor` tell, but those that contradict their poses. Of
    the landmarks in view, they must show a larger share of each other's than of the map's: at its
    borders the map has few landmarks, but shows them as well as everywhere.
    """
    min_gain = 1.25  # images in the map's own light show less of each other than of the map
    min_recognised = 30  # landmarks that an image shows where its pose predicts them
    new = [row for row in changed.rows[num_old:] if changed.summaries[row].name in indices]
    by_map, by_others, learned = np.zeros(2, int), np.zeros(2, int), set[int]()
    for row in new:
        index, others = indices[changed.summaries[row].name], [one for one in new if one != row]
        of_map = _count_recognised(changed, row, changed.rows[:num_old])
        of_others = _count_recognised(changed, row, others)
        if max(of_map[0], of_others[0]) >= min_recognised:
            learned.add(index)
            if index in poor:
                by_map, by_others = by_map + of_map, by_others + of_others
    of_map, of_others = (seen / max(in_view, 1) for seen, in_view in (by_map, by_others))
    seen = {
        "landmarks_of_map_seen": int(by_map[0]),
        "landmarks_of_each_other_seen": int(by_others[0]),
    }
    return learned if of_others > min_gain * of_map else set(), seen


def _count_recognised(topomap: TopoMetricMap, row: Row, known: Sequence[Row]) -> tuple[int, int]:
    """Return how many landmarks the image of a node shows of one of the two nearest nodes among
    `known`, the better one, and how many of that are in view."""
    summary, image = topomap.summaries[row], topomap.first_layer.nodes[row].camera
    pose, poses = summary.world_from_cam, topomap.node_poses.rows(known)

    def count(other: Row) -> tuple[int, int]:
        cam_from_node = pose.inverse() @ topomap.summaries[other].world_from_cam
        num_seen, num_in_view = 0, 0
        for layer in topomap.layers.values():
            node, features = layer.nodes[other], layer.nodes[row].features
            num_seen += len(observe_node(node, features, image, cam_from_node).rows)
            points = cam_from_node.apply(node.points_cam.astype(np.float64))
            is_seen = (points[:, 2] > 0.0) & image.is_in_image(image.img_from_cam(points))
            num_in_view += int(np.count_nonzero(is_seen))
        return num_seen, num_in_view

    nearest = find_nearest_nodes(pose, poses, topomap.config.lambda_rot, 2) if known else []
    return max((count(known[k]) for k in nearest), default=(0, 0))


_Added = tuple[SessionContent, TopoMetricMap, list[str]]
"""The content of a session, the map with it, and the coarse localizers that were not updated."""


@dataclass(frozen=True, eq=False, repr=False)
class MapUpdate(OneLine):
    """Hold the updated map, the session with its poses in the map's world, and the changes by
    name."""

    topomap: TopoMetricMap
    sequence: StereoSequence
    changes: dict[str, Any]


def default_pose_source(sequence: StereoSequence) -> str:
    """Return the default source of a new session's poses: `truth` if the recording has poses,
    `slam` for stereo or RGB-D, `map` for a single camera. Raises UnreadableImageError."""
    is_single = (first := sequence[0]).right is None and first.depth is None
    return "truth" if any(sequence.poses) else "map" if is_single else "slam"


def update(
    path: str | Path,
    sequence: StereoSequence | str | Path,
    poses_from: str | None = None,
    find_poses: Callable[[str], StereoSequence] | None = None,
    localizer_config: LocalizerConfig | None = None,
    light: str | None = None,
    is_checked: bool = True,
    progress: Progress | None = None,
    on_wait: WaitCallback | None = None,
) -> MapUpdate:
    """Add a recording to a map file as a new session.

    Args:
        path: the map file, which is replaced.
        sequence: the recording, or its path: stereo, RGB-D or a single camera.
        poses_from: the source of its poses, stored in the map: `truth` (its own poses, metres, in
            any world), `slam`, `map` (localized in the map, image by image), or a name for given
            poses. By default as `default_pose_source`.
        find_poses: returns the recording with its poses from this source; called only if the
            session is new. By default SLAM runs if `poses_from` is `slam`.
        light: the name of the recording's illumination; by default it has none.
        is_checked: whether given poses are compared with the images first.
        progress: called with a stage's name, steps done and steps in all.
        on_wait: called if another process edits the map, before this one waits.

    Returns:
        The updated map and the changes; these contain the file's bytes before and after.

    Raises:
        ConfigError: a setting is out of its bounds.
        DuplicateSessionError: the map contains the session already.
        TrajectoryError: the poses do not fit the images, or too few images are localized.
        MapError: the map is missing, damaged, or cannot be written.
        RecordingError, CalibrationError, UnreadableImageError: from reading the recording.
    """
    if isinstance(sequence, str | Path):
        sequence = open_sequence(sequence)
    poses_from = poses_from or default_pose_source(sequence)
    with edit_map(path, on_wait) as edit:
        edit.topomap.require_scale("an update")
        check_session_is_new(edit.topomap, sequence)  # before its poses are estimated
        if find_poses is not None:
            posed = find_poses(poses_from)
        elif poses_from == "slam":
            posed = run_slam([sequence], progress).apply([sequence])[0]
        else:
            posed = sequence
        if poses_from not in ("map", "slam"):
            check_stereo(posed)
            if is_checked:
                check_poses(posed)
        updated = update_map(edit.topomap, posed, poses_from, localizer_config, progress)
        before = edit.path.stat().st_size
        changes, topomap = updated.changes | {"bytes_before": before}, updated.topomap
        if changes.get("learned"):
            with suppress(MapError):  # a map of few landmarks grows
                limit = _limit_size(topomap, edit.path, changes)
                topomap, dropped = prune_map(topomap, edit.path, limit)
                changes |= {name: dropped[name] for name in ("nodes_dropped", "landmarks_dropped")}
        if light is not None:
            *others, last = topomap.sessions
            topomap = replace(topomap, sessions=[*others, replace(last, light_name=light)])
        edit.commit(topomap, f"update {sequence.name}", changes)
    return replace(updated, topomap=topomap, changes=changes | {"bytes": Path(path).stat().st_size})


def update_map(
    topomap: TopoMetricMap,
    sequence: StereoSequence,
    poses_from: str,
    localizer_config: LocalizerConfig | None = None,
    progress: Progress | None = None,
) -> MapUpdate:
    """Return the map with one more session, which has poses in any metric world. `poses_from` is
    their source, which the map records. If it is `map`, the images form a stream, each is localized
    in the map, and they need no poses.

    `progress` is called with a stage's name, steps done and all steps. Raises as `update`, and
    FeatureTypeError or WeightsError if the map's features cannot be extracted on this machine.
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
    poses = [session_poses.world_from_cams.get(index) for index in range(len(sequence))]
    posed_sequence = with_poses(sequence, poses)
    frames = select_posed_frames(posed_sequence, topomap.free_ids.session)

    def add_frames(learnt: Collection[int]) -> _Added:
        content = create_session_content(topomap, frames, session_poses, progress, learnt)
        camera = sequence[frames[0].index].camera
        session = create_session(sequence, frames, poses_from, camera, content.lights)
        added = add_session(topomap, session, frames, content), content.views, content.images
        return content, *update_coarse_models(*added)

    (content, changed, not_updated), learning = _learn_light(
        topomap, sequence.poses, frames, session_poses, add_frames
    )
    changes = {
        "session": frames[0].session_id,
        "recording": sequence.name,
        "frames": len(sequence),
        "frames_with_pose": len(frames),
        "poses_from": poses_from,
        "frames_by_odometry": len(session_poses.propagated_idx),
        "asked": len(session_poses.answers),
        "localized": sum(answer is not None for answer in session_poses.answers.values()),
        "agreeing": len(session_poses.inlier_idx),
        "nodes_added": len(content.nodes[topomap.kind]),
        "side_nodes_added": len(content.sides),
        "points_added": sum(len(node.features) for node in content.nodes[topomap.kind]),
        "place_images_added": len(content.images),
        "not_taught": not_updated,
    } | learning
    changed = with_map_statistics(changed, progress)
    recall = measure_recall_change(topomap, changed, localizer_config)
    return MapUpdate(changed, posed_sequence, changes | recall)


def _limit_size(topomap: TopoMetricMap, path: Path, changes: Mapping[str, int]) -> int:
    """Return the bytes of the map without its learned nodes. Other landmarks make room for these,
    but at most a fifth."""
    max_share = 0.2
    before, size = changes["bytes_before"], measure_file_size(topomap, path).size
    of_learned = (size - before) * changes["learned"] / changes["nodes_added"]
    return round(size - min(of_learned, max_share * before))


def _learn_light(
    topomap: TopoMetricMap,
    motion: Sequence[Rigid3 | None],
    frames: Sequence[MappingFrame],
    session_poses: SessionPoses,
    add_frames: Callable[[Collection[int]], _Added],
) -> tuple[_Added, dict[str, int]]:
    """Return what `add_frames` adds with those images as nodes that teach the map another light,
    and their numbers by the names of the map's history, none if the map recognises all well."""
    poor = find_poorly_recognised(topomap, session_poses)
    learnable = select_learnable(poor, motion, session_poses, topomap.config.d_thresh)
    added, learned, seen = add_frames(learnable), learnable, dict[str, int]()
    if learnable:
        indices = {frame.name: frame.index for frame in frames if frame.index in learnable}
        learned, seen = find_learned_images(added[1], len(topomap.summaries), indices, poor)
        added = added if learned == learnable else add_frames(learned)
    counts = {"poorly_recognised": len(poor), "learned": len(learned)}
    return added, counts | seen if poor else {}


def add_session(
    topomap: TopoMetricMap,
    session: Session,
    frames: Sequence[MappingFrame],
    content: SessionContent,
) -> TopoMetricMap:
    """Return the map with the nodes, images and observations of a session. Its coarse models and
    statistics are as before."""
    layers = {
        kind: replace(layer, nodes=_merge_nodes(layer.nodes, kind, content))
        for kind, layer in topomap.layers.items()
    }
    summaries = [*topomap.summaries, *(node.summary for node in content.nodes[topomap.kind])]
    poses = NodePoses.from_poses([summary.world_from_cam for summary in summaries])
    nearest = [
        node_distances(frame.world_from_cam, poses, topomap.config.lambda_rot).argmin()
        for frame in frames
    ]
    edges = connect_nodes(frames, [summaries[int(row)].node_id for row in nearest])
    return replace(
        topomap,
        summaries=summaries,
        layers=layers,
        edges=sorted({*topomap.edges, *edges}),
        place_images=overlay(topomap.place_images, {}, content.images),
        sides=add_virtual_nodes(topomap, content.sides),
        length_m=topomap.length_m + compute_trajectory_length(frames),
        sessions=[*topomap.sessions, session],
    )


def _merge_nodes(
    before: Sequence[TopoNode], kind: str, content: SessionContent
) -> Sequence[TopoNode]:
    """Return the existing nodes of a feature type with the session's statistics, followed by the
    new nodes."""
    changed = {}
    for (of_kind, row), observations in content.observations.items():
        if of_kind == kind:
            node, session_id = before[row], observations[0].session_id
            added = count_session_observations(len(node.features), observations, session_id)
            if added is not None:
                by_session = {one.session_id: one for one in node.session_statistics}
                own = by_session.get(session_id)
                by_session[session_id] = added if own is None else own.with_counts(added)
                changed[row] = replace(node, session_statistics=[*by_session.values()])
    return overlay(before, changed, content.nodes[kind])
