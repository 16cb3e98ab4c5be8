"""Generate pose proposals for a query image, cheapest and likeliest first.

`evidence.py` and `belief.py` judge them. The sources are:

- **prior**: the nodes nearest to the expected pose.
- **retrieval**: the pooled points of the nodes that the coarse localizer ranks first.
- **votes**: places that single features point to, if no pose is clear. A global descriptor sums up
  a whole image. An image that looks aside shares only its edge with the nodes of its place, so
  other nodes rank first. Therefore each of the strongest features votes for the place that holds
  its nearest neighbour. The vote is its lead in similarity over all other places. Votes by chance
  are small and spread over the map.
- **look-alikes**: similar places, if a pose is clear. A second place is hidden by the pool of the
  best candidates. If its nodes are in the pool, points of both places fail the ratio test. If they
  are not, they are not searched. So nodes with similar scores, far from the pose, are searched on
  their own.
- **viewpoints**: node viewpoints as pose priors. In darkness most true matches fail the ratio test,
  because some other descriptor is always as similar. A camera near a node sees the same points at
  about the same pixels, sizes and angles as the node. Among the few key points that fit, the most
  similar one is much more often right. Wrong nodes give matches with random displacements, the
  right node consistent ones. Only nodes with consistent displacements are refined.
- **repetition**: the shifted poses of each hypothesis in a repetitive place (`repetition.py`).
- **walls**: virtual views of the walls, seen from the reverse direction (`walls/`).

Each source reads the current belief and skips what it makes needless.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from topoloc.features.matching import Matcher, largest_similarities
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.belief import is_same_fit
from topoloc.localization.guided import count_consistent_displacements, match_predicted
from topoloc.localization.map_facts.repetition import MIN_SHIFT
from topoloc.localization.pose_fit import LocalMap, PoseFit, fit_pose
from topoloc.localization.provenance import Evidence
from topoloc.localization.refine import NodeProposal, fit_around
from topoloc.localization.search import Search, Source
from topoloc.mapping.nodes import node_distances
from topoloc.node_ids import Row
from topoloc.retrieval.coarse import NodeScore

_MAX_SAME_POSE_ANGLE = 0.25  # radians


def propose_first(search: Search, prior: Rigid3 | None) -> NodeProposal:
    """Propose a pose from the nodes nearest to an approximate pose (world_from_cam).

    If it is None, propose one from the nodes that the coarse localizer ranks first.
    """
    least = float(search.config.num_chance_inliers)
    if prior is None:
        proposal = _propose_from_nodes(search, "retrieval", _rank_nodes(search), least)
    else:
        distances = search.map.distances(prior)
        rows = search.map.nearest(prior, search.config.num_candidates)
        search.ranked = [NodeScore(row, -float(distances[row])) for row in rows]  # by Eq. 1
        proposal = _propose_from_nodes(search, "prior", rows, least)
    search.retrieved = proposal.fit
    return proposal


def propose_quick(search: Search, least: float) -> NodeProposal | None:
    """Return the proposal of retrieval with the strongest features only.

    None if fewer than `least` of them agree.
    """
    quick_proposal = match_and_fit(
        search,
        "retrieval",
        create_matcher(search, _rank_nodes(search)),
        least,
        search.config.num_first_features,
    )
    return quick_proposal if quick_proposal.fit.num_inliers >= least else None


def _rank_nodes(search: Search) -> list[Row]:
    """Rank the nodes with the coarse localizer and return the rows of the candidates."""
    features = search.query.features
    with search.query.clock.stage("coarse"):
        num_ranked = max(search.config.num_candidates, 48)
        search.ranked = search.map.coarse.rank(search.query.image, features, num_ranked)
    return [candidate.row for candidate in search.candidates]


def _propose_from_nodes(
    search: Search, source: Source, rows: list[Row], least: float
) -> NodeProposal:
    """Propose a pose from the pooled points of these nodes.

    The strongest features are matched first. All are matched if at least `least` of these agree but
    the pose is not clear.
    """
    config, matcher = search.config, create_matcher(search, rows)
    proposal = match_and_fit(search, source, matcher, least, config.num_first_features)
    is_open = least <= proposal.fit.num_inliers < config.num_clear_inliers
    if is_open and len(search.query.features) > config.num_first_features:
        proposal = match_and_fit(search, source, matcher, least)
    return proposal


def create_matcher(search: Search, rows: list[Row]) -> tuple[LocalMap, Matcher]:
    """Return the points of these nodes and a matcher of the query's features with them."""
    points = search.map.local_map(rows)
    return points, Matcher(
        search.query.features.descriptors,
        points.descriptors,
        (points.points_world, points.radii),
        search.config.matching,
    )


