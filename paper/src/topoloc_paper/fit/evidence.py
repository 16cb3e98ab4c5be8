"""Fit the weights of the evidence for one pose, and the error share common to a map's points.

The model is a logistic regression with weights that are not negative. Feature types resemble each
other and corpora are small, so the weights are regularized towards those of SURF. The strength of
this prior is the one with the best likelihood on held-out families of places. The weight of the
normalized uncertainty is fixed: wrong places in a corridor with many doors have precise poses, and
a free weight would become zero.
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
    """Hold the log odds that weights give to some poses, and whether each pose is right."""

    family: str
    log_odds: Float[np.ndarray, " n"]
    is_right: Bool[np.ndarray, " n"]


def decided(poses: list[TriedPose]) -> list[TriedPose]:
    """Return the poses that are right or wrong, without those in between."""
    return [pose for pose in poses if pose.is_right or pose.is_wrong]


def fit_evidence(
    poses: list[TriedPose], prior: EvidenceWeights, strength: float
) -> EvidenceWeights:
    """Fit the weights that separate right from wrong poses.

    The bias is lowered if an out-of-map image would get a higher probability than allowed. A pose
    is clear if its log odds exceed those of the most probable wrong pose by a margin, and are at
    least the prior's limit, because a small corpus seldom holds the most probable wrong pose.

    Args:
        prior: the mean of the regularization, whose weight is `strength`. Its weight of the
            normalized uncertainty is kept.
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
    """Compute the log odds of each family's poses with weights fitted to all other families.

    Args:
        by_recording: hold out single recordings instead of families. Use it if only one family has
            similar places, because the other families do not show the value of a pose in them.
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
    """Return the log odds of these poses under these weights."""
    odds, is_right = (
        [compute_log_odds(pose.evidence, weights) for pose in poses],
        [pose.is_right for pose in poses],
    )
    return Judged(family, np.array(odds, dtype=float), np.array(is_right, dtype=bool))


def calibration_error(log_odds: Float[np.ndarray, " n"], is_right: Bool[np.ndarray, " n"]) -> float:
    """Return the mean difference of predicted and observed probability over ten bins, of accepted
    poses."""
    probability, is_right = 1.0 / (1.0 + np.exp(-log_odds[log_odds > 0])), is_right[log_odds > 0]
    bins = np.minimum((probability * 10).astype(int), 9)
    return float(
        sum(abs(np.sum(probability[bins == k] - is_right[bins == k])) for k in range(10))
        / max(len(bins), 1)
    )


def fit_shared_errors(
    poses: list[TriedPose], before: CorrelatedErrorWeights
) -> CorrelatedErrorWeights:
    """Fit the least rho and the factor for which the 95 % ellipsoid holds 95 % of the right poses'
    errors.

    Neither becomes smaller than before. The least rho is fitted to maps whose own rho is below it,
    the factor to the others. Each needs `MIN_RIGHT_POSES`, because it depends on the few largest
    errors.

    Args:
        before: the weights with which the poses' rho was computed.
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
    """Return the index of the first rho with enough of the poses' errors inside the ellipsoid, else
    the last."""
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
