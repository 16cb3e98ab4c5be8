"""Maintain the belief of a query image: pose hypotheses with odds, beside "not in the map".

The hypotheses exclude each other. The odds of one against "not in the map" do not separate two of
them, because a repetitive place contains most things twice. Two properties do. The wrong hypothesis
finds nothing in the part of the image where the places differ (the spatially uniform inlier ratio).
It is also less precise, because only a part of the image supports it (the normalized uncertainty).
`RivalWeights` weighs these in logarithms. If one of the two comes from virtual views, the
difference of their log-odds is used instead, because their evidence is of another kind.

Let o be the odds of the best hypothesis against "not in the map". Let d be its log-odds margin over
another hypothesis. Its probability is 1 / (1 + 1/o + sum of e^-d).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.config import EvidenceConfig
from topoloc.localization.fitted_weights import RivalWeights
from topoloc.localization.pose_fit import PoseFit
from topoloc.localization.provenance import Evidence

_CHI_SQUARE_6_AT_95 = 12.592
MIN_ALTERNATIVE_RATIO = 0.01  # relative to the best probability; less probable ones are dropped


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Hold a pose with its evidence.

    `covariance` is that of the left perturbation of cam_from_world. Its share `noise_share` is
    independent from image to image. `log_odds` compares this pose with "not in the map".
    """

    source: str
    fit: PoseFit
    evidence: Evidence
    covariance: Float[np.ndarray, "6 6"]
    noise_share: float
    log_odds: float

    @property
    def world_from_cam(self) -> Rigid3:
        """Return the pose."""
        return self.fit.world_from_cam

    @cached_property
    def probability(self) -> float:
        """Return the probability of this pose if "not in the map" is the only alternative."""
        return self.evidence.precision_probability / (1.0 + math.exp(-self.log_odds))


def log_odds_margin(a: Hypothesis, b: Hypothesis, weights: RivalWeights) -> float:
    """Return the log-odds margin of `a` over `b`, two hypotheses of one feature type."""
    return float(_log_odds_margins((a, b), weights)[0, 1])


T = TypeVar("T")


def share_probability(odds_against: float, margins: Sequence[float]) -> list[float]:
    """Return the probability of the best hypothesis, then that of each other one.

    Args:
        odds_against: odds of none of them against the best one.
        margins: log-odds margin of the best one over each other one.
    """
    total = 1.0 + odds_against + sum(math.exp(-margin) for margin in margins)
    return [1.0 / total, *(math.exp(-margin) / total for margin in margins)]


def select_probable(found: Sequence[T], shares: Sequence[float]) -> list[tuple[T, float]]:
    """Return those with at least 1 % of the first one's probability, with it, likeliest first."""
    pairs = zip(found, shares, strict=True)
    probable = [pair for pair in pairs if pair[1] >= MIN_ALTERNATIVE_RATIO * shares[0]]
    return sorted(probable, key=lambda pair: -pair[1])


def _log_odds_margins(
    hypotheses: Sequence[Hypothesis], weights: RivalWeights
) -> Float[np.ndarray, "n n"]:
    """Compute the log-odds margin of each hypothesis (row) over each (column).

    It is the difference of scores, or of log-odds if one of the two comes from virtual views.
    """
    scores = np.array([weights.score(one.evidence, one.log_odds) for one in hypotheses])
    log_odds = np.array([one.log_odds for one in hypotheses])
    margins = scores[:, None] - scores
    return np.where(np.isnan(margins), log_odds[:, None] - log_odds, margins)


def is_same_fit(a: PoseFit, b: PoseFit, config: EvidenceConfig) -> bool:
    """Return whether two fits describe the same pose.

    They do if both could be right within the tolerance, or if they share map points for the same
    features. An imprecise pose may be far from its refined version but matches the same features to
    the same points. Two similar places match the same features to different points.
    """
    return a.world_from_cam.is_same(
        b.world_from_cam, 2.0 * config.max_translation, math.radians(2.0 * config.max_rotation_deg)
    ) or _share_points(a, b)