def match_and_fit(
    search: Search,
    source: Source,
    points_and_matcher: tuple[LocalMap, Matcher],
    least: float,
    max_features: int | None = None,
) -> NodeProposal:
    """Match the points of nodes and fit a pose by robust PnP.

    The pose is None if there are fewer than `least` or `min_matches` matches.
    """
    query, config, (local_map, matcher) = search.query, search.config, points_and_matcher
    with query.clock.stage("matching"):
        matches = matcher.match_first(max_features)
    matched = query.features, query.input_camera, local_map, matches
    with query.clock.stage("pnp"):
        least, rho = max(float(config.min_matches), least), search.correlated_error_share
        fit = fit_pose(*matched, config.pose, min_matches=least, correlated_error_share=rho)
    return NodeProposal(search, source, fit, is_guided=False)


def propose_voted_places(search: Search) -> Iterator[NodeProposal]:
    """Propose a pose in each place with many votes, most votes first."""
    with search.query.clock.stage("coarse"):
        places = list(find_places(search))
    yield from propose_places(search, "votes", places)


def propose_places(
    search: Search, source: Source, places: list[list[Row]]
) -> Iterator[NodeProposal]:
    """Propose a pose from the nodes of each place, if more agree than by chance."""
    config, least = search.config, float(search.config.num_chance_inliers)
    for rows in places:
        matcher = create_matcher(search, rows)
        proposal = match_and_fit(search, source, matcher, least, config.num_first_features)
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
        yield select_nodes(search, rows, np.where(here, of_nodes, -1.0), int(here.sum()))
        of_places[here] = 0.0


def select_nodes(
    search: Search, rows: list[Row], scores: Float[np.ndarray, " nodes"], max_nodes: int
) -> list[Row]:
    """Return the nodes with the largest scores, as many as are pooled, at most `max_nodes`."""
    order = np.argsort(-scores, kind="stable")
    return [rows[k] for k in order[: min(search.config.num_candidates + 1, max_nodes)]]


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
    max_lag = 0.02  # similarity: a node this near to the nearest one shows the feature, too
    num_features = 64
    query = search.query
    rows, apart = rank_places(search)
    if not rows or not len(query.features):
        return [], np.zeros((0, 0)), np.zeros(0), np.zeros(0)
    strongest = query.features.descriptors[:num_features]
    similarities = similarities_to_nodes(search, rows, strongest)
    nearest, largest = similarities.argmax(axis=0), similarities.max(axis=0)
    elsewhere = np.where(apart[:, nearest] > 2.0, similarities, -1.0).max(axis=0)
    # where no node is elsewhere, a feature leads over none
    leads = np.where(elsewhere > -1.0, np.maximum(largest - elsewhere, 0.0), 0.0)
    of_places = (apart <= 1.0) @ np.bincount(nearest, leads, len(rows))
    return rows, apart, of_places, (similarities >= largest - max_lag) @ leads


def rank_places(search: Search) -> tuple[list[Row], Float[np.ndarray, "nodes nodes"]]:
    """Return the nodes that rank first and have points, and how far apart they are."""
    max_nodes = 128
    query = search.query
    ranked = search.map.coarse.rank(query.image, query.features, max_nodes)
    rows = list(dict.fromkeys(one.row for one in ranked))
    points = zip(rows, search.map.local_maps(rows), strict=True)
    rows = [row for row, one in points if len(one.descriptors)]
    return rows, _distances_between(search, rows)


