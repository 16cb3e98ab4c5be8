"""The weights of the evidence for one pose, and what the errors of a map's points share.

A logistic regression in which nothing that speaks for a pose may count against it. The evidence of
one kind of features is much like that of another, and corpora are small: so the weights are drawn
to those of SURF, as strongly as judges families of places best that they were not fitted to. The
weight of the doubt is given, not fitted: wrong places in a corridor of many doors come with precise
poses, and a free weight would follow them to zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from msgspec.structs import replace
from scipy.optimize import minimize

from topoloc.localization.fitted_weights import (
    CorrelatedErrorWeights,
    EvidenceWeights,
    compute_log_odds,
)
from topoloc_paper.fit.corpus import family_of
from topoloc_paper.fit.tried_poses import TriedPose

_MOST_ELSEWHERE = 0.35
"""No pose of a picture from elsewhere that was fitted to may be more probable."""
_CLEAR_MARGIN = 0.6
STRENGTHS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Of the prior, in squared distances of the weights from it."""
MIN_RIGHT_POSES = 200
_CHI_SQUARE_6_AT_95 = 12.592
_INSIDE = 0.95


@dataclass(frozen=True)
class Judged:
    """What weights say of some poses: the logarithms of their odds; and which are right."""

    family: str
    log_odds: Float[np.ndarray, " n"]
    is_right: Bool[np.ndarray, " n"]


def decided(poses: list[TriedPose]) -> list[TriedPose]:
    """The poses that are right or wrong; what lies between says nothing."""
    return [pose for pose in poses if pose.is_right or pose.is_wrong]


def fit_evidence(
    poses: list[TriedPose], prior: EvidenceWeights, strength: float
) -> EvidenceWeights:
    """The weights that tell these poses' right ones from their wrong ones.

    The bias is lowered where a picture from elsewhere would be believed more than it may; a pose is
    clear that has more for it than the clearest wrong one, by a margin, and no less than with the
    prior: few poses seldom hold the clearest.

    Args:
        prior: what the weights are drawn to, with `strength`; its weight of the doubt is kept.
    """
    poses = decided(poses)
    fitted = _logistic_regression(poses, prior, strength)
    from_elsewhere = [pose for pose in poses if pose.error_m is None]
    elsewhere = judged("", from_elsewhere, fitted).log_odds.tolist()
    most = math.log(_MOST_ELSEWHERE / (1.0 - _MOST_ELSEWHERE))
    fitted = replace(fitted, bias=fitted.bias - max(max(elsewhere, default=most) - most, 0.0))
    of_wrong = judged("", [pose for pose in poses if pose.is_wrong], fitted).log_odds.tolist()
    return replace(
        fitted,
        clear_log_odds=round(
            max(max(of_wrong, default=0.0) + _CLEAR_MARGIN, prior.clear_log_odds), 3
        ),
    )


def _logistic_regression(
    poses: list[TriedPose], prior: EvidenceWeights, strength: float
) -> EvidenceWeights:
    x, is_right = (
        np.array([EvidenceWeights.features(pose.evidence) for pose in poses]),
        np.array([pose.is_right for pose in poses]),
    )
    signs, given = 2.0 * is_right - 1.0, prior.doubt * x[:, -1]
    x, start = (
        np.column_stack([x[:, :-1], np.ones(len(x))]),
        np.array([*prior.as_vector[:-1], prior.bias]),
    )

    def loss(weights: np.ndarray) -> float:
        return float(
            np.sum(np.logaddexp(0.0, -signs * (x @ weights + given)))
            + strength * np.sum((weights - start) ** 2)
        )

    bounds = [(0.0, None)] * (len(start) - 1) + [(None, None)]
    *fitted, bias = (
        float(weight)
        for weight in np.round(minimize(loss, start, bounds=bounds, method="L-BFGS-B").x, 3)
    )
    names = ("even_share", "chance", "inliers", "inlier_share", "spread")
    return replace(prior, **dict(zip(names, fitted, strict=True)), bias=bias)


