"""Is this pose right? The evidence for it, weighed as a probability.

A count of inliers alone is no test: RANSAC finds a dozen of them in any picture, and poses of repeated patterns collect
many more. What a wrong pose cannot have is agreement beyond what it was fitted to: most map points that must be in view
are then not found where they must be, least of all in every part of the picture, or no more of them than a third of the picture
away, where chance alone finds some. So these two ratios count, beside the number and the share of matches that no pose guided and
that agree with it all the same, and how much of the picture the points found cover. What a pose from the right place may lack is
precision: its own covariance, beside what is tolerated, says so.

The weights are those of a logistic regression on 8,152 poses, 1,244 of them right: rooms, streets and corridors asked about
themselves, in good light and bad, from the other side, about each other, about noise, lettering and repeated patterns
(`benchmarks/acceptance.py` repeats it). That of the doubt is set by hand: wrong places in a corridor of many doors come with precise
poses, and a free weight would follow them to zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from topoloc.bounds import Above, AtLeast, Between, Fitted

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
    """What a right pose is, the weights of the logistic regression, and what is asked of an answer."""

    max_translation: Annotated[float, Above(0)] = 0.25
    """A right pose is no further off than this (metres), nor than `depth_share` of the distance of what is seen, if that is less."""
    depth_share: Annotated[float, Above(0)] = 0.05
    """See `max_translation`."""
    max_rotation_deg: Annotated[float, Between(0.001, 180)] = 2.0
    """A right pose is turned by no more than this."""
    agreement_px: Annotated[float, Above(0)] = 4.0
    """Unguided matches within this of the final pose agree with it, in an image whose longer side is 640 pixels; grows with that."""
    min_inliers: Annotated[int, AtLeast(4)] = 5
    """With fewer, a first pose is not even tried out."""
    min_found: Annotated[int, AtLeast(4)] = 12
    """Map points found where the pose says they must be, at least."""
    min_probability: Annotated[float, Between(0, 1)] = 0.5
    """Poses less probable than this are not reported."""
    clear_log_odds: Annotated[float, Between(-100, 100)] = 4.5
    """A pose with more for it (logarithm of its odds) is clear: only parts of the map that look nearly the same are asked then.
    The clearest of 6,908 wrong poses had 3.9."""
    even_share_weight: Annotated[float, Fitted()] = 2.13
    chance_weight: Annotated[float, Fitted()] = 0.73
    inliers_weight: Annotated[float, Fitted()] = 0.12
    inlier_share_weight: Annotated[float, Fitted()] = 2.29
    spread_weight: Annotated[float, Fitted()] = 0.8
    doubt_weight: Annotated[float, Fitted()] = -0.5
    bias: Annotated[float, Fitted()] = 7.64
    """Above the 7.34 of the fit, whose wrong poses are mostly twins in a corridor that repeats itself; those are left to `rivals.py`.
    Of 3,799 poses of pictures from elsewhere the most probable is then right with the probability 0.35."""

    @property
    def weights(self) -> tuple[float, ...]:
        """In the order of `score_features`."""
        evidence = (self.even_share_weight, self.chance_weight, self.inliers_weight, self.inlier_share_weight)
        return (*evidence, self.spread_weight, self.doubt_weight)


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


def log_odds_of(evidence: Evidence, config: VerificationConfig) -> float:
    """Logarithm of the odds that the pose is right."""
    return sum(weight * x for weight, x in zip(config.weights, score_features(evidence), strict=True)) + config.bias


def probability_of(evidence: Evidence, config: VerificationConfig) -> float:
    """The probability, in [0, 1], that the pose is right."""
    return 1.0 / (1.0 + math.exp(-log_odds_of(evidence, config)))


def is_only_imprecise(evidence: Evidence, config: VerificationConfig) -> bool:
    """Would the same evidence do if the pose it gives were more precise?"""
    return probability_of(replace(evidence, doubt=min(evidence.doubt, 0.3)), config) >= config.min_probability
