"""Decide the result of a query from its belief: a pose, alternatives, or a reason for none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.joint_camera.camera_hypotheses import (
    CameraBelief,
    CameraHypothesis,
    WeighedCamera,
    map_variance,
)
from topoloc.geometry.pose_matches import compute_variance_inflation
from topoloc.geometry.rigid import inverse_covariance
from topoloc.geometry.rolling_shutter import TurningCamera, find_rotation
from topoloc.localization.belief import Hypothesis, log_odds_margin
from topoloc.localization.evidence import (
    compute_normalized_uncertainty,
    compute_translation_tolerance,
    highest_probability,
    is_only_imprecise,
)
from topoloc.localization.image_calibration_check import check_image_calibration, find_focal_doubt
from topoloc.localization.map_facts.correlated_errors import shape_as_motion
from topoloc.localization.pose_fit import PointMatches, PointObservations
from topoloc.localization.provenance import Provenance
from topoloc.localization.result import Alternative, Localization, NotLocalized, Reason
from topoloc.localization.search import Search

MIN_ALTERNATIVE_RATIO = 0.01  # relative to the best probability; less probable ones are dropped


LocalizationWithInliers = tuple[Localization, PointObservations]
"""A pose and its inliers, in pixels of the original image."""
ResultWithInliers = tuple[Localization | NotLocalized, list[LocalizationWithInliers]]
"""A result with each reported pose and its inliers: its own pose, or its alternatives in order."""


def decide_result(search: Search) -> ResultWithInliers:
    """Return the result that follows from the current belief."""
    rivals, min_probability = search.weights.rivals, search.config.evidence.min_probability
    ranked = search.belief.ranked(rivals)
    if not ranked or ranked[0].probability < min_probability:
        return _explain_not_localized(search, ranked), []
    best = ranked[0]
    log_odds_margins = [_log_odds_margin(search, best, other) for other in ranked[1:]]
    others = math.exp(-best.log_odds) + sum(math.exp(-one) for one in log_odds_margins)
    probability = best.evidence.precision_probability / (1.0 + others)
    is_leading = all(
        by >= (rivals.unclear_lead if _is_unclear_and_distant(search, best, other) else rivals.lead)
        for by, other in zip(log_odds_margins, ranked[1:], strict=True)
    )
    if is_leading and probability >= min_probability:
        named = _build_localization(search, best, probability)
        if named[0].probability >= min_probability:
            return named[0], [named]
    return _ambiguous_result(search, ranked, log_odds_margins, others)


def decide_final_result(search: Search) -> ResultWithInliers:
    """Return `decide_result` after a check against the camera calibration.

    It runs when no other feature type follows. If the image contradicts its calibration, the
    covariance grows by the induced shift. The probability falls accordingly, and the pose may be
    refused.
    """
    result, named = decide_result(search)
    if isinstance(result, NotLocalized):
        return result, named
    best = search.belief.ranked(search.weights.rivals)[0]
    if best.fit.pose.camera is not None:
        return _weigh_camera(search, best, result, best.fit.pose.camera)
    with search.query.clock.stage("calibration"):
        turning, frame_rotation_deg = _find_rotation(search, best), None
        is_evident = turning is not None and turning.is_evident
        seen, doubt = (None, None) if is_evident else check_image_calibration(search, best.fit)
        # a rotation that is not evident is still likelier than a wrong calibration
        if turning is not None and (is_evident or doubt is not None):
            best = _undo_rotation(best, turning)
            frame_rotation_deg = float(np.rad2deg(np.linalg.norm(turning.rotation)))
            seen, doubt = check_image_calibration(search, best.fit)
    if doubt is None:
        if frame_rotation_deg is not None:
            result, points = _build_localization(search, best, result.probability)
            result = replace(result, frame_rotation_deg=frame_rotation_deg)
            named = [(result, points)]
        result = replace(result, seen_camera=seen, times_ms=search.query.clock.times_ms())
        return result, [(result, points) for _, points in named]
    covariance = best.covariance + np.outer(doubt.shift, doubt.shift)
    uncertainty = compute_normalized_uncertainty(
        covariance, best.fit.median_depth, search.config.evidence
    )
    evidence = replace(best.evidence, doubt=max(best.evidence.doubt, uncertainty))
    penalized = replace(best, covariance=covariance, evidence=evidence)
    # inliers by the wrong camera hide a part of the shift: half of it in `benchmarks/inputs.py`
    half = best.covariance + 0.25 * np.outer(doubt.shift, doubt.shift)
    shifted = WeighedCamera(CameraHypothesis(), 1.0, doubt.shift, half)
    camera = CameraBelief(shifted.hypothesis, [shifted])
    probability = result.probability * _probability_within(search, best, camera)
    if probability < search.config.evidence.min_probability:
        search.is_refuted = True
        refusal = _build_not_localized(
            search, "too_few_inliers", best.fit, f"the calibration is doubtful: {doubt}"
        )
        return replace(refusal, seen_camera=seen), []
    localization, points = _build_localization(search, penalized, probability)
    localization = replace(localization, calibration_doubt=doubt, seen_camera=seen)
    return localization, [(localization, points)]


def _find_rotation(search: Search, best: Hypothesis) -> TurningCamera | None:
    """Return the camera that turned while a rolling shutter read its rows, None if it may be at
    rest."""
    if not best.evidence.is_of_nodes:
        return None
    fit, seen = best.fit, best.fit.inlier_observations(1.0)
    return find_rotation(
        seen.points_img.astype(np.float64),
        seen.points_world,
        seen.covariances,
        search.config.pose.key_point_sigma_px,
        fit.camera,
        fit.cam_from_world,
        map_variance(search.correlated_error_share),
    )


def _undo_rotation(best: Hypothesis, turning: TurningCamera) -> Hypothesis:
    """Return the hypothesis as if all rows had been read at once."""
    fit = best.fit
    points_img = turning.undo(fit.features.points_img.astype(np.float64), fit.camera)
    features = replace(fit.features, points_img=points_img.astype(np.float32))
    covariance = fit.pose.covariance + turning.covariance
    pose = replace(fit.pose, cam_from_world=turning.cam_from_world, covariance=covariance)
    fit = replace(fit, features=features, pose=pose)
    return replace(best, fit=fit, covariance=best.covariance + turning.covariance)


def _weigh_camera(
    search: Search, best: Hypothesis, result: Localization, camera: CameraBelief
) -> ResultWithInliers:
    """Return the result of a camera without calibration, with the probability that the pose is
    within the tolerance whatever its camera may be."""
    probability = result.probability * _probability_within(search, best, camera)
    if probability >= search.config.evidence.min_probability:
        named = _build_localization(search, best, probability)
        return named[0], [named]
    detail = "a cropped image or another lens would put the camera elsewhere: state --camera"
    if camera.is_contradicted:
        detail = "the image contradicts all camera models, as a panorama does: state --camera"
    return _build_not_localized(search, "too_few_inliers", best.fit, detail), []


def _probability_within(search: Search, best: Hypothesis, camera: CameraBelief) -> float:
    """Return the probability that a camera moves the pose by less than the tolerances."""
    config = search.config.evidence
    max_translation = compute_translation_tolerance(best.fit.median_depth, config)
    return camera.probability_within(max_translation, math.radians(config.max_rotation_deg))


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
    if search.weights.of(best.evidence).is_clear(best.log_odds) or is_vague:
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
        covariance=inverse_covariance(best.fit.cam_from_world, best.covariance),
        probability=min(probability, highest_probability(best.covariance, search.config.evidence)),
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
    if search.weights.of(best.evidence).few_points:
        return best
    seen = best.fit.inlier_observations(1.0)
    parts = seen.points_img.astype(np.float64), seen.points_world, seen.covariances
    coherence = compute_variance_inflation(
        *parts, best.fit.camera, best.fit.cam_from_world, search.config.pose.key_point_sigma_px
    )
    noise = best.noise_share * best.covariance
    shared = best.covariance - noise
    if np.allclose(noise, best.fit.pose.covariance, atol=0.0):  # no error of a camera was added
        shared = shape_as_motion(shared, noise, best.fit.median_depth)
    total = coherence**2 * noise + shared
    share = np.trace(noise[:3, :3]) / np.trace(total[:3, :3])
    return replace(best, covariance=total, noise_share=float(share))


def _ambiguous_result(
    search: Search, ranked: list[Hypothesis], log_odds_margins: list[float], others: float
) -> ResultWithInliers:
    """Return an ambiguous result with the probability of each alternative."""
    best = ranked[0]
    shares = [1.0 / (1.0 + others), *(math.exp(-one) / (1.0 + others) for one in log_odds_margins)]
    probable = [
        pair
        for pair in zip(ranked, shares, strict=True)
        if pair[1] >= MIN_ALTERNATIVE_RATIO * shares[0]
    ]
    named = [
        _build_localization(search, one, share)
        for one, share in sorted(probable, key=lambda pair: -pair[1])
    ]
    alternatives = tuple(
        Alternative(one.world_from_cam, one.probability, one.node_id) for one, _ in named
    )
    reason, detail = "too_few_inliers", _describe_imprecision(best)
    if len(alternatives) > 1:
        first, second = alternatives[:2]
        reason = "ambiguous"
        detail = f"as much like node {second.node_id} as like node {first.node_id}"
    return _build_not_localized(search, reason, best.fit, detail, alternatives), named


def _explain_not_localized(search: Search, ranked: list[Hypothesis]) -> NotLocalized:
    if not ranked:
        first = search.first
        num_matches = 0 if first is None else len(first.matches)
        is_enough = num_matches >= search.config.min_matches
        reason = "too_few_inliers" if is_enough else "too_few_matches"
        return _build_not_localized(search, reason, first)
    best = ranked[0]
    if is_only_imprecise(best.evidence, search.weights, search.config.evidence):
        detail = _describe_imprecision(best)
        return _build_not_localized(search, "too_few_inliers", best.fit, detail)
    return _build_not_localized(search, "not_in_map", best.fit, find_focal_doubt(search, best.fit))


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


def _provenance(search: Search, camera: Camera | None = None) -> Provenance:
    """Return the feature type and the camera of the result. The localizer fills in the rest."""
    return Provenance(features=search.map.kind.name, camera=camera)
