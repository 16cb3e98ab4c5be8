"""Refine a pose proposal of the map's nodes into a hypothesis, and confirm hypotheses.

The map points are matched again near their predicted pixels, the pose is estimated again, and the
evidence is counted. The nodes nearest to the proposal supply the points, because they were measured
from nearly the same place. Within a few pixels, matches are safe that the ratio test must reject
among thousands of descriptors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.answer import Answer, lead
from topoloc.localization.belief import Belief, Hypothesis
from topoloc.localization.evidence import (
    compute_best_case_evidence,
    compute_evidence,
    create_unguided_matcher,
)
from topoloc.localization.guided import match_guided
from topoloc.localization.pose_fit import PointMatches, PoseFit, fit_pose
from topoloc.localization.provenance import Evidence
from topoloc.localization.search import Proposal, Search
from topoloc.node_ids import Row


@dataclass(frozen=True, eq=False)
class NodeProposal(Proposal):
    """Hold a pose proposal of the map's nodes.

    `is_guided` is True if a pose guided the matches, which are then no evidence for it. `repeats`
    is the evidence for the pose that this proposal repeats elsewhere. The unguided matches support
    both.
    """

    is_guided: bool = True
    repeats: Evidence | None = None

    def refine(self) -> PointMatches | None:
        """Return the pose refitted to guided matches, or the proposal if it has too few inliers.

        A repeated pose is refined already. None if the pose was found already.
        """
        if self.repeats is not None:
            return self.fit
        return None if is_already_found(self) else refine(self)

    def score(self, final: PointMatches) -> Hypothesis | None:
        """Return the refined pose as a hypothesis. None if too few points were found.

        The evidence comes from unguided matches, of the proposal or around the refined pose.
        """
        search, config, first = self.search, self.search.config.evidence, self.fit
        if (
            not isinstance(first, PoseFit)
            or not isinstance(final, PoseFit)
            or first.num_inliers < config.min_inliers
            or final.num_inliers < config.min_found
        ):
            return None
        with search.query.clock.stage("evidence"):
            inflated = 1.0 + final.num_inliers * search.correlated_error_share
            covariance = final.pose.inflated(inflated)
            unguided = None if self.is_guided else first
            evidence = compute_evidence(search, final, covariance, unguided, self.repeats)
            if evidence is None:
                return None
            log_odds = search.weights.log_odds(evidence)
        noise_share = final.pose.noise_share(inflated)
        return Hypothesis(self.source, final, evidence, covariance, noise_share, log_odds)


def is_already_found(proposal: NodeProposal) -> bool:
    """Return whether the proposal would lead to a pose that was found already.

    It does if it projects most inliers of a probable hypothesis to nearly the same pixels.
    """
    search, fit, config = proposal.search, proposal.fit, proposal.search.config
    if not isinstance(fit, PoseFit):
        return False
    radius_px = config.guided.radius_px * fit.camera.radius_scale
    for known in search.belief.of_nodes:
        if known.probability < config.evidence.min_probability:
            continue
        apart = known.fit.inlier_observations(1.0).errors_px(fit.camera, fit.pose.cam_from_world)
        min_shared = 0.75 * len(apart)  # the rest may be occluded or out of view
        with np.errstate(invalid="ignore"):
            num_shared = np.count_nonzero(apart < radius_px)
        if num_shared >= min_shared:
            return True
    return False


def refine(proposal: NodeProposal) -> PointMatches:
    """Return the pose refitted to guided matches, or the proposal if it has too few inliers."""
    search, first = proposal.search, proposal.fit
    final = refit_around(search, first)
    is_clear = first.num_inliers >= search.config.num_clear_inliers
    is_by_chance = first.num_inliers < search.config.num_chance_inliers
    if isinstance(first, PoseFit) and not is_by_chance and final.num_inliers < first.num_inliers:
        # Around a bend the nearest nodes see another place than the image and the nodes it matched.
        final = max(final, _refit_with_own_nodes(search, first), key=lambda fit: fit.num_inliers)
    if not is_clear:  # a poor first pose may need a second round to find all points
        final = max(final, refit_around(search, final), key=lambda fit: fit.num_inliers)
    before = first.camera
    for _ in range(3):  # matches around another camera hold the estimate back
        if final.camera.is_similar(before):
            break
        before, final = final.camera, refit_around(search, final)
    return final


def _refit_with_own_nodes(search: Search, first: PoseFit) -> PointMatches:
    """Return the pose refitted to guided matches with the nodes that have most of its inliers."""
    config = search.config.guided
    node_ids, counts = np.unique(
        first.local_map.node_ids[first.inlier_point_idx], return_counts=True
    )
    most = node_ids[np.argsort(-counts, kind="stable")[: config.num_nodes]]
    rows = search.map.topomap.rows_of(most)
    return fit_around(search, first.pose.cam_from_world, first.camera, config.radius_px, rows=rows)


def refit_around(search: Search, fit: PointMatches) -> PointMatches:
    """Return the pose refitted to guided matches. If it has too few inliers, return the fit."""
    config = search.config
    if (
        config.guided.num_nodes == 0
        or not isinstance(fit, PoseFit)
        or fit.num_inliers < config.evidence.min_inliers
    ):
        return fit
    return fit_around(search, fit.pose.cam_from_world, fit.camera, config.guided.radius_px)


def fit_around(
    search: Search,
    cam_from_world: Rigid3,
    camera: Camera,
    radius_px: float,
    min_matches: float = 0.0,
    rows: Sequence[Row] | None = None,
) -> PointMatches:
    """Fit a pose to guided matches around a pose, with the points of these nodes (None: of the
    nearest ones)."""
    query, config, start = search.query, search.config, (cam_from_world, camera)
    with query.clock.stage("matching"):
        guided = replace(config.guided, radius_px=radius_px)
        if rows is None:
            rows = search.map.showing(cam_from_world, camera, guided.num_nodes)
        local_map = search.map.local_map(rows)
        matches = match_guided(query.features, local_map, *start, guided)
    matched = query.features, query.input_camera, local_map, matches
    with query.clock.stage("pnp"):
        return fit_pose(*matched, config.pose, start, min_matches, search.correlated_error_share)


def find_best_case(proposal: NodeProposal) -> Hypothesis | None:
    """Return the refined proposal as a hypothesis with which all unguided matches agree.

    None if too few points were found.
    """
    search, final = proposal.search, refine(proposal)
    if not isinstance(final, PoseFit) or final.num_inliers < search.config.evidence.min_found:
        return None
    with search.query.clock.stage("evidence"):
        covariance = final.pose.inflated(1.0 + final.num_inliers * search.correlated_error_share)
        evidence = compute_best_case_evidence(search, final, covariance)
    log_odds = search.weights.log_odds(evidence)
    return Hypothesis(proposal.source, final, evidence, covariance, 1.0, log_odds)


def confirm_hypotheses(first: Search, last: Search) -> Answer:
    """Confirm the hypotheses of the first feature type with the last one.

    The reported pose is the one with the higher log-odds. In changed light, points of the first
    type may be found by chance and hold the pose in place.
    """
    config, weights = first.config.evidence, first.weights.rivals
    confirmed, by_last, of_nodes = Belief(), dict[int, Hypothesis](), first.belief.of_nodes
    for one in first.belief.hypotheses:
        if one.probability < config.min_probability:
            continue
        if one in of_nodes:
            added_log_odds, from_last = cross_check_hypothesis(last, one)
            is_from_last = from_last is not None and from_last.log_odds > one.log_odds
            one = replace(one, log_odds=one.log_odds + added_log_odds)
            if one.log_odds < first.weights.confirmation.min_log_odds:
                continue
            if from_last is not None and is_from_last:
                by_last[id(one)] = replace(from_last, log_odds=one.log_odds)
        confirmed = confirmed.with_hypothesis(one, config, weights)
    answer = lead(replace(first, belief=confirmed))
    if answer.pose is None or id(answer.best) not in by_last:
        return answer
    belief = Belief().with_hypothesis(by_last[id(answer.best)], config, last.weights.rivals)
    return lead(replace(last, belief=belief))


def cross_check_hypothesis(
    search: Search, hypothesis: Hypothesis
) -> tuple[float, Hypothesis | None]:
    """Score a pose of other features with the features of this search.

    Returns:
        The log-odds to add: few matches, as in darkness, give a small value. And the hypothesis
        with these features, None if there is none.
    """
    weights, final = search.weights.confirmation, refit_around(search, hypothesis.fit)
    if not isinstance(final, PoseFit) or final.num_inliers < search.config.evidence.min_found:
        return 0.0, None
    scored = NodeProposal(search, "other features", final).score(final)
    if scored is not None:
        log_odds, num_matches = scored.log_odds, scored.evidence.num_matches
    else:  # below the hopeless limit
        log_odds = -weights.max_log_odds
        num_matches = len(create_unguided_matcher(search, final).match_first())
    limited = float(np.clip(log_odds, -weights.max_log_odds, weights.max_log_odds))
    return limited * num_matches / (num_matches + weights.half_weight_matches), scored
