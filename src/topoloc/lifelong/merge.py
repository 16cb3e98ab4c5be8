"""Merge two maps of overlapping places. Start reading at `merge_maps`.

Only the two maps are needed. The stored features of the second map's nodes are localized in the
first map. The second map's nodes are then aligned like the frames of a session
(`session_poses.py`). Nodes that the first map localizes well are skipped. The other nodes are added
with their sessions, landmark statistics and virtual nodes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from topoloc.errors import MapError, TrajectoryError
from topoloc.geometry.rigid import Rigid3
from topoloc.lifelong.coarse_model_update import PlaceFeatures, update_coarse_models
from topoloc.lifelong.lazy_sequences import OverlaySequence
from topoloc.lifelong.recall_change import measure_recall_change
from topoloc.lifelong.session_poses import Progress, SessionPoses, align_motion_to_map
from topoloc.lifelong.tiles.node_localization import localize_nodes
from topoloc.lifelong.update import is_well_localized
from topoloc.lifelong.virtual_node_update import add_virtual_nodes
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import with_map_statistics
from topoloc.mapping.landmark_statistics import LandmarkStatistics
from topoloc.mapping.nodes import node_distances
from topoloc.mapping.topomap import Edge, PlaceImage, TopoMetricMap, TopoNode
from topoloc.node_ids import NodeId, Row, as_rows


@dataclass(frozen=True, eq=False)
class MergedMap:
    """Hold the merged map and the numbers of changes, by name."""

    topomap: TopoMetricMap
    changes: dict[str, Any]


def merge_maps(
    first: TopoMetricMap,
    second: TopoMetricMap,
    localizer_config: LocalizerConfig | None = None,
    progress: Progress | None = None,
) -> MergedMap:
    """Merge the second map into the first and return the result in the first map's world.

    Raises:
        ConfigError: a setting of the localizer is out of its bounds.
        MapError: both are versions of one map, or the second lacks a feature type of the first.
        TrajectoryError: the maps overlap too little, or their distances disagree.
        FeatureTypeError, MissingExtraError, WeightsError: the maps' features cannot be compared on
            this machine.
    """
    progress = progress or (lambda stage, done, total: None)
    if missing := set(first.kinds) - set(second.kinds):
        raise MapError(
            f"the second map holds no features {', '.join(sorted(missing))}, which the first has;"
            " build it with them"
        )
    if first.map_id is not None and first.map_id == second.map_id:
        raise MapError("they are one map in two versions; nothing is merged")
    aligned = _align_second_map(first, second, localizer_config, progress)
    added = as_rows(
        row
        for row, answer in aligned.answers.items()
        if not is_well_localized(answer, first.config.d_thresh)
    )
    poses = {Row(row): pose for row, pose in enumerate(aligned.world_from_cams) if pose is not None}
    merged, not_updated = _add_nodes(first, second, added, poses)
    changes = {
        "nodes_of_second": len(second.summaries),
        "localized": sum(answer is not None for answer in aligned.answers.values()),
        "agreeing": len(aligned.inlier_idx),
        "nodes_added": len(added),
        "not_taught": not_updated,
    }
    merged = with_map_statistics(merged, progress)
    return MergedMap(
        merged,
        changes | measure_recall_change(first, merged, localizer_config),
    )


def _align_second_map(
    first: TopoMetricMap,
    second: TopoMetricMap,
    localizer_config: LocalizerConfig | None,
    progress: Progress,
) -> SessionPoses:
    """Return poses of the second map's nodes, by row, in the world of the first map."""
    rows = second.rows
    answers = localize_nodes(
        Localizer(first, localizer_config),
        second,
        rows,
        lambda done: progress("comparing the maps", done, len(rows)),
    )
    odom = dict(enumerate(summary.world_from_cam for summary in second.summaries))
    try:
        return align_motion_to_map("the second map", odom, {**answers}, first.config.d_thresh)
    except TrajectoryError as error:
        raise TrajectoryError(
            str(error).replace("the map stays as it is", "nothing is merged")
        ) from None


