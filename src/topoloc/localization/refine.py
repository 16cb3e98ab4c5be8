"""Refine a pose proposal into a hypothesis.

The map points are matched again near their predicted pixels, the pose is estimated again, and the
evidence is counted. The nodes nearest to the proposal supply the points, because they were measured
from nearly the same place. Within a few pixels, matches are safe that the ratio test must reject
among thousands of descriptors.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from topoloc.features.features import Matches
from topoloc.features.matching import Matcher
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.belief import Hypothesis
from topoloc.localization.evidence import (
    compute_inlier_spread,
    compute_log_odds,
    compute_normalized_uncertainty,
    compute_uniform_inlier_ratio,
)
from topoloc.localization.guided import count_chance_matches, match_guided, select_visible_points
from topoloc.localization.map_facts.correlated_errors import covariance_inflation
from topoloc.localization.map_facts.repetition import fold_repetitions, shifted_copies
from topoloc.localization.pose_fit import PointMatches, PoseFit, fit_pose
from topoloc.localization.provenance import Evidence
from topoloc.localization.search import Proposal, Search, TriedProposal
from topoloc.localization.walls.propose_virtual_views import (
    VirtualViewProposal,
    refine_virtual_view_pose,
    score_virtual_view_pose,
)

_MAX_CROSS_CHECK_LOG_ODDS, _HALF_WEIGHT_MATCHES = (
    3.0,
    30.0,
)  # maximum log-odds from a second feature type; number of matches with half weight
_HOPELESS_LOG_ODDS = -3.0  # unguided matches cannot raise lower log-odds enough


def evaluate_proposal(search: Search, proposal: Proposal) -> Hypothesis | None:
    """Refine a proposal and score it.

    Returns:
        The hypothesis. None if too few points were found, or the pose was found already.
    """
    final, hypothesis = (
        (None, None) if is_already_found(search, proposal) else _refine_and_score(search, proposal)
    )
    if search.first is None:
        search.first = final if isinstance(final, PoseFit) else proposal.fit
    if search.trace is not None:
        milliseconds = search.query.clock.times_ms()["total"]
        kind = search.query.feature_config.kind
        search.trace.tried.append(
            TriedProposal(proposal.source, proposal.fit, final, hypothesis, milliseconds, kind)
        )
    return hypothesis


def _refine_and_score(
    search: Search, proposal: Proposal
) -> tuple[PointMatches | None, Hypothesis | None]:
    if isinstance(proposal, VirtualViewProposal):
        with search.query.clock.stage("walls"):
            final = refine_virtual_view_pose(proposal)
            return final, score_virtual_view_pose(proposal, final) if final is not None else None
    final = refine(search, proposal) if proposal.repeats is None else proposal.fit
    return final, score_pose(search, proposal, final)


def is_already_found(search: Search, proposal: Proposal) -> bool:
    """Return whether the proposal would lead to a pose that was found already.

    It does if it projects most inliers of a probable hypothesis to nearly the same pixels.
    """
    fit, config = proposal.fit, search.config
    if (
        not isinstance(fit, PoseFit)
        or proposal.repeats is not None
        or isinstance(proposal, VirtualViewProposal)
    ):
        return False
    radius_px = config.guided.radius_px * max(max(fit.camera.width, fit.camera.height) / 640.0, 0.5)
    for known in search.belief.hypotheses:
        if known.is_from_virtual_views or known.probability < config.evidence.min_probability:
            continue
        seen = known.fit.inlier_observations(1.0)
        with np.errstate(invalid="ignore"):
            apart = np.linalg.norm(
                fit.camera.img_from_cam(fit.cam_from_world.apply(seen.points_world))
                - seen.points_img,
                axis=1,
            )
        min_shared = 0.75 * len(apart)  # the rest may be occluded or out of view
        if np.count_nonzero(apart < radius_px) >= min_shared:
            return True
    return False


def refine(search: Search, proposal: Proposal) -> PointMatches:
    """Return the pose refitted to guided matches, or the proposal if it has too few inliers."""
    config, first = search.config, proposal.fit
    final = _refit_around(search, first)
    if (
        first.num_inliers < config.num_clear_inliers
    ):  # a poor first pose may need a second round to find all points
        final = max(final, _refit_around(search, final), key=lambda fit: fit.num_inliers)
    return final


def _refit_around(search: Search, fit: PointMatches) -> PointMatches:
    config, query = search.config, search.query
    if (
        config.guided.num_nodes == 0
        or not isinstance(fit, PoseFit)
        or fit.num_inliers < config.evidence.min_inliers
    ):
        return fit
    cam_from_world = fit.cam_from_world
    with query.clock.stage("matching"):
        local_map = search.map.local_map(
            search.map.nearest(cam_from_world.inverse(), config.guided.num_nodes)
        )
        matches = match_guided(query.features, local_map, cam_from_world, fit.camera, config.guided)
    with query.clock.stage("pnp"):
        return fit_pose(
            query.features,
            query.input_camera,
            local_map,
            matches,
            config.pose,
            (cam_from_world, fit.camera),
        )


def score_pose(search: Search, proposal: Proposal, final: PointMatches) -> Hypothesis | None:
    """Score the refined pose and return it as a hypothesis. None if too few points were found.

    The evidence comes from unguided matches. The proposal's own matches are enough if they make the
    pose clear. Otherwise the nodes around the final pose are matched. They are often nearer than
    those of the coarse search.
    """
    config, first = search.config.evidence, proposal.fit
    if (
        not isinstance(first, PoseFit)
        or not isinstance(final, PoseFit)
        or first.num_inliers < config.min_inliers
        or final.num_inliers < config.min_found
    ):
        return None
    with search.query.clock.stage("evidence"):
        inflated = covariance_inflation(final.num_inliers, search.correlated_error_share)
        covariance = inflated * final.pose.covariance
        evidence = _compute_evidence(search, proposal, final, covariance)
        if evidence is None:
            return None
        log_odds = compute_log_odds(evidence, search.weights)
    return Hypothesis(proposal.source, final, evidence, covariance, 1.0 / inflated, log_odds)


def compute_best_case_evidence(search: Search, proposal: Proposal) -> Evidence | None:
    """Return the evidence of the refined proposal if all unguided matches agreed with it.

    None if too few points were found.
    """
    final = refine(search, proposal)
    if not isinstance(final, PoseFit) or final.num_inliers < search.config.evidence.min_found:
        return None
    with search.query.clock.stage("evidence"):
        counted = _count_found_points(
            search,
            final,
            covariance_inflation(final.num_inliers, search.correlated_error_share)
            * final.pose.covariance,
        )
        return _assume_all_agree(
            replace(counted, num_by_chance=_count_chance_matches(search, final)), final
        )


def cross_check_hypothesis(
    search: Search, hypothesis: Hypothesis
) -> tuple[float, Hypothesis | None]:
    """Score a pose of other features with the features of this search.

    Returns:
        The log-odds to add: few matches, as in darkness, give a small value. And the hypothesis
        with these features, None if there is none.
    """
    final = _refit_around(search, hypothesis.fit)
    if not isinstance(final, PoseFit) or final.num_inliers < search.config.evidence.min_found:
        return 0.0, None
    scored = score_pose(search, Proposal("other features", final, is_guided=True), final)
    num_matches = (
        len(_create_unguided_matcher(search, final).match_first())
        if scored is None
        else scored.evidence.num_matches
    )
    log_odds = (
        -_MAX_CROSS_CHECK_LOG_ODDS if scored is None else scored.log_odds
    )  # None: below the hopeless limit
    return float(
        np.clip(log_odds, -_MAX_CROSS_CHECK_LOG_ODDS, _MAX_CROSS_CHECK_LOG_ODDS)
    ) * num_matches / (num_matches + _HALF_WEIGHT_MATCHES), scored


def _compute_evidence(
    search: Search, proposal: Proposal, final: PoseFit, covariance: Float[np.ndarray, "6 6"]
) -> Evidence | None:
    """Compute the evidence for a refined pose, None if it cannot become probable."""
    counted, repeats = _count_found_points(search, final, covariance), proposal.repeats
    if repeats is not None:
        unguided = (repeats.num_matches, repeats.num_inliers)
        return replace(
            counted,
            num_by_chance=repeats.num_by_chance,
            num_matches=unguided[0],
            num_inliers=unguided[1],
        )
    counted, may_be_hopeless = (
        replace(counted, num_by_chance=_count_chance_matches(search, final)),
        True,
    )
    if not proposal.is_guided:
        evidence = _with_unguided(search, counted, proposal.fit, final)
        log_odds = compute_log_odds(evidence, search.weights)
        if log_odds > search.weights.evidence.clear_log_odds:
            return evidence
        may_be_hopeless = log_odds < 2.0 * _HOPELESS_LOG_ODDS
    if (
        compute_log_odds(_assume_all_agree(counted, final), search.weights) < _HOPELESS_LOG_ODDS
    ):  # for any unguided matches
        return None
    matcher = _create_unguided_matcher(search, final)
    if may_be_hopeless:
        of_strongest = _with_unguided(
            search,
            counted,
            _unguided(final, matcher.match_first(search.config.num_first_features)),
            final,
        )
        if (
            compute_log_odds(of_strongest, search.weights) < 2.0 * _HOPELESS_LOG_ODDS
        ):  # for any matches of the other features
            return None
    return _with_unguided(search, counted, _unguided(final, matcher.match_first()), final)


def _count_found_points(
    search: Search, final: PoseFit, covariance: Float[np.ndarray, "6 6"]
) -> Evidence:
    """Count the points found at their predicted pixels.

    `covariance` is that of the left perturbation of cam_from_world.
    """
    camera = final.camera
    depths = final.cam_from_world.apply(final.local_map.points_world[final.inlier_point_idx])[:, 2]
    found_img = final.features.points_img[final.inlier_query_idx].astype(np.float64)
    visible, visible_img = select_visible_points(final.local_map, final.cam_from_world, camera)
    return Evidence(
        num_matches=0,
        num_inliers=0,
        num_found=final.num_inliers,
        num_visible=len(visible_img),
        num_by_chance=0,
        spread=compute_inlier_spread(found_img, camera.width, camera.height),
        even_share=_compute_uniform_inlier_ratio(final, visible, visible_img, found_img),
        doubt=compute_normalized_uncertainty(
            covariance, float(np.median(depths)), search.config.evidence
        ),
    )


def _compute_uniform_inlier_ratio(
    final: PoseFit,
    visible: Int[np.ndarray, " v"],
    visible_img: Float[np.ndarray, "v 2"],
    found_img: Float[np.ndarray, "f 2"],
) -> float:
    """Compute `Evidence.even_share`.

    If the feature type has dense descriptors, a point counts as found if they agree. Otherwise it
    counts if it has a key point match.
    """
    camera, dense = final.camera, final.features.dense
    if dense is not None and len(visible) > 0:
        # 512 points bound the time; more do not change the ratio
        sampled = np.unique(np.linspace(0, len(visible) - 1, 512).astype(int))
        visible_img = visible_img[sampled]
        found_img = visible_img[
            dense.check_agreement(visible_img, final.local_map.descriptors[visible[sampled]])
        ]
    return compute_uniform_inlier_ratio(found_img, visible_img, camera.width, camera.height)


def _count_chance_matches(search: Search, final: PoseFit) -> int:
    return count_chance_matches(
        final.features,
        final.local_map,
        final.cam_from_world,
        final.camera,
        search.config.guided,
    )


def _assume_all_agree(counted: Evidence, final: PoseFit) -> Evidence:
    """Return the evidence with all unguided matches assumed to agree with the pose."""
    return replace(counted, num_matches=final.num_inliers, num_inliers=final.num_inliers)


def _with_unguided(
    search: Search, evidence: Evidence, unguided: PointMatches, final: PoseFit
) -> Evidence:
    """Return the evidence with the counts of these unguided matches."""
    # points with correlated errors differ from node to node, so true matches agree less well
    # Maximum distance of an unguided match from the final pose's projection, 4 pixels in an image
    # whose longer side is 640.
    agreement_px = 4.0 * math.sqrt(1.0 + search.correlated_error_share)
    num_agreeing = _count_agreeing_matches(
        unguided,
        final.cam_from_world,
        final.camera,
        agreement_px,
        _repetition_shifts(search, final),
    )
    return replace(evidence, num_matches=len(unguided.matches), num_inliers=num_agreeing)


def _create_unguided_matcher(search: Search, final: PoseFit) -> Matcher:
    """Return a matcher of the features with the points around the final pose, not guided by it."""
    points = final.local_map
    positions = fold_repetitions(
        points.points_world, _repetition_shifts(search, final)
    )  # copies of a point are not its rivals
    return Matcher(
        final.features.descriptors,
        points.descriptors,
        (positions, points.radii),
        search.config.matching,
    )


def _unguided(final: PoseFit, matches: Matches) -> PointMatches:
    """Return unguided matches with the points around a pose."""
    return PointMatches(final.features, final.input_camera, final.camera, final.local_map, matches)


def _count_agreeing_matches(
    unguided: PointMatches,
    cam_from_world: Rigid3,
    camera: Camera,
    agreement_px: float,
    shifts: Float[np.ndarray, "k 3"],
) -> int:
    """Count the matches that agree with a pose, by their point or one of its copies."""
    is_near = np.zeros(len(unguided.matches), bool)
    for points_world in shifted_copies(
        unguided.local_map.points_world[unguided.matches.train_idx], shifts
    ):
        with np.errstate(invalid="ignore"):
            offsets = (
                camera.img_from_cam(cam_from_world.apply(points_world))
                - unguided.features.points_img[unguided.matches.query_idx]
            )
            is_near |= np.linalg.norm(offsets, axis=1) < agreement_px * max(
                max(camera.width, camera.height) / 640.0, 0.5
            )
    return int(np.count_nonzero(is_near))


def _repetition_shifts(search: Search, final: PoseFit) -> Float[np.ndarray, "k 3"]:
    """Return the repetition shifts (metres, world) of the pose's node."""
    return search.map.repeats(search.map.topomap.row_of(final.node_id))
