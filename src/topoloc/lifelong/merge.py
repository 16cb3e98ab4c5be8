"""Merge two maps of overlapping places. `merge` does so with map files. Start reading at
`merge_maps`.

Only the two maps are needed. The stored features of the second map's nodes are localized in the
first map. The second map's nodes are then aligned like the frames of a session
(`session_poses.py`). Nodes that the first map localizes well are skipped. The other nodes are added
with their sessions, landmark statistics and virtual nodes.

`move_map` moves a map to another world: all its poses change, and no distance. `rescale_map`
changes all lengths.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from topoloc.errors import MapError
from topoloc.geometry.rigid import Rigid3
from topoloc.lifelong.node_localization import localize_nodes, measure_recall_change
from topoloc.lifelong.session_content import is_well_localized, update_coarse_models
from topoloc.lifelong.session_poses import align_motion_to_map
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import (
    carry_over_error_shares,
    with_map_statistics,
    with_repetitions,
)
from topoloc.mapping.config import Progress
from topoloc.mapping.edit import WaitCallback, edit_map
from topoloc.mapping.node_drafts import add_virtual_nodes
from topoloc.mapping.nodes import node_distances
from topoloc.mapping.storage.entries import (
    Edge,
    Edit,
    NodeSummary,
    PlaceImage,
    TopoNode,
    change_each,
    overlay,
    today,
)
from topoloc.mapping.storage.schema import SCHEMA_VERSION
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import NodeId, Row, as_rows


def merge(
    first: str | Path,
    second: str | Path,
    out: str | Path,
    localizer_config: LocalizerConfig | None = None,
    progress: Progress | None = None,
    on_wait: WaitCallback | None = None,
) -> dict[str, Any]:
    """Merge two map files of overlapping places into a new one, in the world of the first. If
    another process edits a map at `out`, `on_wait` is called once, and the merge waits.

    Returns:
        The changes: numbers and texts by their names, with the bytes of the new file.

    Raises:
        ConfigError: a setting is out of its bounds.
        MapError: a map is missing or damaged, both are one map, the second lacks a feature type of
            the first, or the new file cannot be written.
        TrajectoryError: the maps have too little in common.
        FeatureTypeError, WeightsError: their features are not available here.
    """
    with TopoMetricMap.load(first) as one, TopoMetricMap.load(second) as other:
        merged, changes = merge_maps(one, other, localizer_config, progress)
        edit = Edit(
            one.free_ids.edit, f"merge {Path(second).name}", today(), SCHEMA_VERSION, changes
        )
        replace(merged, edits=[*one.edits, edit]).save(out, on_wait)
    return changes | {"bytes": Path(out).stat().st_size}


def merge_maps(
    first: TopoMetricMap,
    second: TopoMetricMap,
    localizer_config: LocalizerConfig | None = None,
    progress: Progress | None = None,
) -> tuple[TopoMetricMap, dict[str, Any]]:
    """Merge the second map into the first. Return the result in the first map's world, and the
    numbers of changes by name. Raises as `merge`."""
    progress = progress or (lambda stage, done, total: None)
    for one in (first, second):
        one.require_scale("a merge")
    if missing := set(first.kinds) - set(second.kinds):
        raise MapError(
            f"the second map holds no features {', '.join(sorted(missing))}, which the first has;"
            " build it with them"
        )
    if first.map_id is not None and first.map_id == second.map_id:
        raise MapError("they are one map in two versions; nothing is merged")
    answers = localize_nodes(
        Localizer(first, localizer_config),
        second,
        second.rows,
        lambda done: progress("comparing the maps", done, len(second.rows)),
    )
    odom = dict(enumerate(summary.world_from_cam for summary in second.summaries))
    aligned = align_motion_to_map("the second map", odom, {**answers}, first.config.d_thresh)
    added = as_rows(
        row
        for row, answer in answers.items()
        if not is_well_localized(answer, first.config.d_thresh)
    )
    poses = {Row(row): pose for row, pose in aligned.world_from_cams.items()}
    merged, not_updated = _add_nodes(first, second, added, poses)
    changes = {
        "nodes_of_second": len(second.summaries),
        "localized": sum(answer is not None for answer in answers.values()),
        "agreeing": len(aligned.inlier_idx),
        "nodes_added": len(added),
        "not_taught": not_updated,
    }
    merged = with_map_statistics(merged, progress)
    return merged, changes | measure_recall_change(first, merged, localizer_config)


def _add_nodes(
    first: TopoMetricMap, second: TopoMetricMap, added: Sequence[Row], poses: Mapping[Row, Rigid3]
) -> tuple[TopoMetricMap, list[str]]:
    """Return the first map with these nodes of the second, and the names of the coarse localizers
    that were not updated."""
    free = first.free_ids
    session_ids = {one.session_id: free.session + k for k, one in enumerate(second.sessions)}
    sessions = [replace(one, session_id=session_ids[one.session_id]) for one in second.sessions]
    new_id = {row: NodeId(free.node + k) for k, row in enumerate(added)}
    nodes = {
        kind: [
            _transform_node(second.layers[kind].nodes[row], new_id[row], poses[row], session_ids)
            for row in added
        ]
        for kind in first.kinds
    }
    views = {
        kind: [(node.features, node.camera, node.summary.node_id) for node in of_kind]
        for kind, of_kind in nodes.items()
    }
    summaries = [*first.summaries, *(node.summary for node in nodes[first.kind])]
    layers = {
        kind: replace(layer, nodes=overlay(layer.nodes, {}, nodes[kind]))
        for kind, layer in first.layers.items()
    }
    images = _select_images(second, new_id, poses, session_ids)
    merged = replace(
        first,
        summaries=summaries,
        layers=layers,
        edges=sorted({*first.edges, *_transfer_edges(first, second, new_id, poses)}),
        place_images=overlay(first.place_images, {}, images),
        length_m=first.length_m + second.length_m * len(added) / max(len(second.summaries), 1),
        sessions=[*first.sessions, *sessions],
        sides=_transfer_virtual_nodes(first, second, new_id, poses, summaries),
    )
    return update_coarse_models(merged, views, images)


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
    statistics = [
        replace(one, session_id=session_ids.get(one.session_id, one.session_id))
        for one in node.session_statistics
    ]
    return replace(node, summary=summary, session_statistics=statistics)


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
        if (row := wanted.get((image.session_id, image.name))) is not None:
            session_id = session_ids.get(image.session_id, image.session_id)
            placed = replace(image, node_id=new_id[row], world_from_cam=poses[row])
            found.append(replace(placed, session_id=session_id, image_id=None))
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
        distances = node_distances(poses[row], first.node_poses, first.config.lambda_rot)
        ids[summary.node_id] = new_id.get(row, first.summaries[int(distances.argmin())].node_id)
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
    nodes, known = list[TopoNode](), {summary.node_id: summary for summary in summaries}
    for side in second.sides.nodes:
        of = side.summary
        row = None if of.of_node is None else second.row_of(of.of_node)
        if row is not None and row in new_id:
            owner = known[new_id[row]]
            node_from_second = second.summaries[row].world_from_cam.inverse()
            moved = poses[row] @ node_from_second @ of.world_from_cam
            ids = {"of_node": owner.node_id, "session_id": owner.session_id}
            nodes.append(replace(side, summary=replace(of, world_from_cam=moved, **ids)))
    return add_virtual_nodes(first, nodes)


T = TypeVar("T", NodeSummary, PlaceImage)


def move_map(
    path: str | Path, new_from_old: Rigid3, name: str = "move", on_wait: WaitCallback | None = None
) -> None:
    """Move a map file to another world, as one edit of this name. The history keeps the transform
    as x, y, z, qx, qy, qz, qw. Its place on earth stays.

    Raises:
        MapError: the map is missing, damaged, or cannot be written.
    """
    w, *ijk = new_from_old.quat_wxyz().tolist()
    numbers = (*new_from_old.translation.tolist(), *ijk, w)
    text = " ".join(f"{number:.7g}" for number in numbers)
    with edit_map(path, on_wait) as edit:
        moved = with_map_statistics(move_world(edit.topomap, new_from_old))
        edit.commit(moved, name, {"new_from_old": text})


def rescale_map(
    path: str | Path, factor: float, scale_sigma: float, on_wait: WaitCallback | None = None
) -> None:
    """Multiply all lengths of a map file by a factor, after which they are metres, as one edit. A
    place on earth, which was fitted to other lengths, is dropped.

    Args:
        scale_sigma: relative standard deviation of the new lengths.

    Raises:
        MapError: the factor is out of bounds; the map is missing, damaged, or cannot be written.
    """
    if not 1e-4 < factor < 1e4:
        raise MapError(
            f"map {path}: lengths times {factor:.3g} are no metres; check what is stated"
        )
    with edit_map(path, on_wait) as edit:
        topomap = edit.topomap
        moved = move_world(topomap, Rigid3.identity(), factor)
        nodes = topomap.config.nodes
        d_thresh, lambda_rot = factor * topomap.config.d_thresh, factor * topomap.config.lambda_rot
        nodes = replace(nodes, d_thresh=d_thresh, lambda_rot=lambda_rot)
        config = replace(topomap.config, nodes=nodes, scale_sigma=scale_sigma)
        length_m = factor * topomap.length_m
        moved = replace(moved, config=config, length_m=length_m, georeference=None)
        moved = with_repetitions(carry_over_error_shares(moved, topomap))
        edit.commit(moved, "scale", {"factor": f"{factor:.7g}", "sigma": f"{scale_sigma:.2g}"})


def move_world(topomap: TopoMetricMap, new_from_old: Rigid3, factor: float = 1.0) -> TopoMetricMap:
    """Return the map with all lengths times a factor, and all its poses in another world. Its
    statistics are no longer those of its nodes."""

    def move(of: T) -> T:
        pose = of.world_from_cam
        scaled = Rigid3(pose.rotation, factor * pose.translation)
        return replace(of, world_from_cam=new_from_old @ scaled)

    def move_node(node: TopoNode) -> TopoNode:
        if factor == 1.0:
            return replace(node, summary=move(node.summary))
        return replace(
            node,
            summary=move(node.summary),
            points_cam=node.points_cam * np.float32(factor),
            point_sqrt_covs=np.clip(node.point_sqrt_covs * np.float32(factor), -6e4, 6e4),
            session_statistics=[one.scaled(factor) for one in node.session_statistics],
        )

    known, sides = topomap.georeference, topomap.sides
    if known is not None:
        enu_from_new = known.enu_from_world @ new_from_old.inverse()
        known = replace(known, enu_from_world=enu_from_new)
    if sides is not None:  # with the places of their retrieval model
        models = dict(sides.coarse_models)
        for name, model in models.items():
            centres = new_from_old.apply(factor * model.arrays["centres"])
            models[name] = replace(model, arrays={**model.arrays, "centres": centres})
        summaries, nodes = [*map(move, sides.summaries)], change_each(sides.nodes, move_node)
        sides = replace(sides, summaries=summaries, nodes=nodes, coarse_models=models)
    layers = {
        kind: replace(layer, nodes=change_each(layer.nodes, move_node))
        for kind, layer in topomap.layers.items()
    }
    return replace(
        topomap,
        summaries=[*map(move, topomap.summaries)],
        layers=layers,
        place_images=change_each(topomap.place_images, move),
        sides=sides,
        georeference=known,
    )
