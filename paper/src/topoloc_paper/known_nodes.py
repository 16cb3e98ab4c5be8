"""A coarse localizer that is told the truth, so that only the fine step is left to be wrong."""

from __future__ import annotations

from typing import Any

import numpy as np

from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import NodeScore


class KnownNodes:
    """Names the nodes nearest by Eq. 1 to where each query was taken, query after query."""

    def __init__(self, topomap: TopoMetricMap, world_from_cams: list[Rigid3]) -> None:
        self._nodes = NodePoses.of([summary.world_from_cam for summary in topomap.summaries])
        self._lambda_rot = topomap.config.lambda_rot
        self._truths = iter(world_from_cams)

    def rank(self, image: Any, features: Any, num_candidates: int) -> list[NodeScore]:
        distances = node_distances(next(self._truths), self._nodes, self._lambda_rot)
        return [
            NodeScore(int(i), -float(distances[i]))
            for i in np.argsort(distances, kind="stable")[:num_candidates]
        ]
