"""Generate pose proposals for a query image, cheapest and likeliest first.

`evidence.py` and `belief.py` judge them. The sources are:

- **prior**: the nodes nearest to the expected pose.
- **retrieval**: the pooled points of the nodes that the coarse localizer ranks first.
- **look-alikes**: similar places. A second place is hidden by the pool of the best candidates. If
  its nodes are in the pool, points of both places fail the ratio test. If they are not, they are
  not searched. So nodes with similar scores, far from the current best pose, are searched on their
  own.
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

from topoloc.features.matching import Matcher
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.belief import Hypothesis, is_same_fit
from topoloc.localization.guided import (
    count_consistent_displacements,
    match_guided,
    match_predicted,
)
from topoloc.localization.map_facts.repetition import MIN_SHIFT
from topoloc.localization.pose_fit import LocalMap, PointMatches, PoseFit, fit_pose
from topoloc.localization.search import Proposal, Search, Source
from topoloc.localization.walls.propose_virtual_views import propose_virtual_views
from topoloc.mapping.nodes import node_distances
from topoloc.node_ids import Row
from topoloc.retrieval.coarse import NodeScore

_MAX_SAME_POSE_ANGLE = 0.25  # radians


def propose(search: Search, prior: Rigid3 | None) -> Iterator[Proposal]:
    """Generate the pose proposals lazily.

    With a prior there is one proposal. If another feature type follows and the pose is not clear,
    only retrieval is used.
    """
    if prior is not None:
        rows = [candidate.row for candidate in _nearest_nodes(search, prior)]
        yield _propose_from_nodes(search, "prior", rows, float(search.config.num_chance_inliers))
        return
    rows = _rank_nodes(search)
    retrieved = _propose_from_nodes(
        search, "retrieval", rows, float(search.config.num_chance_inliers)
    )
    search.retrieved = retrieved.fit
    yield retrieved
    if search.is_last or search.is_clear:
        yield from _propose_from_other_features(search)
        yield from propose_more(search)


def propose_more(search: Search) -> Iterator[Proposal]:
    """Generate the proposals that follow retrieval."""
    viewpoints = [] if search.is_clear else list(_propose_node_viewpoints(search))
    yield from viewpoints
    assert search.retrieved is not None
    if (
        search.is_clear
        or viewpoints
        or search.retrieved.num_inliers >= search.config.num_chance_inliers
    ):
        yield from _propose_similar_places(search)
    yield from _propose_repetitions(search)
    yield from propose_virtual_views(search)


def propose_quick(search: Search, least: float) -> Proposal | None:
    """Return the proposal of retrieval with the strongest features only.

    None if fewer than `least` of them agree.
    """
    quick_proposal = _match_and_fit(
        search,
        "retrieval",
        _create_matcher(search, _rank_nodes(search)),
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


def _nearest_nodes(search: Search, world_from_cam: Rigid3) -> list[NodeScore]:
    """Return `num_candidates` nodes nearest to a pose. The score is the negative distance (Eq.
    1)."""
    distances = search.map.distances(world_from_cam)
    rows = search.map.nearest(world_from_cam, search.config.num_candidates)
    search.ranked = [NodeScore(row, -float(distances[row])) for row in rows]
    return search.ranked


def _propose_from_nodes(search: Search, source: Source, rows: list[Row], least: float) -> Proposal:
    """Propose a pose from the pooled points of these nodes.

    The strongest features are matched first. All are matched if at least `least` of these agree but
    the pose is not clear.
    """
    config, matcher = search.config, _create_matcher(search, rows)
    proposal = _match_and_fit(search, source, matcher, least, config.num_first_features)
    is_open = least <= proposal.fit.num_inliers < config.num_clear_inliers
    if is_open and len(search.query.features) > config.num_first_features:
        proposal = _match_and_fit(search, source, matcher, least)
    return proposal


def _create_matcher(search: Search, rows: list[Row]) -> tuple[LocalMap, Matcher]:
    """Return the points of these nodes and a matcher of the query's features with them."""
    points = search.map.local_map(rows)
    return points, Matcher(
        search.query.features.descriptors,
        points.descriptors,
        (points.points_world, points.radii),
        search.config.matching,
    )


def _match_and_fit(
    search: Search,
    source: Source,
    points_and_matcher: tuple[LocalMap, Matcher],
    least: float,
    max_features: int | None = None,
) -> Proposal:
    """Match the points of nodes and fit a pose by robust PnP.

    The pose is None if there are fewer than `least` or `min_matches` matches.
    """
    query, (local_map, matcher) = search.query, points_and_matcher
    with query.clock.stage("matching"):
        matches = matcher.match_first(max_features)
    if len(matches) < max(search.config.min_matches, least):
        return Proposal(
            source,
            PointMatches(query.features, query.input_camera, query.camera, local_map, matches),
            is_guided=False,
        )
    with query.clock.stage("pnp"):
        return Proposal(
            source,
            fit_pose(query.features, query.input_camera, local_map, matches, search.config.pose),
            is_guided=False,
        )