def try_on_others(
    poses: list[TriedPose], prior: EvidenceWeights, strength: float, by_recording: bool = False
) -> list[Judged]:
    """Each family's poses, judged by weights fitted to those that have nothing of it.

    Args:
        by_recording: instead the poses of each recording that was asked, by those of all others:
            where only one family has places that look alike, the others cannot tell what a pose in
            them is worth.
    """
    poses, tried = decided(poses), []

    def parts(pose: TriedPose) -> tuple[str, ...]:
        return (
            (pose.queries,) if by_recording else (family_of(pose.mapping), family_of(pose.queries))
        )

    for part in dict.fromkeys(parts(pose)[0] for pose in poses):
        here = [pose for pose in poses if parts(pose)[0] == part]
        rest = [pose for pose in poses if part not in parts(pose)]
        if len({pose.is_right for pose in rest}) == 2:
            tried.append(judged(part, here, fit_evidence(rest, prior, strength)))
    return tried


def best_strength(
    poses: list[TriedPose], prior: EvidenceWeights, by_recording: bool = False
) -> float:
    """With how much of the prior those are judged best that were not fitted to (`try_on_others`),
    by the logarithm of the likelihood."""

    def loss(strength: float) -> float:
        parts = try_on_others(poses, prior, strength, by_recording)
        return sum(
            float(np.sum(np.logaddexp(0.0, np.where(part.is_right, -part.log_odds, part.log_odds))))
            for part in parts
        )

    return min(STRENGTHS, key=loss)


def judged(family: str, poses: list[TriedPose], weights: EvidenceWeights) -> Judged:
    """What these weights say of these poses."""
    odds, is_right = (
        [compute_log_odds(pose.evidence, weights) for pose in poses],
        [pose.is_right for pose in poses],
    )
    return Judged(family, np.array(odds, dtype=float), np.array(is_right, dtype=bool))


def calibration_error(log_odds: Float[np.ndarray, " n"], is_right: Bool[np.ndarray, " n"]) -> float:
    """Over ten bins of the probability the mean difference of what was said and what was so; of the
    poses that would be answered."""
    probability, is_right = 1.0 / (1.0 + np.exp(-log_odds[log_odds > 0])), is_right[log_odds > 0]
    bins = np.minimum((probability * 10).astype(int), 9)
    return float(
        sum(abs(np.sum(probability[bins == k] - is_right[bins == k])) for k in range(10))
        / max(len(bins), 1)
    )


def fit_shared_errors(
    poses: list[TriedPose], before: CorrelatedErrorWeights
) -> CorrelatedErrorWeights:
    """The least rho and the factor with which 95 % of the right poses' errors lie inside the 95 %
    ellipsoid, none smaller than before.

    The least is fitted to maps whose own rho is below it, the factor to the others; each to
    `MIN_RIGHT_POSES` or not at all, for it hangs on the few largest errors.

    Args:
        before: the weights with which the poses' rho came about.
    """
    right = [pose for pose in poses if pose.is_right and pose.square is not None]
    exact = [pose for pose in right if pose.rho <= before.least]
    others = [pose for pose in right if pose.rho > before.least]
    leasts, factors = (
        before.least * np.arange(1.0, 20.1, 0.5),
        before.factor + np.arange(0.0, 8.01, 0.1),
    )
    least = _least_inflating(exact, [np.full(len(exact), least) for least in leasts])
    factor = _least_inflating(
        others,
        [factor / before.factor * np.array([pose.rho for pose in others]) for factor in factors],
    )
    return replace(
        before, least=round(float(leasts[least]), 4), factor=round(float(factors[factor]), 1)
    )


def _least_inflating(poses: list[TriedPose], rhos: list[Float[np.ndarray, " n"]]) -> int:
    """The first of the choices of rho (growing) that has enough of the poses' errors inside the
    ellipsoid; the last where none has."""
    squares, num = (
        np.array([pose.square for pose in poses]),
        np.array([pose.evidence.num_found for pose in poses]),
    )
    enough = (
        k
        for k, rho in enumerate(rhos)
        if len(poses) < MIN_RIGHT_POSES
        or np.mean(squares / (1.0 + num * rho) < _CHI_SQUARE_6_AT_95) >= _INSIDE
    )
    return next(enough, len(rhos) - 1)
