"""Weigh the evidence for a pose as odds.

An inlier count alone is not a test. RANSAC finds a dozen inliers in any image, and poses in
repeated patterns collect many more. A wrong pose does not agree with data that it was not fitted
to. Most visible map points are then missing at their predicted pixels in some part of the image. Or
no more of them are found than a third of the image away, where only chance matches are found.

So the regression uses these two ratios and the number and ratio of inliers among the unguided
matches. It also uses the share of the image that the found points cover. A pose at the right place
may still be imprecise. The last feature is therefore the covariance relative to the tolerance.

The weights come from a logistic regression on right and wrong poses. Each feature type has its own
(`fitted_weights.py`). The weight of the normalized uncertainty is set by hand: wrong places in a
corridor of many doors have precise poses, and a free weight would go to zero.

Virtual views (`walls/`) have weights of their own. Walls repeat more than rooms do, and fewer of
their points are recognised at a slant. Two more features count there. The first is the number of
found key points that match here better than anywhere else in the map. The second is the agreement
of both side views, because one wall alone may match a similar place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from jaxtyping import Float, Int

from topoloc.bounds import AtLeast, Between
from topoloc.localization.fitted_weights import EvidenceWeights, FittedWeights, RivalWeights
from topoloc.localization.provenance import Evidence

COLUMNS, ROWS = 8, 6
"""Grid of cells over the image. The inlier spread is the share of cells with an inlier."""


@dataclass(frozen=True)
class EvidenceConfig:
    """Configure the tolerance of a right pose and the conditions for reporting one."""

    max_translation: ClassVar[float] = 0.25
    """Maximum position error of a right pose, metres. `depth_share` of the distance of the seen
    points replaces it if that is less."""
    max_rotation_deg: ClassVar[float] = 2.0
    """Maximum rotation error of a right pose, degrees."""
    min_inliers: Annotated[int, AtLeast(4)] = 5
    """Minimum number of inliers of a pose proposal. Proposals with fewer are not tested."""
    min_found: Annotated[int, AtLeast(4)] = 12
    """Minimum number of map points found at their predicted pixels."""
    min_probability: Annotated[float, Between(0, 1)] = 0.5
    """Minimum probability of a reported pose."""


def compute_translation_tolerance(median_depth: float, config: EvidenceConfig) -> float:
    """Return the maximum position error (metres) of a right pose for points `median_depth` (metres)
    away."""
    # Maximum position error as a share of the median distance of the seen points.
    depth_share = 0.05
    return min(config.max_translation, depth_share * median_depth)


def compute_normalized_uncertainty(
    covariance: Float[np.ndarray, "6 6"], median_depth: float, config: EvidenceConfig
) -> float:
    """Compute `Evidence.doubt` from a covariance.

    The covariance is that of the left perturbation of cam_from_world (metres, radians).
    """
    metres = math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]) / compute_translation_tolerance(
        median_depth, config
    )
    return math.hypot(
        metres,
        math.degrees(math.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
        / config.max_rotation_deg,
    )


def compute_inlier_spread(points_img: Float[np.ndarray, "n 2"], width: int, height: int) -> float:
    """Compute `Evidence.spread` from the inliers' pixels."""
    return len(np.unique(_cells(points_img, width, height))) / (COLUMNS * ROWS)


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
    num_visible = np.bincount(_cells(visible_img, width, height), minlength=COLUMNS * ROWS)
    num_found = np.bincount(_cells(found_img, width, height), minlength=COLUMNS * ROWS)
    return float(
        np.exp(
            np.sum(num_visible * np.log((num_found + 0.5) / (num_visible + 4.0))) / len(visible_img)
        )
    )


def _cells(points_img: Float[np.ndarray, "n 2"], width: int, height: int) -> Int[np.ndarray, " n"]:
    columns = np.clip((points_img[:, 0] + 0.5) * COLUMNS / width, 0, COLUMNS - 1).astype(int)
    rows = np.clip((points_img[:, 1] + 0.5) * ROWS / height, 0, ROWS - 1).astype(int)
    return rows * COLUMNS + columns


def compute_score_features(evidence: Evidence) -> tuple[float, ...]:
    """Return the inputs of the regression, as logarithms.

    The added constants reduce the influence of small counts.
    """
    e = evidence
    return (
        math.log(e.even_share + 0.002),
        math.log((e.num_found + 1) / (e.num_by_chance + 5)),
        math.log(e.num_inliers + 1),
        math.log((e.num_inliers + 1) / (e.num_matches + 10)),
        math.log(e.spread + 0.02),
        math.log(max(e.doubt, 0.01)),
    )


def compute_log_odds(evidence: Evidence, weights: FittedWeights) -> float:
    """Compute the log-odds that the pose is right."""
    if evidence.is_from_virtual_views:
        features, walls = compute_virtual_view_features(evidence), weights.walls
        return (
            sum(weight * x for weight, x in zip(walls.as_vector, features, strict=True))
            + walls.bias
        )
    return compute_node_log_odds(evidence, weights.evidence)


def compute_node_log_odds(evidence: Evidence, weights: EvidenceWeights) -> float:
    """Compute the log-odds of a pose found by the map's nodes."""
    return (
        sum(
            weight * x
            for weight, x in zip(weights.as_vector, compute_score_features(evidence), strict=True)
        )
        + weights.bias
    )


def compute_rival_score(evidence: Evidence, log_odds: float, rivals: RivalWeights) -> float:
    """Compute the score of a pose found by nodes. The difference of two scores is a log-odds
    margin."""
    even, doubt = math.log(evidence.even_share + 0.002), math.log(max(evidence.doubt, 0.01))
    return rivals.odds * log_odds + rivals.even_share * even + rivals.doubt * doubt


def compute_virtual_view_features(evidence: Evidence) -> tuple[float, ...]:
    """Return the inputs of the regression for a pose found by virtual views."""
    e = evidence
    assert e.num_distinct is not None
    return (
        math.log((e.num_found + 1) / (e.num_visible + 20)),
        math.log((e.num_found + 1) / (e.num_by_chance + 5)),
        math.log(e.num_inliers + 1),
        math.log((e.num_inliers + 1) / (e.num_matches + 10)),
        math.log(e.spread + 0.02),
        math.log(e.num_distinct + 1),
        math.log((e.num_lesser_side or 0) + 2),
        math.log(e.even_share + 0.002),
        math.log(max(e.doubt, 0.01)),
    )


def compute_precision_probability(evidence: Evidence) -> float:
    """Return the probability that a pose at the right place is within the tolerance.

    It is 1 for a pose of the nodes, whose log-odds include the precision already. A single wall may
    leave a pose imprecise although the place is certain.
    """
    return probability_within_tolerance(evidence.doubt) if evidence.is_from_virtual_views else 1.0


def probability_within_tolerance(doubt: float) -> float:
    """Return the probability that a normal error is within the tolerance.

    `doubt` is the standard deviation divided by the tolerance.
    """
    return math.erf(1.0 / (math.sqrt(2.0) * doubt))


def is_only_imprecise(evidence: Evidence, weights: FittedWeights, config: EvidenceConfig) -> bool:
    """Return whether the pose would be accepted if it were more precise."""
    log_odds = compute_log_odds(replace(evidence, doubt=min(evidence.doubt, 0.3)), weights)
    return 1.0 / (1.0 + math.exp(-log_odds)) >= config.min_probability
