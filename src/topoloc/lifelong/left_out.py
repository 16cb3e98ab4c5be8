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
from topoloc.localization.query import Picture
from topoloc.localization.result import Localization
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap

MAX_TRANSLATION, MAX_ROTATION_DEG = 0.5, 10.0
"""An answer further off than this (metres, degrees) is that of another place."""


@dataclass(frozen=True)
class LeftOutAnswer:
    """What the rest of the map says of a node: `num_inliers` is 0 where it does not localize it, or
    elsewhere (`is_wrong`)."""

    is_localized: bool
    is_wrong: bool
    num_inliers: int


def evenly(rows: Sequence[int], at_most: int) -> list[int]:
    """At most so many of these, spread over them in their order."""
    if len(rows) <= at_most:
        return list(rows)
    return [
        rows[k]
        for k in np.unique(np.linspace(0, len(rows) - 1, at_most).round().astype(int)).tolist()
    ]


def beside(
    topomap: TopoMetricMap, row: int, d_threshs: float, poses: NodePoses
) -> Int[np.ndarray, " k"]:
    """The rows of a node and of those of its session within so many D_thresh of it (Eq. 1)."""
    summary = topomap.summaries[row]
    near = np.flatnonzero(
        node_distances(summary.world_from_cam, poses, topomap.config.lambda_rot)
        <= d_threshs * topomap.config.d_thresh
    )
    same = [
        int(other)
        for other in near
        if topomap.summaries[int(other)].session_id == summary.session_id
    ]
    return np.array(sorted({row, *same}), np.int64)


def ask_left_out(
    localizer: Localizer,
    stored: TopoMetricMap,
    rows: Sequence[int],
    d_threshs: float,
    progress: Callable[[int, int], None] | None = None,
) -> dict[int, LeftOutAnswer]:
    """What a map says of nodes of `stored`, which is this map or an earlier version of it, by their
    rows there."""
    known = {summary.node_id for summary in localizer.topomap.summaries}
    poses = NodePoses.of([summary.world_from_cam for summary in stored.summaries])
    answers = dict[int, LeftOutAnswer]()
    for done, row in enumerate(rows):
        node = stored.nodes_of(stored.kind)[row]
        features = {kind: stored.nodes_of(kind)[row].features for kind in stored.kinds}
        near = [stored.summaries[int(k)].node_id for k in beside(stored, row, d_threshs, poses)]
        hidden = [node_id for node_id in near if node_id in known]
        is_all = len(hidden) == len(localizer.topomap.summaries)
        result = (
            None
            if is_all
            else localizer.without(hidden).ask(Picture.of_features(features, node.camera))[0]
        )
        answers[row] = (
            _judged(result, node.summary.world_from_cam)
            if isinstance(result, Localization)
            else LeftOutAnswer(False, False, 0)
        )
        if progress is not None:
            progress(done + 1, len(rows))
    return answers


def _judged(result: Localization, world_from_cam) -> LeftOutAnswer:
    metres = translation_error(world_from_cam, result.world_from_cam)
    degrees = np.degrees(rotation_error(world_from_cam, result.world_from_cam))
    is_wrong = bool(metres > MAX_TRANSLATION or degrees > MAX_ROTATION_DEG)
    return LeftOutAnswer(not is_wrong, is_wrong, 0 if is_wrong else result.num_inliers)