def _add_nodes(
    first: TopoMetricMap, second: TopoMetricMap, added: Sequence[Row], poses: Mapping[Row, Rigid3]
) -> tuple[TopoMetricMap, list[str]]:
    """Return the first map with these nodes of the second, and the names of the coarse localizers
    that were not updated."""
    base = first.free_ids.session
    sessions = {
        session.session_id: replace(session, session_id=base + k)
        for k, session in enumerate(second.sessions)
    }
    session_ids = {old: session.session_id for old, session in sessions.items()}
    first_id = first.free_ids.node
    new_id = {row: NodeId(first_id + k) for k, row in enumerate(added)}
    nodes = {
        kind: [
            _transform_node(second.layers[kind].nodes[row], new_id[row], poses[row], session_ids)
            for row in added
        ]
        for kind in first.kinds
    }
    views = {kind: [_place_features(node) for node in of_kind] for kind, of_kind in nodes.items()}
    summaries = [*first.summaries, *(node.summary for node in nodes[first.kind])]
    layers = {
        kind: replace(layer, nodes=OverlaySequence(layer.nodes, {}, nodes[kind]))
        for kind, layer in first.layers.items()
    }
    images = _select_images(second, new_id, poses, session_ids)
    merged = replace(
        first,
        summaries=summaries,
        layers=layers,
        edges=sorted(
            {*first.edges, *_transfer_edges(first, second, new_id, poses)},
            key=lambda edge: (edge.source_id, edge.target_id),
        ),
        place_images=OverlaySequence(first.place_images, {}, images),
        length_m=first.length_m + second.length_m * len(added) / max(len(second.summaries), 1),
        sessions=[*first.sessions, *sessions.values()],
        sides=_transfer_virtual_nodes(first, second, new_id, poses, summaries),
    )
    return update_coarse_models(merged, views, images)


def _place_features(node: TopoNode) -> PlaceFeatures:
    return PlaceFeatures(node.features, node.camera.width, node.camera.height, node.summary.node_id)


def _transform_node(
    node: TopoNode, node_id: NodeId, world_from_cam: Rigid3, session_ids: Mapping[int, int]
) -> TopoNode:
    """Return a node of the second map with the node id, pose and session id it has in the merged
    map."""
    of = node.summary
    summary = replace(
        of,
        node_id=node_id,
        world_from_cam=world_from_cam,
        session_id=session_ids.get(of.session_id, of.session_id),
    )
    session_statistics = [
        _renumber_session(session_statistics, session_ids)
        for session_statistics in node.session_statistics
    ]
    return replace(node, summary=summary, session_statistics=session_statistics)


def _renumber_session(
    session_statistics: LandmarkStatistics, session_ids: Mapping[int, int]
) -> LandmarkStatistics:
    return replace(
        session_statistics,
        session_id=session_ids.get(session_statistics.session_id, session_statistics.session_id),
    )


def _select_images(
    second: TopoMetricMap,
    new_id: Mapping[Row, NodeId],
    poses: Mapping[Row, Rigid3],
    session_ids: Mapping[int, int],
) -> list[PlaceImage]:
    """Return the mapping images that belong to the added nodes. Other images of the second map are
    dropped."""
    wanted = {(second.summaries[row].session_id, second.summaries[row].name): row for row in new_id}
    found = []
    for image in second.place_images:
        row = wanted.get((image.session_id, image.name))
        if row is not None:
            session_id = session_ids.get(image.session_id, image.session_id)
            changes = {
                "node_id": new_id[row],
                "world_from_cam": poses[row],
                "session_id": session_id,
                "image_id": None,
            }
            found.append(replace(image, **changes))
    return found


def _transfer_edges(
    first: TopoMetricMap,
    second: TopoMetricMap,
    new_id: Mapping[Row, NodeId],
    poses: Mapping[Row, Rigid3],
) -> set[Edge]:
    """Return the second map's edges. A skipped node is replaced by the nearest node of the first
    map."""
    ids = {}
    for row, summary in zip(second.rows, second.summaries, strict=True):
        nearest = int(
            node_distances(poses[row], first.node_poses, first.config.lambda_rot).argmin()
        )
        ids[summary.node_id] = new_id.get(row, first.summaries[nearest].node_id)
    return {
        Edge(ids[e.source_id], ids[e.target_id])
        for e in second.edges
        if ids[e.source_id] != ids[e.target_id]
    }


def _transfer_virtual_nodes(
    first: TopoMetricMap,
    second: TopoMetricMap,
    new_id: Mapping[Row, NodeId],
    poses: Mapping[Row, Rigid3],
    summaries: Sequence[Any],
):
    """Return the virtual nodes of both maps if they have the same feature type, else the first
    map's."""
    if first.sides is None or second.sides is None or first.sides.kind != second.sides.kind:
        return first.sides
    nodes = list[TopoNode]()
    known = {summary.node_id: summary for summary in summaries}
    for side in second.sides.nodes:
        row = None if side.summary.of_node is None else second.row_of(side.summary.of_node)
        if row is not None and row in new_id:
            of_node = known[new_id[row]]
            moved = (
                poses[row]
                @ second.summaries[row].world_from_cam.inverse()
                @ side.summary.world_from_cam
            )
            summary = replace(
                side.summary,
                of_node=of_node.node_id,
                session_id=of_node.session_id,
                world_from_cam=moved,
            )
            nodes.append(replace(side, summary=summary))
    return add_virtual_nodes(first, nodes)
