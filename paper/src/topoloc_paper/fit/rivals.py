"""Fit the weights that choose between two poses of one image that are far from each other.

For each image, the strongest pose that is not wrong is paired with every wrong pose of comparable
strength. A pair is hard if the wrong pose alone is nearly accepted. The weights are fitted to hard
pairs, by logistic regression without a bias.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from msgspec import structs
from scipy.optimize import minimize

from topoloc.localization.fitted_weights import EvidenceWeights, RivalWeights, compute_log_odds
from topoloc_paper.fit.tried_poses import TriedPose

MIN_HARD_PAIRS = 80
"""To fewer nothing is fitted."""
_COULD_BE_TAKEN = -1.5
"""Logarithm of the odds of a wrong pose that makes a pair; one that is less than `_NEAR` behind the
right one makes a pair, too."""
_NEAR = 2.0
_HARD = -0.5
_SHRINKAGE = 5e-4


def fit_rivals(
    poses: list[TriedPose], weights: EvidenceWeights, before: RivalWeights
) -> tuple[RivalWeights, int]:
    """Return the weights and the number of hard pairs; the weights `before` if there are too few
    pairs."""
    differences, is_hard = pairs_of(poses, weights)
    num_hard = int(np.count_nonzero(is_hard))
    if num_hard < MIN_HARD_PAIRS:
        return before, num_hard
    hard = differences[is_hard]

    def loss(w: np.ndarray) -> float:
        return float(np.sum(np.logaddexp(0.0, -hard @ w)) + _SHRINKAGE * len(hard) * np.sum(w**2))

    # neither odds nor even share may count against a pose, nor doubt for it
    fitted = minimize(
        loss,
        np.array([0.1, 0.1, -0.1]),
        bounds=[(0.0, None), (0.0, None), (None, 0.0)],
        method="L-BFGS-B",
    ).x
    odds, even_share, doubt = (float(w) for w in np.round(fitted, 2))
    return structs.replace(before, odds=odds, even_share=even_share, doubt=doubt), num_hard


def pairs_of(
    poses: list[TriedPose], weights: EvidenceWeights
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """By how much the right pose of each pair leads in the log odds, the even share and the doubt
    (logarithms); is it hard?"""
    of_picture: dict[tuple[str, str, int, str], list[TriedPose]] = {}
    for pose in poses:
        if pose.error_m is not None:
            of_picture.setdefault(pose.picture, []).append(pose)
    differences, is_hard = [], []
    for tried in of_picture.values():
        right = [_terms(pose, weights) for pose in tried if not pose.is_wrong]
        if not right:
            continue
        best = max(right, key=lambda those: those[0] + 3.0 * those[1])
        for wrong in (_terms(pose, weights) for pose in tried if pose.is_wrong):
            if wrong[0] > min(_COULD_BE_TAKEN, best[0] - _NEAR):
                differences.append(best - wrong)
                is_hard.append(wrong[0] > _HARD)
    return np.array(differences).reshape(-1, 3), np.array(is_hard, dtype=bool)


def num_mistaken(differences: Float[np.ndarray, "n 3"], weights: RivalWeights) -> int:
    """How many pairs the weights get wrong."""
    return int(
        np.count_nonzero(
            differences @ np.array([weights.odds, weights.even_share, weights.doubt]) < 0
        )
    )


def _terms(pose: TriedPose, weights: EvidenceWeights) -> np.ndarray:
    """Return the compared terms of a pose in the order of the weights."""
    features = EvidenceWeights.features(pose.evidence)
    return np.array([compute_log_odds(pose.evidence, weights), features[0], features[-1]])
