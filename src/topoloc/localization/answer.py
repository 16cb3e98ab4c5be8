"""Turn the belief about an image into an answer, which the checks then refine or refuse.

`lead` names the likeliest hypothesis of a belief, its alternatives if others rival it, or the
reason for a refusal. Each check of `decision.py` returns a `Finding`. `Answer.after` applies it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.geometry.absolute_pose import compute_variance_inflation
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.joint_camera.camera_hypotheses import CameraBelief
from topoloc.geometry.rigid import inverse_covariance
from topoloc.json_data import OneLine
from topoloc.localization.belief import (
    Hypothesis,
    log_odds_margin,
    select_probable,
    share_probability,
)
from topoloc.localization.evidence import (
    compute_translation_tolerance,
    is_only_imprecise,
)
from topoloc.localization.image_calibration_check import find_focal_doubt
from topoloc.localization.map_context import MapContext
from topoloc.localization.pose_fit import PointMatches, PointObservations
from topoloc.localization.provenance import Provenance
from topoloc.localization.result import Alternative, Localization, NotLocalized, Reason
from topoloc.localization.search import Search

LocalizationWithInliers = tuple[Localization, PointObservations]
"""A pose and its inliers, in pixels of the original image."""
ResultWithInliers = tuple[Localization | NotLocalized, list[LocalizationWithInliers]]
"""A result with each reported pose and its inliers: its own pose, or its alternatives in order."""


@dataclass(frozen=True, eq=False, repr=False)
class Finding(OneLine):
    """Hold what a check found about an answer.

    `text` states it in one line. `factor` multiplies the probability. `facts` holds new values of
    fields of the result. `hypothesis` is the pose if it was fitted again, and `points` are its
    inliers if they differ. `refusal` holds reason and detail if the answer is refused. `answer`
    replaces a refusal.
    """

    check: str
    text: str
    factor: float = 1.0
    facts: Mapping[str, Any] = field(default_factory=dict)
    hypothesis: Hypothesis | None = None
    points: PointObservations | None = None
    refusal: tuple[Reason, str] | None = None
    answer: Answer | None = None


@dataclass(frozen=True, eq=False)
class Answer:
    """Hold the answer of one map: the result, each reported pose with its inliers and its
    hypothesis, and the findings of the checks so far.

    `search` is that of the feature type that decided, and `best` its likeliest hypothesis.
    """

    search: Search
    best: Hypothesis | None
    result: Localization | NotLocalized
    poses: list[LocalizationWithInliers]
    hypotheses: list[Hypothesis] = field(default_factory=list)
    findings: tuple[Finding, ...] = ()

    @property
    def pose(self) -> Localization | None:
        """Return the pose, None if the image is refused."""
        return self.result if isinstance(self.result, Localization) else None

    def after(self, finding: Finding | None) -> Answer:
        """Return the answer that follows from the finding of a check."""
        if finding is None:
            return self
        findings, pose = (*self.findings, finding), self.pose
        if finding.answer is not None:
            return replace(finding.answer, findings=findings)
        if pose is None:
            return replace(self, findings=findings)
        best, points = finding.hypothesis or self.best, finding.points or self.poses[0][1]
        probability = finding.factor * pose.probability
        if finding.hypothesis is None:
            pose = replace(pose, probability=probability)
        else:
            pose, points = _build_localization(self.search, finding.hypothesis, probability)
        pose = replace(pose, **finding.facts)
        if finding.refusal is not None:
            refusal = refuse(self.search, pose, *finding.refusal)
            return Answer(self.search, best, refusal, [], [], findings)
        hypotheses = [] if best is None else [best]
        return Answer(self.search, best, pose, [(pose, points)], hypotheses, findings)

    def with_provenance(self, opened: MapContext, camera: Camera | UncalibratedCamera) -> Answer:
        """Return the answer with the identity of its map, the camera and the geoposes."""
        poses = [(opened.with_provenance(pose, camera), seen) for pose, seen in self.poses]
        return replace(self, result=opened.with_provenance(self.result, camera), poses=poses)

    def margin_over(self, search: Search, rival: Hypothesis) -> float:
        """Return the log-odds margin of the pose over a hypothesis of another map's search.

        It separates similar places, if both are of one feature type. If not, it is the difference
        of their log-odds.
        """
        best = self.hypotheses[0]
        if self.search.map.kind.name != search.map.kind.name:
            return best.log_odds - rival.log_odds
        return log_odds_margin(best, rival, self.search.weights.rivals)


def lead(search: Search) -> Answer:
    """Return the answer that follows from the belief of a search."""
    rivals, min_probability = search.weights.rivals, search.config.evidence.min_probability
    ranked = search.belief.hypotheses
    if not ranked or ranked[0].probability < min_probability:
        best = ranked[0] if ranked else None
        return Answer(search, best, _explain_not_localized(search, best), [])
    best = ranked[0]
    log_odds_margins = [_log_odds_margin(search, best, other) for other in ranked[1:]]
    shares = share_probability(math.exp(-best.log_odds), log_odds_margins)
    probability = best.evidence.precision_probability * shares[0]
    is_leading = all(
        by >= (rivals.unclear_lead if _is_unclear_and_distant(search, best, other) else rivals.lead)
        for by, other in zip(log_odds_margins, ranked[1:], strict=True)
    )
    if is_leading and probability >= min_probability:
        pose, points = _build_localization(search, best, probability)
        if pose.probability >= min_probability:
            return _weigh_camera(search, best, pose, points)
    return _ambiguous_answer(search, ranked, shares)


def _weigh_camera(
    search: Search, best: Hypothesis, pose: Localization, points: PointObservations
) -> Answer:
    """Return the answer with the probability that the pose is within the tolerance for any camera
    that is as likely, if the image has no calibration."""
    camera = best.fit.pose.camera
    if camera is not None:
        pose = replace(
            pose, probability=pose.probability * probability_within(search, best, camera)
        )
        if pose.probability < search.config.evidence.min_probability:
            detail = "a cropped image or another lens would put the camera elsewhere"
            if camera.is_contradicted:
                detail = "the image contradicts all camera models, as a panorama does"
            detail = f"{detail}: state --camera"
            refusal = _build_not_localized(search, "too_few_inliers", best.fit, detail)
            return Answer(search, best, refusal, [])
    return Answer(search, best, pose, [(pose, points)], [best])


def probability_within(search: Search, best: Hypothesis, camera: CameraBelief) -> float:
    """Return the probability that a camera moves the pose by less than the tolerances."""
    config = search.config.evidence
    max_translation = compute_translation_tolerance(best.fit.median_depth, config)
    return camera.probability_within(max_translation, math.radians(config.max_errors[1]))


def _log_odds_margin(search: Search, best: Hypothesis, other: Hypothesis) -> float:
    """Return the log-odds margin of the best hypothesis over another one.

    If the best one is not clear and the other is elsewhere, the difference of log-odds limits it:
    if a wrong place of the map has nearly as much evidence, a place outside the map may as well.
    """
    by_all = log_odds_margin(best, other, search.weights.rivals)
    is_unclear = _is_unclear_and_distant(search, best, other)
    return min(by_all, best.log_odds - other.log_odds) if is_unclear else by_all


def _is_unclear_and_distant(search: Search, best: Hypothesis, other: Hypothesis) -> bool:
    """Return whether the best hypothesis is not clear and the other is at another place."""
    is_vague = not other.evidence.is_of_nodes and other.evidence.doubt > 1.0  # a wall, somewhere
    if search.weights.for_evidence(best.evidence).is_clear(best.log_odds) or is_vague:
        return False
    max_distance, max_angle = 2.0 * search.config.evidence.max_translation, math.radians(10.0)
    return not best.world_from_cam.is_same(other.world_from_cam, max_distance, max_angle)


def _build_localization(
    search: Search, hypothesis: Hypothesis, probability: float
) -> LocalizationWithInliers:
    best = _with_clustered_errors(search, hypothesis)
    is_rough = isinstance(best.fit.input_camera, UncalibratedCamera)
    localization = Localization(
        world_from_cam=best.world_from_cam,
        covariance=inverse_covariance(best.fit.pose.cam_from_world, best.covariance),
        probability=probability,
        node_id=best.fit.node_id,
        candidates=search.candidate_nodes,
        num_matches=len(best.fit.matches),
        num_inliers=best.fit.num_inliers,
        times_ms=search.query.clock.times_ms(),
        evidence=best.evidence,
        focal_length_px=best.fit.camera.fx * search.query.scale if is_rough else None,
        noise_share=best.noise_share,
        calibrated=search.weights.is_calibrated,
        provenance=_provenance(search, best.fit.camera if is_rough else None),
    )
    return localization, best.fit.inlier_observations(search.query.scale)


def _with_clustered_errors(search: Search, best: Hypothesis) -> Hypothesis:
    """Inflate the noise by errors that inliers share within parts of the image. Errors common to
    all of it are those of nodes. Virtual views have an inflation of their own."""
    if search.weights.for_evidence(best.evidence).few_points:
        return best
    seen = best.fit.inlier_observations(1.0)
    parts = seen.points_img.astype(np.float64), seen.points_world, seen.covariances
    coherence = compute_variance_inflation(
        *parts, best.fit.camera, best.fit.pose.cam_from_world, search.config.pose.key_point_sigma_px
    )
    noise = best.noise_share * best.covariance
    shared = best.covariance - noise
    if np.allclose(noise, best.fit.pose.covariance, atol=0.0):  # no error of a camera was added
        # rho is measured near nodes, and recorded poses drift. Kitchen, three splits (132 poses):
        # 96 % are inside the 95 % ellipsoid, without growth 80 %.
        growth = max(1.0, search.map.remoteness(best.world_from_cam))
        shared = growth * shape_as_motion(shared, noise, best.fit.median_depth)
    total = coherence**2 * noise + shared
    share = np.trace(noise[:3, :3]) / np.trace(total[:3, :3])
    return replace(best, covariance=total, noise_share=float(share))


def shape_as_motion(
    shared: Float[np.ndarray, "6 6"], noise: Float[np.ndarray, "6 6"], depth: float
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of errors that move whole nodes, in place of a multiple of the noise.

    Recorded poses are off by as much in angle as in distance over the points' `depth` (metres). rho
    is measured in standard deviations of the noise, so the mean square in these stays.
    """
    # Nodes differ. Kitchen, 60 of 100 frames mapped, benchmarks/exactness.py, 2026-11-28: with a
    # factor of 3, 37 of 40 poses are inside, with 2, 33.
    factor, motion = 3.0, np.diag([depth**2] * 3 + [1.0] * 3)
    of_shared, of_motion = np.linalg.solve(noise, [shared, motion])
    return factor * np.trace(of_shared) / np.trace(of_motion) * motion


