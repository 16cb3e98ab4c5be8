"""Localize nodes of a map, with their stored features as queries: in another map, in the rest of
the map (leave-one-out), or in an edited version of the map.

A map always finds a node by the node itself. So the node is hidden from the map, and optionally its
neighbours of the same session. Hidden nodes take no part in retrieval, matching or guided search.
The query consists of the node's stored local features, which all have a 3-D position. The small
images stored for the coarse localizers cannot serve as queries: at 160 pixels per side, even their
own map does not localize most of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.query import QueryImage
from topoloc.localization.result import Localization
from topoloc.mapping.nodes import node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import Row, as_rows

T = TypeVar("T")
MAX_TRANSLATION, MAX_ROTATION_DEG = 0.5, 10.0
"""Count a result as wrong if it is further off than this (metres, degrees)."""


@dataclass(frozen=True)
class LeaveOneOutResult:
    """Hold the result of localizing a hidden node. `is_wrong` marks a pose at another place.
    `num_inliers` is 0 if the node is not localized or the pose is wrong."""

    is_localized: bool
    is_wrong: bool
    num_inliers: int


def sample_evenly(rows: Sequence[T], max_count: int) -> list[T]:
    """Return at most `max_count` of `rows`, evenly spaced and in their order."""
    if len(rows) <= max_count:
        return list(rows)
    return [
        rows[k]
        for k in np.unique(np.linspace(0, len(rows) - 1, max_count).round().astype(int)).tolist()
    ]


def find_near_nodes(topomap: TopoMetricMap, row: Row, num_d_thresh: float) -> list[Row]:
    """Return the rows of nodes whose distance to a node by Eq. 1 is at most `num_d_thresh` times
    D_thresh."""
    pose, config = topomap.summaries[row].world_from_cam, topomap.config
    distances = node_distances(pose, topomap.node_poses, config.lambda_rot)
    return as_rows(np.flatnonzero(distances <= num_d_thresh * config.d_thresh))


def localize_left_out(
    localizer: Localizer,
    stored: TopoMetricMap,
    rows: Sequence[Row],
    num_d_thresh: float,
    progress: Callable[[int, int], None] | None = None,
) -> dict[Row, LeaveOneOutResult]:
    """Localize the nodes `rows` of `stored` in the localizer's map, which is `stored` or a version
    of it, while the nodes themselves are hidden. Nodes of the same session within `num_d_thresh`
    D_thresh are hidden, too. `progress` is called with the number of nodes done and of all nodes.

    Return the results by row. A node is not localized if all nodes of the map would be hidden.
    """
    known = {summary.node_id for summary in localizer.topomap.summaries}
    answers = dict[Row, LeaveOneOutResult]()
    for done, row in enumerate(rows):
        node = stored.nodes[row]
        features = {kind: layer.nodes[row].features for kind, layer in stored.layers.items()}
        session_id = stored.summaries[row].session_id
        near = (stored.summaries[k] for k in find_near_nodes(stored, row, num_d_thresh))
        beside = {one.node_id for one in near if one.session_id == session_id}
        hidden = sorted(known & (beside | {node.summary.node_id}))
        answers[row] = LeaveOneOutResult(False, False, 0)
        if len(hidden) < len(localizer.topomap.summaries):
            query = QueryImage.of_features(features, node.camera)
            result, *_ = localizer.without(hidden).localize_query(query)
            if isinstance(result, Localization):
                is_same = node.summary.world_from_cam.is_same(
                    result.world_from_cam, MAX_TRANSLATION, np.radians(MAX_ROTATION_DEG)
                )
                num_inliers = result.num_inliers if is_same else 0
                answers[row] = LeaveOneOutResult(is_same, not is_same, num_inliers)
        if progress is not None:
            progress(done + 1, len(rows))
    return answers


def localize_nodes(
    localizer: Localizer,
    source_map: TopoMetricMap,
    rows: Sequence[Row],
    on_localized: Callable[[int], None] = lambda done: None,
) -> dict[Row, Localization | None]:
    """Localize nodes of another map, which has all feature types of the localizer's map.

    `rows` are those of the nodes in `source_map`. `on_localized` is called with the number of nodes
    done so far. Return the localizations by row, None if a node is not localized.
    """
    answers: dict[Row, Localization | None] = {}
    for row in rows:
        features = {
            kind: source_map.layers[kind].nodes[row].features for kind in localizer.topomap.kinds
        }
        query = QueryImage.of_features(features, source_map.nodes[row].camera)
        result, *_ = localizer.localize_query(query)
        answers[row] = result if isinstance(result, Localization) else None
        on_localized(len(answers))
    return answers


def measure_recall_change(
    before: TopoMetricMap,
    after: TopoMetricMap,
    localizer_config: LocalizerConfig | None = None,
    max_queries: int = 24,
) -> dict[str, int]:
    """Count how many nodes of `before` the map localizes before and after an edit, each with the
    node itself hidden.

    At most `max_queries` nodes, evenly spaced, are localized. Return the counts by the names used
    in the map's history, none if `max_queries` is 0. Raises MapError and errors as of `Localizer`.
    """
    rows = sample_evenly(before.rows, max_queries)
    if not rows:
        return {}
    counts = {"earlier_asked": len(rows)}
    for name, topomap in (("before", before), ("after", after)):
        answers = localize_left_out(Localizer(topomap, localizer_config), before, rows, 0.0)
        counts[f"earlier_localized_{name}"] = sum(
            answer.is_localized for answer in answers.values()
        )
    return counts