def _propose_similar_places(search: Search) -> Iterator[Proposal]:
    """Propose poses in similar places, far from the best pose.

    They are groups of nodes with nearly the best coarse score.
    """
    # Minimum score of a similar place, as a share of the best score: if the pose is clear,
    # and if it is not.
    min_score_share = (0.85, 0.4)
    # Nodes within this many D_thresh of a pose (Eq. 1) belong to its place. Similar places
    # are farther away.
    num_d_thresh = 5.0
    config, best, nodes = search.config.look_alikes, search.best, search.map.node_poses
    if not search.ranked or not config.max_groups:
        return
    least = min_score_share[0 if search.is_clear else 1] * search.ranked[0].score
    left = [candidate.row for candidate in search.ranked if candidate.score >= least]
    queried = {candidate.row for candidate in search.candidates}
    reach = num_d_thresh * search.map.d_thresh
    if best is not None and best.probability >= search.config.evidence.min_probability:
        far = search.map.distances(best.world_from_cam) > reach
        left = [row for row in left if far[row]]
    num_groups = 0
    while left and num_groups < config.max_groups:
        leader = Rigid3(nodes.rotations[left[0]], nodes.centres[left[0]])
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


def _propose_node_viewpoints(search: Search) -> Iterator[Proposal]:
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
    config, query = search.config.viewpoints, search.query
    found = []
    with query.clock.stage("matching"):
        for candidate in search.ranked[: config.num_nodes]:
            row = candidate.row
            local_map, predicted = (
                search.map.local_map([row]),
                search.map.predict_at_node(row, query.camera),
            )
            matches = match_predicted(
                query.features, local_map, predicted, query.camera, config.matching
            )
            num_alike = count_consistent_displacements(
                query.features, matches, predicted, query.camera, shift_px
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
            yield Proposal("viewpoints", fit, is_guided=True)
        if len(kept) == more * max_poses:
            return


def _propose_from_other_features(search: Search) -> Iterator[Proposal]:
    """Propose the poses of the preceding feature type if this one is not clear."""
    config, previous = search.config, search.previous
    if previous is None or search.is_clear or config.guided.num_nodes == 0:
        return
    likeliest = previous.belief.ranked(previous.weights.rivals)[:3]
    for hypothesis in likeliest:
        fit = _fit_around_pose(
            search,
            hypothesis.world_from_cam,
            hypothesis.fit.camera,
            float(config.evidence.min_found),
        )
        if fit is not None:
            yield Proposal("other features", fit, is_guided=True)


def _propose_repetitions(search: Search) -> Iterator[Proposal]:
    """Propose the repeated poses of the probable hypotheses, and the repetitions of new ones."""
    config, tried, num_asked = search.config, list[Rigid3](), 0
    waiting = [one for one in search.belief.hypotheses if not one.is_from_virtual_views]
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
            num_asked, search.is_repetitive = num_asked + 1, True
            tried.append(world_from_cam)
            fit = _fit_moved_pose(search, world_from_cam, hypothesis)
            if fit is None:
                continue
            previous = set(map(id, search.belief.hypotheses))
            yield Proposal("repetition", fit, is_guided=True, repeats=hypothesis.evidence)
            waiting += [other for other in search.belief.hypotheses if id(other) not in previous]


def _fit_moved_pose(
    search: Search, world_from_cam: Rigid3, hypothesis: Hypothesis
) -> PoseFit | None:
    """Fit a pose around a repeated pose, which is accurate to a few centimetres.

    None if far fewer points are found than at the original pose.
    """
    return _fit_around_pose(
        search,
        world_from_cam,
        hypothesis.fit.camera,
        0.2 * hypothesis.evidence.num_found,  # far fewer points refute a repetition
    )


def _fit_around_pose(
    search: Search, world_from_cam: Rigid3, camera: Camera, least: float
) -> PoseFit | None:
    """Fit a pose to guided matches around a pose. None if fewer than `least` agree."""
    query, config, start = search.query, search.config, (world_from_cam.inverse(), camera)
    with query.clock.stage("matching"):
        local_map = search.map.local_map(
            search.map.nearest(world_from_cam, config.guided.num_nodes)
        )
        matches = match_guided(
            query.features,
            local_map,
            *start,
            replace(config.guided, radius_px=2.0 * config.guided.radius_px),
        )
    if len(matches) < least:
        return None
    with query.clock.stage("pnp"):
        fit = fit_pose(query.features, query.input_camera, local_map, matches, config.pose, start)
    return fit if isinstance(fit, PoseFit) and fit.num_inliers >= least else None