def _ambiguous_answer(search: Search, ranked: Sequence[Hypothesis], shares: list[float]) -> Answer:
    """Return an ambiguous answer with the probability of each alternative."""
    best, probable = ranked[0], select_probable(ranked, shares)
    named = [_build_localization(search, one, share) for one, share in probable]
    alternatives = tuple(_alternative(one) for one, _ in named)
    reason, detail = "imprecise", _describe_imprecision(best)
    if len(alternatives) > 1:
        first, second = alternatives[:2]
        reason = "ambiguous"
        detail = f"as much like node {second.node_id} as like node {first.node_id}"
    refusal = _build_not_localized(search, reason, best.fit, detail, alternatives)
    return Answer(search, best, refusal, named, [one for one, _ in probable])


def _explain_not_localized(search: Search, best: Hypothesis | None) -> NotLocalized:
    if best is None:
        first = search.first
        num_matches = 0 if first is None else len(first.matches)
        is_enough = num_matches >= search.config.min_matches
        reason = "too_few_inliers" if is_enough else "too_few_matches"
        return _build_not_localized(search, reason, first)
    if is_only_imprecise(best.evidence, best.log_odds, search.weights, search.config.evidence):
        pose = _alternative(_build_localization(search, best, best.probability)[0])
        detail = _describe_imprecision(best)
        return _build_not_localized(search, "imprecise", best.fit, detail, (pose,))
    return _build_not_localized(search, "not_in_map", best.fit, find_focal_doubt(search, best.fit))


