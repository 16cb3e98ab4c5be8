"""Answer queries with the true nearest nodes in place of the coarse localizer's ranking.

Only the fine step can then be wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from topoloc.evaluation.metrics import EvaluatedQuery
from topoloc.evaluation.query_localization import find_frames_with_truth, localize_queries
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import as_rows
from topoloc.recordings.frame import StereoSequence
from topoloc.retrieval.coarse import NodeScore


class KnownNodes:
    """Rank the nodes by their distance (Eq. 1) to the true pose of the current query.

    A query may call `rank` any number of times, for example once per feature type.

    Attributes:
        world_from_cam: The true pose of the current query, in the world of the map. Set it
            before each query.
    """

    def __init__(self, topomap: TopoMetricMap) -> None:
        self._nodes = NodePoses.from_poses(
            [summary.world_from_cam for summary in topomap.summaries]
        )
        self._lambda_rot = topomap.config.lambda_rot
        self.world_from_cam: Rigid3 | None = None

    def rank(self, image: Any, features: Any, num_candidates: int) -> list[NodeScore]:
        """Return the rows of the nearest nodes, nearest first. `image` and `features` are not used.

        Raises:
            ValueError: `world_from_cam` is not set.
        """
        if self.world_from_cam is None:
            raise ValueError("set world_from_cam to the true pose before each query")
        distances = node_distances(self.world_from_cam, self._nodes, self._lambda_rot)
        nearest = np.argsort(distances, kind="stable")[:num_candidates]
        return [NodeScore(row, -float(distances[row])) for row in as_rows(nearest)]


def answer_with_known_nodes(
    topomap: TopoMetricMap,
    config: LocalizerConfig,
    sequence: StereoSequence,
    map_from_truth: Rigid3,
    progress: Callable[[str, int, int], None],
    label: str,
) -> list[EvaluatedQuery]:
    """Localize every frame that has a true pose, with the nodes nearest to this pose as candidates.

    Args:
        map_from_truth: The world of the sequence given in the world of the map.
        progress: Called with `label`, the number of finished frames and the number of all frames.
        label: The name of the recording in the answers.

    Raises:
        TrajectoryError: No frame has a true pose.
        CalibrationError: A frame has no camera.
    """
    known_nodes = KnownNodes(topomap)
    localizer = Localizer(topomap, config, known_nodes)
    answers: list[EvaluatedQuery] = []
    frames, poses = find_frames_with_truth(sequence), sequence.poses
    for done, i in enumerate(frames, start=1):
        world_from_cam = poses[i]
        assert world_from_cam is not None, "a frame with a true pose"
        known_nodes.world_from_cam = map_from_truth @ world_from_cam
        answers += localize_queries(localizer, sequence, map_from_truth, label=label, frames=[i])
        progress(label, done, len(frames))
    return answers
