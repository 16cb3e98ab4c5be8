"""Propose places by votes of single features, for an image that shows a node's view in part only.

A global descriptor sums up a whole image. An image that looks aside shares only its edge with the
nodes of its place, so other nodes rank first. Therefore each of the strongest features votes for
the place that holds its nearest neighbour. The vote is its lead in similarity over all other
places. Votes by chance are small and spread over the map.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from topoloc.features.matching import largest_similarities
from topoloc.localization.proposals.propose import create_matcher, match_and_fit
from topoloc.localization.refine import NodeProposal
from topoloc.localization.search import Search
from topoloc.node_ids import Row


def propose_voted_places(search: Search) -> Iterator[NodeProposal]:
    """Propose a pose in each place with many votes, most votes first.

    They are not counted if the retrieved nodes agree by chance only, to refuse quickly.
    """
    least, config = float(search.config.num_chance_inliers), search.config
    if search.num_retrieved < least:
        return
    with search.query.clock.stage("coarse"):
        places = list(find_places(search))
    for rows in places:
        matcher = create_matcher(search, rows)
        proposal = match_and_fit(search, "votes", matcher, least, config.num_first_features)
        if proposal.fit.num_inliers >= least:
            yield proposal


def find_places(search: Search) -> Iterator[list[Row]]:
    """Generate the nodes of each place that are pooled. There are none if chance explains the
    votes."""
    max_places, min_share = 4, 0.3  # minimum votes of a place, as a share of the most
    rows, apart, of_places, of_nodes = count_votes(search)
    least = max(min_share * of_places.max(initial=0.0), search.weights.stop.min_votes)
    for _ in range(max_places):
        if of_places.max(initial=0.0) < least or least == 0.0:
            return
        here = apart[int(np.argmax(of_places))] <= 1.0
        order = np.argsort(-np.where(here, of_nodes, -1.0), kind="stable")
        num_nodes = min(search.config.num_candidates + 1, int(here.sum()))
        yield [rows[k] for k in order[:num_nodes]]
        of_places[here] = 0.0


def count_votes(
    search: Search,
) -> tuple[
    list[Row],
    Float[np.ndarray, "nodes nodes"],
    Float[np.ndarray, " nodes"],
    Float[np.ndarray, " nodes"],
]:
    """Return the nodes, how far apart they are, the votes of the place around each node, and of
    features that each node shows itself."""
    max_nodes = 128  # of a larger map, the nodes that rank first
    max_lag = 0.02  # similarity: a node this near to the nearest one shows the feature, too
    num_features = 64
    query = search.query
    ranked = search.map.coarse.rank(query.image, query.features, max_nodes)
    rows = list(dict.fromkeys(one.row for one in ranked))
    points = dict(zip(rows, search.map.local_maps(rows), strict=True))
    rows = [row for row in rows if len(points[row].descriptors)]
    if not rows or not len(query.features):
        return [], np.zeros((0, 0)), np.zeros(0), np.zeros(0)
    apart = _distances_between(search, rows)
    strongest = query.features.descriptors[:num_features]
    similarities = largest_similarities(strongest, [points[row].descriptors for row in rows])
    nearest, largest = similarities.argmax(axis=0), similarities.max(axis=0)
    elsewhere = np.where(apart[:, nearest] > 2.0, similarities, -1.0).max(axis=0)
    # where no node is elsewhere, a feature leads over none
    leads = np.where(elsewhere > -1.0, np.maximum(largest - elsewhere, 0.0), 0.0)
    of_places = (apart <= 1.0) @ np.bincount(nearest, leads, len(rows))
    return rows, apart, of_places, (similarities >= largest - max_lag) @ leads


def _distances_between(search: Search, rows: list[Row]) -> Float[np.ndarray, "nodes nodes"]:
    """Return how far apart nodes are. Up to 1 they show one place: 3 D_thresh or 0.5 radians."""
    poses = search.map.node_poses
    centres, axes = poses.centres[rows], poses.rotations[rows, :, 2]
    angles = np.arccos(np.clip(axes @ axes.T, -1.0, 1.0))
    metres = np.linalg.norm(centres[:, None] - centres, axis=2)
    return metres / (3.0 * search.map.d_thresh) + angles / 0.5
