"""Is this pose right? The evidence for it, weighed as odds.

A count of inliers alone is no test: RANSAC finds a dozen of them in any picture, and poses of
repeated patterns collect many more. What a wrong pose cannot have is agreement beyond what it was
fitted to: most map points that must be in view are then not found where they must be, least of all
in every part of the picture, or no more of them than a third of the picture away, where chance
alone finds some. So these two ratios count, beside the number and the share of matches that no pose
guided and that agree with it all the same, and how much of the picture the points found cover. What
a pose from the right place may lack is precision: its own covariance, beside what is tolerated,
says so.

The weights are those of a logistic regression on poses tried, right and wrong ones; each kind of
features has its own (`fitted_weights.py`). That of the doubt is set by hand: wrong places in a
corridor of many doors come with precise poses, and a free weight would follow them to zero. Walls
that are seen from the other side (`walls/`) repeat themselves more than a room does, and less of
them is recognised at a slant: the same evidence has weights of its own there, and it also counts
how many of the key points found look more like the map's point here than like any elsewhere, and
whether both walls agree: one alone may be a twin's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from topoloc.bounds import Above, AtLeast, Between
from topoloc.localization.fitted_weights import EvidenceWeights, FittedWeights, RivalWeights

COLUMNS, ROWS = 8, 6
"""The cells of a picture whose number with an inlier in it measures the inliers' spread."""


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose.

    `num_matches` and `num_inliers` are those of the first, unguided match; `num_found` of the
    `num_visible` map points that must be in view were found where they must be seen;
    `num_by_chance` of them would be were the pose wrong. `spread` is the share of the picture's
    cells that hold one of them, `even_share` the share found of what must be in view, every part of
    the view asked on its own (`compute_uniform_inlier_ratio`), `doubt` the pose's standard
    deviation in its worst direction over what is tolerated: 1 where the two are equal. Of walls
    only, `num_distinct` of the points found look more like the map's point here than like any
    elsewhere, and `num_lesser_side` are those of the wall, of the two, of which fewer were found.
    """

    num_matches: int
    num_inliers: int
    num_found: int
    num_visible: int
    num_by_chance: int
    spread: float
    doubt: float
    even_share: float
    num_distinct: int | None = None
    num_lesser_side: int | None = None

    @property
    def is_from_virtual_views(self) -> bool:
        """Is the pose one that the walls along the way let expect, not the map's nodes?"""
        return self.num_distinct is not None


@dataclass(frozen=True)
class EvidenceConfig:
    """What a right pose is, and what is asked of an answer."""

    max_translation: Annotated[float, Above(0)] = 0.25
    """A right pose is no further off than this (metres), nor than `depth_share` of the distance of
    what is seen, if that is less."""
    depth_share: Annotated[float, Above(0)] = 0.05
    """See `max_translation`."""
    max_rotation_deg: Annotated[float, Between(0.001, 180)] = 2.0
    """A right pose is turned by no more than this."""
    agreement_px: Annotated[float, Above(0)] = 4.0
    """Unguided matches within this of the final pose agree with it, in an image whose longer side
    is 640 pixels; grows with that."""
    min_inliers: Annotated[int, AtLeast(4)] = 5
    """With fewer, a first pose is not even tried out."""
    min_found: Annotated[int, AtLeast(4)] = 12
    """Map points found where the pose says they must be, at least."""
    min_probability: Annotated[float, Between(0, 1)] = 0.5
    """Poses less probable than this are not reported."""


def compute_translation_tolerance(median_depth: float, config: EvidenceConfig) -> float:
    """How far (metres) a right pose may be off where the points seen are `median_depth` (metres)
    away."""
    return min(config.max_translation, config.depth_share * median_depth)


def compute_normalized_uncertainty(
    covariance: Float[np.ndarray, "6 6"], median_depth: float, config: EvidenceConfig
) -> float:
    """`Evidence.doubt`, of the covariance of the left perturbation of cam_from_world (metres,
    radians)."""
    metres = math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]) / compute_translation_tolerance(
        median_depth, config
    )
    return math.hypot(
        metres,
        math.degrees(math.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
        / config.max_rotation_deg,
    )


def compute_inlier_spread(points_img: Float[np.ndarray, "n 2"], width: int, height: int) -> float:
    """`Evidence.spread` of the inliers' pixels."""
    return len(np.unique(_cells(points_img, width, height))) / (COLUMNS * ROWS)


def compute_uniform_inlier_ratio(
    found_img: Float[np.ndarray, "f 2"],
    visible_img: Float[np.ndarray, "v 2"],
    width: int,
    height: int,
) -> float:
    """`Evidence.even_share`, of the pixels of points found and of all that must be in view: the
    share found in the cell of each visible point, as a geometric mean.

    A place that repeats itself explains most of a picture from its twin; where the two differ
    nothing is found, which a mean would hide.
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
    """What the regression weighs: logarithms; the added constants keep small counts from weighing
    too much."""
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
    """Logarithm of the odds that the pose is right."""
    if evidence.is_from_virtual_views:
        features, walls = compute_virtual_view_features(evidence), weights.walls
        return (
            sum(weight * x for weight, x in zip(walls.parallel_map, features, strict=True))
            + walls.bias
        )
    return compute_node_log_odds(evidence, weights.evidence)


def compute_node_log_odds(evidence: Evidence, weights: EvidenceWeights) -> float:
    """The same of a pose that the map's nodes let expect, not its walls."""
    return (
        sum(
            weight * x
            for weight, x in zip(
                weights.parallel_map, compute_score_features(evidence), strict=True
            )
        )
        + weights.bias
    )


def compute_rival_score(evidence: Evidence, log_odds: float, rivals: RivalWeights) -> float:
    """By how much more of this a pose that the nodes let expect leads another one, in logarithms of
    odds."""
    even, doubt = math.log(evidence.even_share + 0.002), math.log(max(evidence.doubt, 0.01))
    return rivals.odds * log_odds + rivals.even_share * even + rivals.doubt * doubt


def compute_virtual_view_features(evidence: Evidence) -> tuple[float, ...]:
    """As `compute_score_features`, of a pose that the walls let expect."""
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
    """The probability that a pose from the right place is as precise as is asked; 1 where the odds
    count that already.

    A wall alone may leave a pose imprecise though the place is beyond doubt.
    """
    return probability_within_tolerance(evidence.doubt) if evidence.is_from_virtual_views else 1.0


def probability_within_tolerance(doubt: float) -> float:
    """The probability that an error of so many times what is tolerated (one standard deviation) is
    tolerable."""
    return math.erf(1.0 / (math.sqrt(2.0) * doubt))


def is_only_imprecise(evidence: Evidence, weights: FittedWeights, config: EvidenceConfig) -> bool:
    """Would the same evidence do if the pose it gives were more precise?"""
    log_odds = compute_log_odds(replace(evidence, doubt=min(evidence.doubt, 0.3)), weights)
    return 1.0 / (1.0 + math.exp(-log_odds)) >= config.min_probability