def _alternative(pose: Localization) -> Alternative:
    return Alternative(
        pose.world_from_cam, pose.probability, pose.node_id, covariance=pose.covariance
    )


def _describe_imprecision(best: Hypothesis) -> str:
    metres = float(np.sqrt(np.linalg.eigvalsh(best.covariance[:3, :3])[-1]))
    return f"in the map, but where is known to {metres:.2f} m only"


def _build_not_localized(
    search: Search,
    reason: Reason,
    fit: PointMatches | None,
    detail: str = "",
    alternatives: tuple[Alternative, ...] = (),
) -> NotLocalized:
    details = detail, "time was up before everything was tried" if search.is_stopped else ""
    return NotLocalized(
        reason,
        search.candidate_nodes,
        0 if fit is None else len(fit.matches),
        0 if fit is None else fit.num_inliers,
        search.query.clock.times_ms(),
        "; ".join(filter(None, details)),
        alternatives,
        _provenance(search),
    )


def refuse(search: Search, pose: Localization, reason: Reason, detail: str) -> NotLocalized:
    """Return the refusal of a pose."""
    alternatives = (_alternative(pose),) if reason == "imprecise" else ()
    return replace(
        _build_not_localized(search, reason, None, detail, alternatives),
        num_matches=pose.num_matches,
        num_inliers=pose.num_inliers,
        provenance=pose.provenance,
        seen_camera=pose.seen_camera,
        appearance=pose.appearance,
    )


def _provenance(search: Search, camera: Camera | None = None) -> Provenance:
    """Return the feature type and the camera of the result. The localizer fills in the rest."""
    return Provenance(features=search.map.kind.name, camera=camera)
