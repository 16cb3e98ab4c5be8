"""Measure the evidence for a pose. Its weights are in `fitted_weights.py`.

An inlier count alone is not a test. RANSAC finds a dozen inliers in any image, and poses in
repeated patterns collect many more. A wrong pose does not agree with data that it was not fitted
to. Most visible map points are then missing at their predicted pixels in some part of the image. Or
no more of them are found than a third of the image away, where only chance matches are found.

So these two ratios are measured, the number and ratio of inliers among the unguided matches, and
the share of the image that the found points cover. A pose at the right place may still be
imprecise. The last measure is therefore the covariance relative to the tolerance.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from topoloc.features.features import Matches
from topoloc.features.matching import Matcher
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, standard_deviations
from topoloc.localization.config import EvidenceConfig
from topoloc.localization.fitted_weights import FittedWeights
from topoloc.localization.guided import count_chance_matches, select_visible_points
from topoloc.localization.map_facts.repetition import fold_repetitions
from topoloc.localization.pose_fit import PointMatches, PoseFit
from topoloc.localization.provenance import Evidence, probability_within_tolerance
from topoloc.localization.search import Search

_GRID = np.array([8, 6])
"""Grid of cells over the image. The inlier spread is the share of cells with an inlier."""
_PRECISE_DOUBT = 0.3
"""Doubt below which a pose is precise enough."""


def compute_translation_tolerance(median_depth: float, config: EvidenceConfig) -> float:
    """Return the maximum position error (metres) of a right pose for points `median_depth` (metres)
    away."""
    # Maximum position error as a share of the median distance of the seen points.
    depth_share, max_translation = 0.05, config.max_errors[0]
    share = depth_share * median_depth / config.max_translation
    return max_translation * (share if config.is_relative else min(1.0, share))


def compute_normalized_uncertainty(
    covariance: Float[np.ndarray, "6 6"], median_depth: float, config: EvidenceConfig
) -> float:
    """Compute `Evidence.doubt` from a covariance.

    The covariance is that of the left perturbation of cam_from_world (metres, radians). A wider
    tolerance forgives a lack of precision, and says nothing about the place.
    """
    metres, radians = (
        math.sqrt(np.linalg.eigvalsh(part)[-1]) for part in (covariance[:3, :3], covariance[3:, 3:])
    )
    fitted, asked = (
        math.hypot(
            metres / compute_translation_tolerance(median_depth, one),
            math.degrees(radians) / one.max_errors[1],
        )
        for one in (replace(config, tolerance=None), config)
    )
    return max(asked, min(fitted, _PRECISE_DOUBT))


def highest_probability(
    covariance: Float[np.ndarray, "6 6"], median_depth: float, config: EvidenceConfig
) -> float:
    """Return the highest probability that agrees with a pose covariance (metres, radians) and the
    median distance (metres) of the seen points.

    It is that of a normal error within the tolerance. At least `min_probability`, for a lack of
    precision alone refuses no pose: rho is that of the worse parts of a map.
    """
    max_translation, max_rotation_deg = config.max_errors
    if config.is_relative:
        max_translation = compute_translation_tolerance(median_depth, config)
    metres, radians = standard_deviations(covariance)
    doubt = max(metres / max_translation, math.degrees(radians) / max_rotation_deg)
    return max(probability_within_tolerance(doubt), config.min_probability)


def sample_rows(count: int) -> Int[np.ndarray, " k"]:
    """Return at most 512 evenly spaced rows of this many, which bounds the time of a check."""
    return np.unique(np.linspace(0, count - 1, 512).astype(int))


def measure_evidence(
    fit: PoseFit,
    covariance: Float[np.ndarray, "6 6"],
    num_visible: int,
    found_img: Float[np.ndarray, "f 2"] | None,
    visible_img: Float[np.ndarray, "v 2"],
    config: EvidenceConfig,
) -> Evidence:
    """Measure the evidence of a pose in its inliers. The counts of other matches are 0.

    Args:
        covariance: that of the left perturbation of cam_from_world (metres, radians).
        num_visible: number of map points in view.
        found_img: pixels of the visible points that are found. None: those of the inliers.
        visible_img: pixels of points that must be found.
    """
    width, height = fit.camera.width, fit.camera.height
    points_img = fit.features.points_img[fit.inlier_query_idx].astype(np.float64)
    found_img = points_img if found_img is None else found_img
    return Evidence(
        num_matches=0,
        num_inliers=0,
        num_found=fit.num_inliers,
        num_visible=num_visible,
        num_by_chance=0,
        spread=compute_inlier_spread(points_img, width, height),
        doubt=compute_normalized_uncertainty(covariance, fit.median_depth, config),
        even_share=compute_uniform_inlier_ratio(found_img, visible_img, width, height),
    )


def compute_inlier_spread(points_img: Float[np.ndarray, "n 2"], width: int, height: int) -> float:
    """Compute `Evidence.spread` from the inliers' pixels."""
    return len(np.unique(_cells(points_img, width, height))) / int(_GRID.prod())


