"""Is this pose right? The evidence for it, weighed as a probability.

A count of inliers alone is no test: RANSAC finds a dozen of them in any picture, and poses of repeated patterns collect
many more. What a wrong pose cannot have is agreement beyond what it was fitted to: most map points that must be in view
are then not found where they must be, least of all in every part of the picture, or no more of them than a third of the picture
away, where chance alone finds some. So these two ratios count, beside the number and the share of matches that no pose guided and
that agree with it all the same, and how much of the picture the points found cover. What a pose from the right place may lack is
precision: its own covariance, beside what is tolerated, says so.

The weights are those of a logistic regression on poses tried, right and wrong ones; each kind of features has its own
(`fitted_weights.py`). That of the doubt is set by hand: wrong places in a corridor of many doors come with precise
poses, and a free weight would follow them to zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from topoloc.localization.fitted_weights import EvidenceWeights

COLUMNS, ROWS = 8, 6
"""The cells of a picture whose number with an inlier in it measures the inliers' spread."""


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose.

    `num_matches` and `num_inliers` are those of the first, unguided match; `num_found` of the `num_visible` map points that
    must be in view were found where they must be seen; `num_by_chance` of them would be were the pose wrong. `spread` is the
    share of the picture's cells that hold one of them, `even_share` the share found of what must be in view, every part of the view
    asked on its own (`even_share_of`), `doubt` the pose's standard deviation in its worst direction over what
    is tolerated: 1 where the two are equal.
    """

    num_matches: int
    num_inliers: int
    num_found: int
    num_visible: int
    num_by_chance: int
    spread: float
    doubt: float
    even_share: float


@dataclass(frozen=True)
class VerificationConfig:
    """What a right pose is, and what is asked of an answer."""

    max_translation: float = 0.25
    """A right pose is no further off than this (metres), nor than `depth_share` of the distance of what is seen, if that is less."""
    depth_share: float = 0.05
    max_rotation_deg: float = 2.0
    agreement_px: float = 4.0
    """Unguided matches within this of the final pose agree with it, in an image whose longer side is 640 pixels; grows with that."""
    min_inliers: int = 5
    """With fewer, a first pose is not even tried out."""
    min_found: int = 12
    """Map points found where the pose says they must be, at least."""
    min_probability: float = 0.5
    """Poses less probable than this are not reported."""


def tolerated_translation(median_depth: float, config: VerificationConfig) -> float:
    """How far (metres) a right pose may be off where the points seen are `median_depth` (metres) away."""
    return min(config.max_translation, config.depth_share * median_depth)


def doubt_of(covariance: Float[np.ndarray, "6 6"], median_depth: float, config: VerificationConfig) -> float:
    """`Evidence.doubt`, of the covariance of the left perturbation of cam_from_world (metres, radians)."""
    metres = math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]) / tolerated_translation(median_depth, config)
    return math.hypot(metres, math.degrees(math.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])) / config.max_rotation_deg)


def spread_of(points_img: Float[np.ndarray, "n 2"], width: int, height: int) -> float:
    """`Evidence.spread` of the inliers' pixels."""
    return len(np.unique(_cells(points_img, width, height))) / (COLUMNS * ROWS)


def even_share_of(found_img: Float[np.ndarray, "f 2"], visible_img: Float[np.ndarray, "v 2"], width: int, height: int) -> float:
    """`Evidence.even_share`, of the pixels of points found and of all that must be in view: the share found in the cell of each
    visible point, as a geometric mean.

    A place that repeats itself explains most of a picture from its twin; where the two differ nothing is found, which a mean would hide.
    """
    if len(visible_img) == 0:
        return 0.0
    num_visible = np.bincount(_cells(visible_img, width, height), minlength=COLUMNS * ROWS)
    num_found = np.bincount(_cells(found_img, width, height), minlength=COLUMNS * ROWS)
    return float(np.exp(np.sum(num_visible * np.log((num_found + 0.5) / (num_visible + 4.0))) / len(visible_img)))


def _cells(points_img: Float[np.ndarray, "n 2"], width: int, height: int) -> Int[np.ndarray, " n"]:
    columns = np.clip((points_img[:, 0] + 0.5) * COLUMNS / width, 0, COLUMNS - 1).astype(int)
    rows = np.clip((points_img[:, 1] + 0.5) * ROWS / height, 0, ROWS - 1).astype(int)
    return rows * COLUMNS + columns


def score_features(evidence: Evidence) -> tuple[float, ...]:
    """What the regression weighs: logarithms; the added constants keep small counts from weighing too much."""
    e = evidence
    return (
        math.log(e.even_share + 0.002),
        math.log((e.num_found + 1) / (e.num_by_chance + 5)),
        math.log(e.num_inliers + 1),
        math.log((e.num_inliers + 1) / (e.num_matches + 10)),
        math.log(e.spread + 0.02),
        math.log(max(e.doubt, 0.01)),
    )


def log_odds_of(evidence: Evidence, weights: EvidenceWeights) -> float:
    """Logarithm of the odds that the pose is right."""
    return sum(weight * x for weight, x in zip(weights.in_order, score_features(evidence), strict=True)) + weights.bias


def probability_of(evidence: Evidence, weights: EvidenceWeights) -> float:
    """The probability, in [0, 1], that the pose is right."""
    return 1.0 / (1.0 + math.exp(-log_odds_of(evidence, weights)))


def is_only_imprecise(evidence: Evidence, weights: EvidenceWeights, config: VerificationConfig) -> bool:
    """Would the same evidence do if the pose it gives were more precise?"""
    return probability_of(replace(evidence, doubt=min(evidence.doubt, 0.3)), weights) >= config.min_probability
