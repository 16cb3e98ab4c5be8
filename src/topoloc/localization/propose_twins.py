"""Propose poses in places that look like one part of an image, if the image is far from all nodes.

An image that looks aside shares its edge with the nodes of its place, so other nodes rank first. A
door there may show all that agrees, while the place of the image is not searched: what places have
in common does not vote (`propose.py`).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from topoloc.localization.belief import Hypothesis
from topoloc.localization.propose import (
    propose_places,
    rank_places,
    select_nodes,
    similarities_to_nodes,
)
from topoloc.localization.refine import NodeProposal
from topoloc.localization.search import Search
from topoloc.node_ids import Row


def propose_twins(search: Search) -> Iterator[NodeProposal]:
    """Propose poses in other places that show the inliers of the best pose, if it is not clear and
    far from all nodes."""
    of_nodes = search.belief.of_nodes
    if not of_nodes or search.is_clear or search.is_hopeless:
        return
    if search.map.remoteness(of_nodes[0].world_from_cam) > 1.0:
        with search.query.clock.stage("coarse"):
            places = list(_find_twins(search, of_nodes[0]))
        yield from propose_places(search, "look-alikes", places)


def _find_twins(search: Search, best: Hypothesis) -> Iterator[list[Row]]:
    """Generate the nodes of each other place that shows some of the inliers of a pose, most
    first."""
    max_places, num_features, min_share, max_lag = 4, 64, 0.2, 0.05  # lag in similarity
    (rows, apart), own = rank_places(search), search.map.topomap.row_of(best.fit.node_id)
    if not rows:
        return
    found = np.sort(best.fit.inlier_query_idx)[:num_features]
    similarities = similarities_to_nodes(search, rows, search.query.features.descriptors[found])
    shown = similarities >= similarities.max(axis=0) - max_lag
    if own in rows:
        shown[apart[rows.index(own)] <= 2.0] = False
    for _ in range(max_places):
        # features that any node of a place shows
        counts = np.array([np.count_nonzero(shown[one <= 1.0].any(axis=0)) for one in apart])
        if counts.max(initial=0) < min_share * len(found):
            return
        here = apart[int(counts.argmax())] <= 1.0
        of_nodes = np.where(here, shown.sum(axis=1), 0.0)
        yield select_nodes(search, rows, of_nodes, int(np.count_nonzero(of_nodes)))
        shown[here] = False