def compute_uniform_inlier_ratio(
    found_img: Float[np.ndarray, "f 2"],
    visible_img: Float[np.ndarray, "v 2"],
    width: int,
    height: int,
) -> float:
    """Compute `Evidence.even_share` from the pixels of found and of visible points.

    It is the geometric mean, over the visible points, of the share found in their cells. A similar
    place explains most of the image. Nothing is found where the two places differ, which an
    arithmetic mean would hide.
    """
    if len(visible_img) == 0:
        return 0.0
    num_visible = np.bincount(_cells(visible_img, width, height), minlength=int(_GRID.prod()))
    num_found = np.bincount(_cells(found_img, width, height), minlength=int(_GRID.prod()))
    return float(
        np.exp(
            np.sum(num_visible * np.log((num_found + 0.5) / (num_visible + 4.0))) / len(visible_img)
        )
    )


def _cells(points_img: Float[np.ndarray, "n 2"], width: int, height: int) -> Int[np.ndarray, " n"]:
    cells = np.clip((points_img + 0.5) * _GRID / [width, height], 0, _GRID - 1).astype(int)
    return cells[:, 1] * _GRID[0] + cells[:, 0]


def is_only_imprecise(
    evidence: Evidence, log_odds: float, weights: FittedWeights, config: EvidenceConfig
) -> bool:
    """Return whether a pose with these log-odds would be accepted if it were more precise."""
    log_odds += _log_odds_if_precise(evidence, weights) - weights.log_odds(evidence)
    return 1.0 / (1.0 + math.exp(-log_odds)) >= config.min_probability


def _log_odds_if_precise(evidence: Evidence, weights: FittedWeights) -> float:
    """Return the log-odds of a pose if it were precise enough."""
    return weights.log_odds(replace(evidence, doubt=min(evidence.doubt, _PRECISE_DOUBT)))


