"""Propose places by votes of single features, for an image that shows a node's view in part only.

A global descriptor sums up a whole image. An image that looks aside shares only its edge with the
nodes of its place, and other nodes rank first. So each of the strongest features votes for the
place that holds its nearest neighbour, by how much nearer it is than any of another place. Few
votes by chance fall on one place.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float32

from topoloc.localization.propose import create_matcher, match_and_fit
from topoloc.localization.refine import NodeProposal
from topoloc.localization.search import Search
from topoloc.node_ids import Row


def propose_voted_places(search: Search) -> Iterator[NodeProposal]:
    """Propose a pose in each of the places with the most votes."""
    max_places = 4
    least = float(search.config.num_chance_inliers)
    for rows in list(_places(search, max_places)):
        matcher = create_matcher(search, rows)
        proposal = match_and_fit(search, "votes", matcher, least, search.config.num_first_features)
        if proposal.fit.num_inliers >= least:
            yield proposal


def _places(search: Search, max_places: int) -> Iterator[list[Row]]:
    """Generate the places with the most votes: the rows of nodes whose points are pooled."""
    min_share = 0.3  # minimum votes of a place, as a share of the most
    num_d_thresh = 3.0  # nodes within this many D_thresh (Eq. 1) show one place
    with search.query.clock.stage("coarse"):
        rows = _searched_rows(search)
        best = _best_similarities(search, rows)
        centres = search.map.node_poses.centres[rows]
        reach = num_d_thresh * search.map.d_thresh
        apart = np.linalg.norm(centres[:, None] - centres, axis=2)
        here = np.stack([best[:, apart[k] <= reach].max(axis=1) for k in range(len(rows))], axis=1)
        first = best.argmax(axis=1)
        elsewhere = np.where(apart[first] > 2.0 * reach, best, -1.0).max(axis=1)
        margins = np.maximum(best.max(axis=1) - elsewhere, 0.0)
        votes = (here >= best.max(axis=1, keepdims=True)) * margins[:, None]
        of_places, of_nodes = votes.sum(axis=0), ((best >= here - 0.02) * margins[:, None]).sum(axis=0)
    least = min_share * of_places.max()
    for _ in range(max_places):
        leader = int(np.argmax(of_places))
        if of_places[leader] < least or least == 0.0:
            return
        near = np.flatnonzero(apart[leader] <= reach)
        order = near[np.argsort(-of_nodes[near], kind="stable")]
        yield [rows[k] for k in order[: search.config.num_candidates + 1]]
        of_places[apart[leader] <= reach] = 0.0


def _searched_rows(search: Search) -> list[Row]:
    """Return the nodes whose points are searched: all, or those that rank first."""
    max_nodes = 128
    num = len(search.map.node_ids)
    if num <= max_nodes:
        return [Row(k) for k in range(num)]
    ranked = search.map.coarse.rank(search.query.image, search.query.features, max_nodes)
    return [one.row for one in ranked]


def _best_similarities(search: Search, rows: list[Row]) -> Float32[np.ndarray, "features nodes"]:
    """Return the largest similarity of each of the strongest features to a point of each node."""
    num_features = 96
    parts = [search.map.local_map([row]).descriptors for row in rows]
    firsts = np.cumsum([0, *(len(part) for part in parts[:-1])])
    found = search.query.features.descriptors[:num_features] @ np.concatenate(parts).T
    return np.maximum.reduceat(found, firsts, axis=1)
