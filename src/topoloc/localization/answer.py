"""What is answered, of what is believed: a pose, "it is one of these", or why there is none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from topoloc.geometry.clustered_errors import coherence
from topoloc.geometry.rigid import covariance_of_inverse
from topoloc.geometry.rough_camera import RoughCamera
from topoloc.localization.belief import MIN_LEAD, Hypothesis, lead
from topoloc.localization.calibration_doubt import doubt_of_calibration
from topoloc.localization.evidence import doubt_of, is_only_imprecise, precision_at, precision_of
from topoloc.localization.pose_fit import SeenPoints
from topoloc.localization.provenance import Provenance
from topoloc.localization.result import Alternative, Localization, NotLocalized, Reason
from topoloc.localization.search import Search

_ELSEWHERE_DEG = 10.0
_MIN_ALTERNATIVE = 0.01  # ones that are less probable beside the best one are not named


Answered = tuple[Localization, SeenPoints]
"""A pose, and the points that it stands on, in pixels of the image as it came."""
Verdict = tuple[Localization | NotLocalized, list[Answered]]
"""A result, and each pose that it names: its own, or its alternatives, in their order."""


def answer(search: Search) -> Verdict:
    """What follows from what is believed."""
    ranked = search.belief.ranked(search.weights.rivals)
    min_probability = search.config.evidence.min_probability
    if not ranked or ranked[0].probability < min_probability:
        return _refusal(search, ranked), []
    best, leads = ranked[0], [_lead(search, ranked[0], other) for other in ranked[1:]]
    others = math.exp(-best.log_odds) + sum(math.exp(-one) for one in leads)
    probability = precision_of(best.evidence) / (1.0 + others)
    is_leading = all(
        by >= _least_lead(search, best, other) for by, other in zip(leads, ranked[1:], strict=True)
    )
    if is_leading and probability >= min_probability:
        named = _answered(search, best, probability)
        return named[0], [named]
    return _ambiguity(search, ranked, leads, others)


def final_answer(search: Search) -> Verdict:
    """`answer`, where no other features are asked any more: held against its calibration, which the
    picture may contradict. That costs it precision, which may be all that it has."""
    result, named = answer(search)
    if isinstance(result, NotLocalized):
        return result, named
    best = search.belief.ranked(search.weights.rivals)[0]
    with search.query.clock.stage("calibration"):
        seen, doubt = doubt_of_calibration(search, best.fit)
    if doubt is None:
        result = replace(result, seen_camera=seen, times_ms=search.query.clock.times_ms())
        return result, [(result, points) for _, points in named]
    covariance = best.covariance + np.outer(doubt.shift, doubt.shift)
    evidence = replace(
        best.evidence, doubt=max(best.evidence.doubt, _doubt_with(search, best, covariance))
    )
    paid = replace(best, covariance=covariance, evidence=evidence)
    probability = result.probability * precision_at(evidence.doubt)
    if probability < search.config.evidence.min_probability:
        refusal = _refused(search, "too_few_inliers", paid, f"the calibration is doubtful: {doubt}")
        return replace(refusal, seen_camera=seen), []
    localization, points = _answered(search, paid, probability)
    localization = replace(localization, calibration_doubt=doubt, seen_camera=seen)
    return localization, [(localization, points)]


def _doubt_with(search: Search, best: Hypothesis, covariance: Float[np.ndarray, "6 6"]) -> float:
    """`Evidence.doubt` of the hypothesis, were its covariance this one."""
    assert best.fit.pose is not None
    seen = best.fit.seen_points(1.0)
    depth = float(np.median(best.fit.pose.cam_from_world.apply(seen.points_world)[:, 2]))
    return doubt_of(covariance, depth, search.config.evidence)


def _lead(search: Search, best: Hypothesis, other: Hypothesis) -> float:
    """By how much the best hypothesis leads. One that is not clear must lead those elsewhere by its
    odds, too: where a wrong place of the map has nearly as much for it, a place that is not in the
    map may as well."""
    by_all = lead(best, other, search.weights.rivals)
    return (
        min(by_all, best.log_odds - other.log_odds)
        if _is_unclear_beside(search, best, other)
        else by_all
    )


def _least_lead(search: Search, best: Hypothesis, other: Hypothesis) -> float:
    return (
        search.weights.rivals.unclear_lead if _is_unclear_beside(search, best, other) else MIN_LEAD
    )


def _is_unclear_beside(search: Search, best: Hypothesis, other: Hypothesis) -> bool:
    """Is the best hypothesis not clear, and the other one elsewhere? Evidence of walls is held
    against all other walls already."""
    if best.is_from_walls:
        return False
    apart, config = best.world_from_cam.inverse() @ other.world_from_cam, search.config.evidence
    is_elsewhere = np.linalg.norm(
        apart.translation
    ) > 2.0 * config.max_translation or apart.angle() > math.radians(_ELSEWHERE_DEG)
    return bool(is_elsewhere) and best.log_odds <= search.weights.evidence.clear_log_odds


def _answered(search: Search, hypothesis: Hypothesis, probability: float) -> Answered:
    best = _widened(search, hypothesis)
    assert best.fit.pose is not None
    is_rough = isinstance(best.fit.lens, RoughCamera)
    localization = Localization(
        world_from_cam=best.world_from_cam,
        covariance=covariance_of_inverse(best.fit.pose.cam_from_world, best.covariance),
        probability=probability,
        node_id=best.fit.node_id,
        candidates=search.named,
        num_matches=len(best.fit.matches),
        num_inliers=best.fit.num_inliers,
        times_ms=search.query.clock.times_ms(),
        evidence=best.evidence,
        focal_length_px=best.fit.camera.fx * search.query.scale if is_rough else None,
        noise_share=best.noise_share,
        calibrated=search.weights.is_calibrated,
        provenance=_provenance(search),
    )
    return localization, best.fit.seen_points(search.query.scale)


def _widened(search: Search, best: Hypothesis) -> Hypothesis:
    """With a covariance that also counts what the inliers are wrong by together in parts of the
    picture. What they have in common all over it and what they have there add up: n rho +
    coherence^2, times that of independent errors. Walls have an inflation of their own."""
    if best.is_from_walls or best.fit.pose is None:
        return best
    seen = best.fit.seen_points(1.0)
    parts = seen.points_img.astype(np.float64), seen.points_world, seen.covariances
    squared = (
        coherence(*parts, best.fit.camera, best.fit.pose.cam_from_world, search.config.pose) ** 2
    )
    wider = 1.0 + (squared - 1.0) * best.noise_share
    return replace(best, covariance=wider * best.covariance, noise_share=best.noise_share / wider)


def _ambiguity(
    search: Search, ranked: list[Hypothesis], leads: list[float], others: float
) -> Verdict:
    """It is one of these; how probable each is, beside "nowhere"."""
    best = ranked[0]
    shares = [1.0 / (1.0 + others), *(math.exp(-one) / (1.0 + others) for one in leads)]
    probable = [
        pair for pair in zip(ranked, shares, strict=True) if pair[1] >= _MIN_ALTERNATIVE * shares[0]
    ]
    named = [
        _answered(search, one, share) for one, share in sorted(probable, key=lambda pair: -pair[1])
    ]
    alternatives = tuple(
        Alternative(one.world_from_cam, one.probability, one.node_id) for one, _ in named
    )
    if len(alternatives) > 1:
        detail = (
            f"as much like node {alternatives[1].node_id} as like node {alternatives[0].node_id}"
        )
    else:
        metres = float(np.sqrt(np.linalg.eigvalsh(best.covariance[:3, :3])[-1]))
        detail = f"in the map, but where is known to {metres:.2f} m only"
    return _refused(
        search,
        "ambiguous" if len(alternatives) > 1 else "too_few_inliers",
        best,
        detail,
        alternatives,
    ), named


def _refusal(search: Search, ranked: list[Hypothesis]) -> NotLocalized:
    if not ranked:
        first = search.first
        num_matches, num_inliers = (
            (len(first.matches), first.num_inliers) if first is not None else (0, 0)
        )
        reason: Reason = (
            "too_few_matches" if num_matches < search.config.min_matches else "too_few_inliers"
        )
        return NotLocalized(
            reason,
            search.named,
            num_matches,
            num_inliers,
            search.query.clock.times_ms(),
            _late(search),
            (),
            _provenance(search),
        )
    best = ranked[0]
    if is_only_imprecise(best.evidence, search.weights, search.config.evidence):
        metres = float(np.sqrt(np.linalg.eigvalsh(best.covariance[:3, :3])[-1]))
        return _refused(
            search,
            "too_few_inliers",
            best,
            f"in the map, but where is known to {metres:.2f} m only",
        )
    return _refused(search, "not_in_map", best, "")


def _refused(
    search: Search,
    reason: Reason,
    best: Hypothesis,
    detail: str,
    alternatives: tuple[Alternative, ...] = (),
) -> NotLocalized:
    times_ms, detail = (
        search.query.clock.times_ms(),
        "; ".join(text for text in (detail, _late(search)) if text),
    )
    return NotLocalized(
        reason,
        search.named,
        len(best.fit.matches),
        best.fit.num_inliers,
        times_ms,
        detail,
        alternatives,
        _provenance(search),
    )


def _provenance(search: Search) -> Provenance:
    """By which features the answer was come by; the localizer knows the rest."""
    return Provenance(features=search.map.kind.name)


def _late(search: Search) -> str:
    return "time was up before everything was tried" if search.is_stopped else ""