def compute_evidence(
    search: Search,
    final: PoseFit,
    covariance: Float[np.ndarray, "6 6"],
    unguided: PointMatches | None,
    repeats: Evidence | None,
) -> Evidence | None:
    """Compute the evidence for a refined pose, None if it cannot become probable.

    The matches `unguided` are enough if they make the pose clear. Otherwise, or if they are None,
    the nodes around the final pose are matched. They are often nearer than those of the coarse
    search. If the pose repeats another one, its unguided matches support both.

    Args:
        covariance: that of the left perturbation of cam_from_world (metres, radians).
        unguided: the proposal's matches, if no pose guided them.
        repeats: the evidence for the pose that is repeated.
    """
    weights, may_be_hopeless = search.weights, True
    hopeless = weights.evidence.hopeless_log_odds
    counted = _count_found_points(search, final, covariance)
    if repeats is not None:
        return replace(
            counted,
            num_by_chance=repeats.num_by_chance,
            num_matches=repeats.num_matches,
            num_inliers=repeats.num_inliers,
        )
    counted = _with_chance_matches(search, counted, final)
    if unguided is not None:
        evidence = _with_unguided(search, counted, unguided, final)
        log_odds = weights.log_odds(evidence)
        if weights.evidence.is_clear(log_odds):
            return evidence
        may_be_hopeless = log_odds < 2.0 * hopeless
    if _log_odds_if_precise(_assume_all_agree(counted, final), weights) < hopeless:
        return None  # for any unguided matches
    matcher = create_unguided_matcher(search, final)
    if may_be_hopeless:
        strongest = _unguided(final, matcher.match_first(search.config.num_first_features))
        of_strongest = _with_unguided(search, counted, strongest, final)
        if _log_odds_if_precise(of_strongest, weights) < 2.0 * hopeless:
            return None  # for any matches of other features
    return _with_unguided(search, counted, _unguided(final, matcher.match_first()), final)


def compute_best_case_evidence(
    search: Search, final: PoseFit, covariance: Float[np.ndarray, "6 6"]
) -> Evidence:
    """Compute the evidence for a refined pose if all unguided matches agreed with it."""
    counted = _count_found_points(search, final, covariance)
    return _assume_all_agree(_with_chance_matches(search, counted, final), final)


def _count_found_points(
    search: Search, final: PoseFit, covariance: Float[np.ndarray, "6 6"]
) -> Evidence:
    """Count the points found at their predicted pixels.

    If the feature type has dense descriptors, a point is found for `Evidence.even_share` if they
    agree. Otherwise it is found if it has a key point match. `covariance` is that of the left
    perturbation of cam_from_world.
    """
    dense, agreeing_img, points = final.features.dense, None, final.local_map
    visible, visible_img = select_visible_points(
        points.points_world, final.pose.cam_from_world, final.camera
    )
    num_visible = len(visible_img)
    if dense is not None and num_visible > 0:
        sampled = sample_rows(num_visible)  # more points do not change the ratio
        visible_img = visible_img[sampled]
        agreeing = dense.check_agreement(visible_img, points.descriptors[visible[sampled]])
        agreeing_img = visible_img[agreeing]
    config = search.config.evidence
    return measure_evidence(final, covariance, num_visible, agreeing_img, visible_img, config)


def _with_chance_matches(search: Search, evidence: Evidence, final: PoseFit) -> Evidence:
    """Return the evidence with the number of matches that a wrong pose would give."""
    around = final.local_map, final.pose.cam_from_world, final.camera
    num_by_chance = count_chance_matches(final.features, *around, search.config.guided)
    return replace(evidence, num_by_chance=num_by_chance)


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
        final.pose.cam_from_world,
        final.camera,
        agreement_px,
        _repetition_shifts(search, final),
    )
    return replace(evidence, num_matches=len(unguided.matches), num_inliers=num_agreeing)


def create_unguided_matcher(search: Search, final: PoseFit) -> Matcher:
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
    points_world = unguided.local_map.points_world[unguided.matches.train_idx]
    copies = np.vstack([np.zeros(3), shifts])[:, None] + points_world
    with np.errstate(invalid="ignore"):
        pixels = camera.img_from_cam(cam_from_world.apply(copies.reshape(-1, 3)))
        offsets = pixels.reshape(*copies.shape[:2], 2)
        offsets -= unguided.features.points_img[unguided.matches.query_idx]
        is_near = np.linalg.norm(offsets, axis=2) < agreement_px * camera.radius_scale
    return int(np.count_nonzero(is_near.any(axis=0)))


def _repetition_shifts(search: Search, final: PoseFit) -> Float[np.ndarray, "k 3"]:
    """Return the repetition shifts (metres, world) of the pose's node."""
    return search.map.repeats(search.map.topomap.row_of(final.node_id))