def _share_points(a: PoseFit, b: PoseFit) -> bool:
    """Return whether two fits match most of their common features to the same points."""
    if a.features is not b.features or not a.may_share_points(b):
        return False
    rows_a, rows_b = a.inlier_query_idx, b.inlier_query_idx
    _, of_a, of_b = np.intersect1d(rows_a, rows_b, return_indices=True)
    if 2 * len(of_a) < min(len(rows_a), len(rows_b)):
        return False
    idx_a, idx_b = a.inlier_point_idx[of_a], b.inlier_point_idx[of_b]
    points_a, points_b = a.local_map.points_world[idx_a], b.local_map.points_world[idx_b]
    radii = np.maximum(a.local_map.radii[idx_a], b.local_map.radii[idx_b])
    return bool(np.mean(np.linalg.norm(points_a - points_b, axis=1) <= radii) > 0.5)


@dataclass(frozen=True, eq=False)
class Belief:
    """Hold the hypotheses so far, the strongest one of each pose.

    They are sorted by their least margin over the others. Those with a probability of at least 0.5
    come first.

    `all_hypotheses` holds every hypothesis added, because "the same pose" is not transitive. The
    middle one of three may equal both ends, which differ from each other. The selection is
    therefore repeated for each new hypothesis, from the strongest down. The result does not depend
    on their order.
    """

    hypotheses: tuple[Hypothesis, ...] = ()
    all_hypotheses: tuple[Hypothesis, ...] = ()
    _same_pose_as: tuple[frozenset[int], ...] = ()
    """Entry k holds the indices before k of the hypotheses with the same pose as hypothesis k."""

    def with_hypothesis(
        self, hypothesis: Hypothesis, config: EvidenceConfig, weights: RivalWeights
    ) -> Belief:
        """Return the belief with one more hypothesis."""
        same_as_new = frozenset(
            k
            for k, other in enumerate(self.all_hypotheses)
            if agree_on_pose(hypothesis, other, config)
        )
        all_hypotheses, same_pose = (
            (*self.all_hypotheses, hypothesis),
            (*self._same_pose_as, same_as_new),
        )
        places, kept = {id(one): k for k, one in enumerate(all_hypotheses)}, list[int]()
        for k in (places[id(one)] for one in _rank_hypotheses(all_hypotheses, weights)):
            if not any(min(k, other) in same_pose[max(k, other)] for other in kept):
                kept.append(k)
        distinct = _rank_hypotheses([all_hypotheses[k] for k in kept], weights)
        return Belief(tuple(distinct), all_hypotheses, same_pose)

    @property
    def of_nodes(self) -> list[Hypothesis]:
        """Return the hypotheses found by the map's nodes, not by virtual views.

        Other proposals of nodes may repeat, confirm or find these again.
        """
        return [one for one in self.hypotheses if one.evidence.is_of_nodes]


def _rank_hypotheses(
    hypotheses: Sequence[Hypothesis], weights: RivalWeights
) -> Sequence[Hypothesis]:
    if len(hypotheses) < 2:
        return hypotheses
    log_odds_margins = _log_odds_margins(hypotheses, weights)
    np.fill_diagonal(log_odds_margins, np.inf)
    least = {
        id(one): float(row.min()) for one, row in zip(hypotheses, log_odds_margins, strict=True)
    }
    return sorted(
        hypotheses,
        key=lambda one: (one.probability >= 0.5, least[id(one)], one.log_odds),
        reverse=True,
    )


def agree_on_pose(a: Hypothesis, b: Hypothesis, config: EvidenceConfig) -> bool:
    """Return whether `is_same_fit` holds, or the covariances allow both to be the same pose."""
    return is_same_fit(a.fit, b.fit, config) or a.world_from_cam.is_same(
        b.world_from_cam, covariance=a.covariance + b.covariance, max_square=_CHI_SQUARE_6_AT_95
    )
