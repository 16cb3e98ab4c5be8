"""Return the pose of the node that the coarse localizer ranks first.

This is place recognition alone, and the fallback of pipelines that never refuse a query (hloc
writes the pose of the nearest image if PnP fails). It shows the gain of the fine step, and answers
every query.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from topoloc.features.extraction import extract_features
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import Image, StereoFrame, to_grey
from topoloc.retrieval.coarse import open_coarse_localizer
from topoloc_paper.peer_answers import PeerAnswer


class Retrieval:
    """The coarse localizer of a map, `surf-vlad`."""

    def __init__(self, topomap: TopoMetricMap) -> None:
        self._features = topomap.config.features
        self._world_from_nodes = [summary.world_from_cam for summary in topomap.summaries]
        model = topomap.first_layer.coarse_models["surf-vlad"]
        self._coarse = open_coarse_localizer(model)
        self.map_bytes = sum(array.nbytes for array in model.arrays.values())

    def nodes(self, image: Image, num: int) -> list[int]:
        """The rows of the `num` best nodes, best first."""
        return [
            score.row
            for score in self._coarse.rank(
                image, extract_features(to_grey(image), self._features), num
            )
        ]

    def localize(self, frames: Sequence[StereoFrame]) -> list[PeerAnswer]:
        answers = []
        for frame in frames:
            start = time.perf_counter()
            (row,) = self.nodes(frame.image, 1)
            answers.append(
                PeerAnswer(self._world_from_nodes[row], 1e3 * (time.perf_counter() - start))
            )
        return answers
