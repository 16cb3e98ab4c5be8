"""What the rest of a map says of its own nodes: what is stored of a node is asked as a picture
would be, as if nobody had stood there.

A node is found by itself, however poor the place is. So it is left out, with those of its session
beside it where that is wished: of the points, of what names candidates, and of where points are
sought. What is asked are the node's local features as the file keeps them, those with a 3-D
position.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.localization.localizer import Localizer
from topoloc.localization.query import QueryImage
from topoloc.localization.result import Localization
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap

MAX_TRANSLATION, MAX_ROTATION_DEG = 0.5, 10.0
"""An answer further off than this (metres, degrees) is that of another place."""


@dataclass(frozen=True)
class LeaveOneOutResult:
    """What the rest of the map says of a node: `num_inliers` is 0 where it does not localize it, or
    elsewhere (`is_wrong`)."""

    is_localized: bool
    is_wrong: bool
    num_inliers: int


def sample_evenly(rows: Sequence[int], max_count: int) -> list[int]:
    """At most so many of these, spread over them in their order."""
    if len(rows) <= max_count:
        return list(rows)
    return [
        rows[k]
        for k in np.unique(np.linspace(0, len(rows) - 1, max_count).round().astype(int)).tolist()
    ]


def beside(
    topomap: TopoMetricMap, row: int, num_d_thresh: float, poses: NodePoses
) -> Int[np.ndarray, " k"]:
    """The rows of a node and of those of its session within so many D_thresh of it (Eq. 1)."""
    summary = topomap.summaries[row]
    near = np.flatnonzero(
        node_distances(summary.world_from_cam, poses, topomap.config.lambda_rot)
        <= num_d_thresh * topomap.config.d_thresh
    )
    same = [
        int(other)
        for other in near
        if topomap.summaries[int(other)].session_id == summary.session_id
    ]
    return np.array(sorted({row, *same}), np.int64)


def localize_left_out(
    localizer: Localizer,
    stored: TopoMetricMap,
    rows: Sequence[int],
    num_d_thresh: float,
    progress: Callable[[int, int], None] | None = None,
) -> dict[int, LeaveOneOutResult]:
    """What a map says of nodes of `stored`, which is this map or an earlier version of it, by their
    rows there."""
    known = {summary.node_id for summary in localizer.topomap.summaries}
    poses = NodePoses.of([summary.world_from_cam for summary in stored.summaries])
    answers = dict[int, LeaveOneOutResult]()
    for done, row in enumerate(rows):
        node = stored.nodes_of(stored.kind)[row]
        features = {kind: stored.nodes_of(kind)[row].features for kind in stored.kinds}
        near = [stored.summaries[int(k)].node_id for k in beside(stored, row, num_d_thresh, poses)]
        hidden = [node_id for node_id in near if node_id in known]
        is_all = len(hidden) == len(localizer.topomap.summaries)
        result = (
            None
            if is_all
            else localizer.without(hidden).localize_query(
                QueryImage.of_features(features, node.camera)
            )[0]
        )
        answers[row] = (
            _evaluate_result(result, node.summary.world_from_cam)
            if isinstance(result, Localization)
            else LeaveOneOutResult(False, False, 0)
        )
        if progress is not None:
            progress(done + 1, len(rows))
    return answers


def _evaluate_result(result: Localization, world_from_cam) -> LeaveOneOutResult:
    metres = translation_error(world_from_cam, result.world_from_cam)
    degrees = np.degrees(rotation_error(world_from_cam, result.world_from_cam))
    is_wrong = bool(metres > MAX_TRANSLATION or degrees > MAX_ROTATION_DEG)
    return LeaveOneOutResult(not is_wrong, is_wrong, 0 if is_wrong else result.num_inliers)
