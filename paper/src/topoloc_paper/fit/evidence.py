"""The weights of the evidence for one pose, and what the errors of a map's points share.

A logistic regression, lightly shrunk, in which nothing that speaks for a pose may count against it. The weight of the doubt is given, not
fitted: wrong places in a corridor of many doors come with precise poses, and a free weight would follow them to zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from topoloc.localization.evidence import node_log_odds, score_features
from topoloc.localization.fitted_weights import EvidenceWeights, SharedErrorWeights
from topoloc_paper.fit.corpus import family_of
from topoloc_paper.fit.tried_poses import TriedPose

_MOST_ELSEWHERE = 0.35
"""No pose of a picture from elsewhere that was fitted to may be more probable."""
_CLEAR_MARGIN, _LEAST_CLEAR = 0.6, 3.0
_SHRINKAGE = 5e-4
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


def fit_evidence(poses: list[TriedPose], doubt: float) -> EvidenceWeights:
    """The weights that tell these poses' right ones from their wrong ones, with this weight of the doubt.

    The bias is lowered where a picture from elsewhere would be believed more than it may; a pose is clear that has more for it
    than the clearest wrong one, by a margin.
    """
    poses = decided(poses)
    x, is_right = np.array([score_features(pose.evidence) for pose in poses]), np.array([pose.is_right for pose in poses])
    fitted = _logistic_regression(x[:, :-1], is_right, doubt * x[:, -1])
    weights = EvidenceWeights(*fitted[:-1], doubt=doubt, bias=fitted[-1], clear_log_odds=_LEAST_CLEAR)
    elsewhere = [node_log_odds(pose.evidence, weights) for pose in poses if pose.error_m is None]
    most = math.log(_MOST_ELSEWHERE / (1.0 - _MOST_ELSEWHERE))
    weights = replace(weights, bias=weights.bias - max(max(elsewhere, default=most) - most, 0.0))
    clearest = max((node_log_odds(pose.evidence, weights) for pose in poses if pose.is_wrong), default=0.0)
    return replace(weights, clear_log_odds=max(clearest + _CLEAR_MARGIN, _LEAST_CLEAR))


def _logistic_regression(
    x: Float[np.ndarray, "n k"], is_right: Bool[np.ndarray, " n"], given: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " k1"]:
    """Weights of the columns, none negative, and the bias. `given` is added to the logarithm of the odds."""
    signs = 2.0 * is_right - 1.0

    def loss(weights: np.ndarray) -> float:
        odds = x @ weights[:-1] + weights[-1] + given
        return float(np.sum(np.logaddexp(0.0, -signs * odds)) + _SHRINKAGE * len(x) * np.sum(weights[:-1] ** 2))

    num = x.shape[1]
    start, bounds = np.full(num + 1, 0.1), [(0.0, None)] * num + [(None, None)]
    return np.round(minimize(loss, start, bounds=bounds, method="L-BFGS-B").x, 3)


def try_on_other_families(poses: list[TriedPose], doubt: float) -> list[Judged]:
    """Each family's poses, judged by weights fitted to those that have nothing of it."""
    poses, tried = decided(poses), []
    for family in dict.fromkeys(family_of(pose.mapping) for pose in poses):
        here = [pose for pose in poses if family_of(pose.mapping) == family]
        rest = [pose for pose in poses if family not in (family_of(pose.mapping), family_of(pose.queries))]
        if len({pose.is_right for pose in rest}) == 2:
            weights = fit_evidence(rest, doubt)
            tried.append(judged(family, here, weights))
    return tried


def judged(family: str, poses: list[TriedPose], weights: EvidenceWeights) -> Judged:
    """What these weights say of these poses."""
    odds, is_right = [node_log_odds(pose.evidence, weights) for pose in poses], [pose.is_right for pose in poses]
    return Judged(family, np.array(odds, dtype=float), np.array(is_right, dtype=bool))


def calibration_error(log_odds: Float[np.ndarray, " n"], is_right: Bool[np.ndarray, " n"]) -> float:
    """Over ten bins of the probability the mean difference of what was said and what was so; of the poses that would be answered."""
    probability, is_right = 1.0 / (1.0 + np.exp(-log_odds[log_odds > 0])), is_right[log_odds > 0]
    bins = np.minimum((probability * 10).astype(int), 9)
    return float(sum(abs(np.sum(probability[bins == k] - is_right[bins == k])) for k in range(10)) / max(len(bins), 1))


def fit_shared_errors(poses: list[TriedPose], before: SharedErrorWeights) -> SharedErrorWeights:
    """The factor with which 95 % of the right poses' errors lie inside the 95 % ellipsoid.

    Args:
        before: the weights with which the poses' rho came about; they stay where the corpus holds no right pose.
    """
    right = [pose for pose in poses if pose.is_right and pose.square is not None]
    if not right:
        return before
    squares, num = np.array([pose.square for pose in right]), np.array([pose.evidence.num_found for pose in right])
    per_factor = np.array([pose.rho for pose in right]) / before.factor

    def share_inside(factor: float) -> float:
        return float(np.mean(squares / (1.0 + num * np.maximum(factor * per_factor, before.least)) < _CHI_SQUARE_6_AT_95))

    factors = np.round(np.arange(0.5, 8.01, 0.1), 1)
    return replace(before, factor=float(next((f for f in factors if share_inside(f) >= _INSIDE), factors[-1])))