def similarities_to_nodes(
    search: Search, rows: list[Row], descriptors: Float32[np.ndarray, "n d"]
) -> Float[np.ndarray, "nodes n"]:
    """Return the similarity of descriptors to the most similar point of each node."""
    points = search.map.local_maps(rows)
    return largest_similarities(descriptors, [one.descriptors for one in points])


def _distances_between(search: Search, rows: list[Row]) -> Float[np.ndarray, "nodes nodes"]:
    """Return how far apart nodes are. Up to 1 they show one place: 3 D_thresh or 0.5 radians."""
    poses = search.map.node_poses
    centres, axes = poses.centres[rows], poses.rotations[rows, :, 2]
    angles = np.arccos(np.clip(axes @ axes.T, -1.0, 1.0))
    metres = np.linalg.norm(centres[:, None] - centres, axis=2)
    return metres / (3.0 * search.map.d_thresh) + angles / 0.5


def propose_similar_places(search: Search) -> Iterator[NodeProposal]:
    """Propose poses in similar places, far from the best pose, which is clear.

    They are groups of nodes with nearly the best coarse score.
    """
    min_score_share = 0.85  # minimum score of a similar place, as a share of the best score
    # Nodes within this many D_thresh of a pose (Eq. 1) belong to its place. Similar places
    # are farther away.
    num_d_thresh = 5.0
    config, best, nodes = search.config.look_alikes, search.best, search.map.node_poses
    if not search.ranked or not config.max_groups or search.is_hopeless:
        return
    least = min_score_share * search.ranked[0].score
    left = [candidate.row for candidate in search.ranked if candidate.score >= least]
    queried = {candidate.row for candidate in search.candidates}
    reach = num_d_thresh * search.map.d_thresh
    if best is not None and best.probability >= search.config.evidence.min_probability:
        far = search.map.distances(best.world_from_cam) > reach
        left = [row for row in left if far[row]]
    num_groups = 0
    while left and num_groups < config.max_groups:
        leader = nodes.world_from_node(left[0])
        near = node_distances(leader, nodes, search.map.lambda_rot) <= reach
        group, left = [row for row in left if near[row]], [row for row in left if not near[row]]
        if set(group) != queried:
            num_groups, least = num_groups + 1, min_rival_inliers(search)
            proposal = _propose_from_nodes(
                search, "look-alikes", group[: search.config.num_candidates], least
            )
            if proposal.fit.num_inliers >= least:
                yield proposal


def min_rival_inliers(search: Search) -> float:
    """Return the minimum number of inliers of another place, among the strongest features.

    It is more than chance and a share of the inliers of the best pose.
    """
    # Minimum inliers of a similar place, as a share of the best pose's inliers. A place with
    # fewer, from the image's strongest features, is not refined.
    min_share = 0.25
    best, config, least = search.best, search.config, float(search.config.num_chance_inliers)
    if best is None or best.probability < config.evidence.min_probability:
        return least
    found = best.fit.inlier_query_idx
    share_of_strongest = np.count_nonzero(found < config.num_first_features) / max(len(found), 1)
    return max(least, min_share * best.evidence.num_inliers * share_of_strongest)


