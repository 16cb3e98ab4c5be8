"""What is believed of a query image: hypotheses with their odds, beside "nowhere in the map"; and
the answer that follows.

Every hypothesis excludes the others, and its odds against nothing at all say little of which of
them is right: a place that repeats itself has most of its things twice. What tells two of them
apart is the part of the picture where they differ, in which the wrong one finds nothing (the even
share found), and that the wrong one, which has only some of the picture to stand on, is less
precise (the doubt). So between two hypotheses the weights of `RivalWeights` count, in logarithms;
where one of them comes from walls, whose evidence is of another kind, their odds do. With odds o of
the best hypothesis against "nowhere" and odds of e^d against each other one, by which it leads
that, it is right with the probability 1 / (1 + 1/o + sum of e^-d).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.evidence import (
    Evidence,
    EvidenceConfig,
    compute_precision_probability,
    compute_rival_score,
)
from topoloc.localization.fitted_weights import RivalWeights
from topoloc.localization.pose_fit import PoseFit

MIN_LOG_ODDS_MARGIN = 2.0
"""By how much the best hypothesis must lead the next one, in logarithms of odds, to be an
answer."""
_CHI_SQUARE_6_AT_95 = 12.592


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose with the evidence for it.

    `covariance` is that of the left perturbation of cam_from_world, `noise_share` of it differs
    from picture to picture; `log_odds` are those of "here" against "nowhere".
    """

    source: str
    fit: PoseFit
    evidence: Evidence
    covariance: Float[np.ndarray, "6 6"]
    noise_share: float
    log_odds: float

    @property
    def world_from_cam(self) -> Rigid3:
        return self.fit.world_from_cam

    @cached_property
    def variance(self) -> float:
        """No direction has more."""
        return float(np.trace(self.covariance))

    @property
    def probability(self) -> float:
        """That of "here" against "nowhere" alone."""
        return compute_precision_probability(self.evidence) / (1.0 + math.exp(-self.log_odds))

    @property
    def is_from_virtual_views(self) -> bool:
        return self.evidence.is_from_virtual_views


def log_odds_margin(a: Hypothesis, b: Hypothesis, weights: RivalWeights) -> float:
    """By how much `a` is likelier than `b`, in logarithms of odds."""
    return float(_log_odds_margins((a, b), weights)[0, 1])


def _log_odds_margins(
    hypotheses: tuple[Hypothesis, ...], weights: RivalWeights
) -> Float[np.ndarray, "n n"]:
    """By how much each is likelier than each: by their strengths, or their odds where one of the
    two comes from walls."""
    scores = np.array(
        [compute_rival_score(one.evidence, one.log_odds, weights) for one in hypotheses]
    )
    log_odds = np.array([one.log_odds for one in hypotheses])
    from_walls = np.array([one.is_from_virtual_views for one in hypotheses])
    by_odds = from_walls[:, None] | from_walls
    return np.where(by_odds, log_odds[:, None] - log_odds, scores[:, None] - scores)


def is_same_pose(a: PoseFit, b: PoseFit, config: EvidenceConfig) -> bool:
    """Do two poses say the same? They do where they are as near as two right ones can be, or stand
    on the same points of the map.

    A pose that is not precise yet may be far from the one that it will become, but sees the same
    things in the same features; two places that look alike explain the same features by different
    points.
    """
    distance = np.linalg.norm(a.world_from_cam.translation - b.world_from_cam.translation)
    if distance < 2.0 * config.max_translation and _relative_pose(a, b).angle() < math.radians(
        2.0 * config.max_rotation_deg
    ):
        return True
    if a.features is not b.features or not a.may_share_points(b):
        return False
    rows_a, rows_b = (
        fit.matches.query_idx[fit.pose.inliers] for fit in (a, b) if fit.pose is not None
    )
    _, of_a, of_b = np.intersect1d(rows_a, rows_b, return_indices=True)
    if 2 * len(of_a) < min(len(rows_a), len(rows_b)):
        return False
    points_a, points_b = (
        a.local_map.points_world[_inlier_point_idx(a)[of_a]],
        b.local_map.points_world[_inlier_point_idx(b)[of_b]],
    )
    radii = np.maximum(
        a.local_map.radii[_inlier_point_idx(a)[of_a]], b.local_map.radii[_inlier_point_idx(b)[of_b]]
    )
    return bool(np.mean(np.linalg.norm(points_a - points_b, axis=1) <= radii) > 0.5)


def _inlier_point_idx(fit: PoseFit) -> np.ndarray:
    assert fit.pose is not None
    return fit.matches.train_idx[fit.pose.inliers]


@dataclass(frozen=True, eq=False)
class Belief:
    """The hypotheses so far, of each pose the one with the most for it.

    `all_hypotheses` are all that came, for "the same pose" does not carry over: of a row of three
    the middle one may say the same as both ends, which differ. So which are left out is decided
    anew with each, from the strongest down, and the order in which they came counts nothing.
    """

    hypotheses: tuple[Hypothesis, ...] = ()
    all_hypotheses: tuple[Hypothesis, ...] = ()
    _same_pose_as: tuple[frozenset[int], ...] = ()
    """Of each of these, which of those before it say the same, by their place among them."""

    def with_hypothesis(
        self, hypothesis: Hypothesis, config: EvidenceConfig, weights: RivalWeights
    ) -> Belief:
        """With one more hypothesis."""
        same_as_new = frozenset(
            k
            for k, other in enumerate(self.all_hypotheses)
            if _agree_on_pose(hypothesis, other, config)
        )
        all_hypotheses, same_pose = (
            (*self.all_hypotheses, hypothesis),
            (*self._same_pose_as, same_as_new),
        )
        places, kept = {id(one): k for k, one in enumerate(all_hypotheses)}, list[int]()
        for k in (places[id(one)] for one in _rank_hypotheses(all_hypotheses, weights)):
            if not any(min(k, other) in same_pose[max(k, other)] for other in kept):
                kept.append(k)
        return Belief(tuple(all_hypotheses[k] for k in kept), all_hypotheses, same_pose)

    def ranked(self, weights: RivalWeights) -> list[Hypothesis]:
        """The hypotheses, the one that leads all others first."""
        return _rank_hypotheses(self.hypotheses, weights)

    def best(self, weights: RivalWeights) -> Hypothesis | None:
        """The likeliest hypothesis, believed or not."""
        return self.ranked(weights)[0] if self.hypotheses else None


def _rank_hypotheses(hypotheses: tuple[Hypothesis, ...], weights: RivalWeights) -> list[Hypothesis]:
    if len(hypotheses) < 2:
        return list(hypotheses)
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


def _agree_on_pose(a: Hypothesis, b: Hypothesis, config: EvidenceConfig) -> bool:
    """As `is_same_pose`; also where their covariances leave open that both are right."""
    if is_same_pose(a.fit, b.fit, config):
        return True
    limit = _CHI_SQUARE_6_AT_95 * (a.variance + b.variance)
    apart = a.world_from_cam.rotation.T @ (
        b.world_from_cam.translation - a.world_from_cam.translation
    )
    if apart @ apart > limit or (turn := _relative_pose(a.fit, b.fit)).angle() ** 2 > limit:
        return False  # the vector below is longer than either
    vector = turn.log()
    return (
        float(vector @ np.linalg.solve(a.covariance + b.covariance, vector)) < _CHI_SQUARE_6_AT_95
    )


def _relative_pose(a: PoseFit, b: PoseFit) -> Rigid3:
    """From the camera of one to that of the other."""
    return a.world_from_cam.inverse() @ b.world_from_cam