def propose_node_viewpoints(search: Search) -> Iterator[NodeProposal]:
    """Propose poses from node viewpoints, most consistent first.

    Each node predicts its own points at its own pose. Nodes with consistent displacements are
    fitted.
    """
    # Maximum difference between the displacements of consistent matches, in pixels of an
    # image whose longer side is 640. Scales with the image size.
    shift_px = 12.0
    # A node is accepted if at least this many matches are consistent, plus `chance_share` of
    # its matches.
    min_alike = 8
    chance_share = 0.09  # share of a node's matches that is added to `min_alike`
    max_iterations = 500  # RANSAC iterations for each fit
    # Number of accepted nodes, those with the most consistent matches, for which a pose is
    # fitted.
    max_fits = 6
    max_poses = 4  # number of fitted poses, those with the most inliers, that become proposals
    if search.is_hopeless:
        return
    config, query, found = search.config.viewpoints, search.query, []
    features, camera = query.features, query.camera
    rows = [candidate.row for candidate in search.ranked[: config.num_nodes]]
    with query.clock.stage("matching"):
        predictions = search.map.predict_at_nodes(rows, camera)
        for local_map, predicted in zip(search.map.local_maps(rows), predictions, strict=True):
            matches = match_predicted(features, local_map, predicted, camera, config.matching)
            num_alike = count_consistent_displacements(
                features, matches, predicted, camera, shift_px
            )
            if num_alike >= min_alike + chance_share * len(matches):
                found.append((num_alike, local_map, matches))
    found.sort(key=lambda one: -one[0])
    quick = replace(search.config.pose, max_iterations=max_iterations)
    # in a repetitive place many nodes see the same, and the right one is no better than the others
    more = 3 if found and len(search.map.repeats(search.ranked[0].row)) else 1
    with query.clock.stage("pnp"):
        fits = [
            fit_pose(query.features, query.input_camera, local_map, matches, quick)
            for _, local_map, matches in found[: more * max_fits]
        ]
    kept: list[PoseFit] = []
    for fit in sorted(fits, key=lambda fit: -fit.num_inliers):
        if isinstance(fit, PoseFit) and not any(
            is_same_fit(fit, other, search.config.evidence) for other in kept
        ):
            kept.append(fit)
            yield NodeProposal(search, "viewpoints", fit)
        if len(kept) == more * max_poses:
            return


def propose_from_other_features(search: Search) -> Iterator[NodeProposal]:
    """Propose the poses of the preceding feature type if this one is not clear."""
    config, previous = search.config, search.previous
    if previous is None or search.is_clear or config.guided.num_nodes == 0:
        return
    for hypothesis in previous.belief.hypotheses[:3]:
        fit, least = hypothesis.fit, float(config.evidence.min_found)
        yield from _propose_around(search, "other features", fit.world_from_cam, fit.camera, least)


def propose_repetitions(search: Search) -> Iterator[NodeProposal]:
    """Propose the repeated poses of the probable hypotheses, and the repetitions of new ones."""
    config, tried, num_asked = search.config, list[Rigid3](), 0
    waiting = search.belief.of_nodes
    while waiting and config.guided.num_nodes > 0:
        hypothesis = waiting.pop(0)
        if hypothesis.probability < config.evidence.min_probability:
            continue
        tried.append(hypothesis.world_from_cam)
        for move in search.map.moves(search.map.topomap.row_of(hypothesis.fit.node_id)):
            world_from_cam = Rigid3(move[:3, :3], move[:3, 3]) @ hypothesis.world_from_cam
            known = [*tried, *(other.world_from_cam for other in search.belief.hypotheses)]
            if any(
                world_from_cam.is_same(other, MIN_SHIFT, _MAX_SAME_POSE_ANGLE) for other in known
            ):
                continue
            if num_asked == config.max_repetitions:
                return
            num_asked += 1
            tried.append(world_from_cam)
            least = 0.2 * hypothesis.evidence.num_found  # far fewer points refute a repetition
            previous, camera = search.belief.hypotheses, hypothesis.fit.camera
            yield from _propose_around(
                search, "repetition", world_from_cam, camera, least, hypothesis.evidence
            )
            waiting += [other for other in search.belief.hypotheses if other not in previous]


def _propose_around(
    search: Search,
    source: Source,
    world_from_cam: Rigid3,
    camera: Camera,
    least: float,
    repeats: Evidence | None = None,
) -> Iterator[NodeProposal]:
    """Propose the pose of guided matches around a pose, which is accurate to a few centimetres.

    There is no proposal if fewer than `least` matches agree.
    """
    radius_px = 2.0 * search.config.guided.radius_px
    fit = fit_around(search, world_from_cam.inverse(), camera, radius_px, least)
    if isinstance(fit, PoseFit) and fit.num_inliers >= least:
        yield NodeProposal(search, source, fit, repeats=repeats)
