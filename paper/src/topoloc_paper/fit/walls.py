"""Fit the weights of the evidence for a pose that a virtual view proposes.

As for nodes, the model is a logistic regression with weights that are not negative. It is
regularized towards the weights in use, because there are few such poses. The precision of a pose is
tested separately (`Evidence.precision_probability`), so a wrong pose is one in another place. The
weight of the normalized uncertainty is fixed.
"""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace
from scipy.optimize import minimize

from topoloc.localization.fitted_weights import VirtualViewWeights
from topoloc_paper.fit.evidence import decided
from topoloc_paper.fit.tried_poses import TriedPose

MIN_POSES = 20
"""Right ones, and wrong ones; to fewer nothing is fitted."""
_OTHER_PLACE_M, _OTHER_PLACE_DEG = 1.0, 20.0
_STRENGTH = 3.0
"""Of the weights in use, in squared distances from them."""


def told_by_walls(poses: list[TriedPose]) -> list[TriedPose]:
    """The poses of walls that are right or of another place: one that is a metre off at its own
    place is only imprecise."""
    return [
        pose
        for pose in decided(poses)
        if pose.evidence.num_distinct is not None and (pose.is_right or _is_elsewhere(pose))
    ]


def _is_elsewhere(pose: TriedPose) -> bool:
    return (
        pose.error_m is None
        or pose.error_deg is None
        or pose.error_m > _OTHER_PLACE_M
        or pose.error_deg > _OTHER_PLACE_DEG
    )


def fit_walls(poses: list[TriedPose], before: VirtualViewWeights) -> tuple[VirtualViewWeights, int]:
    """Return the weights and the number of fitted poses; `before` and 0 if there are too few."""
    told = told_by_walls(poses)
    is_right = np.array([pose.is_right for pose in told], dtype=bool)
    if min(np.count_nonzero(is_right), np.count_nonzero(~is_right)) < MIN_POSES:
        return before, 0
    x = np.array([before.features(pose.evidence) for pose in told])
    signs, given = 2.0 * is_right - 1.0, before.doubt * x[:, -1]
    x, start = (
        np.column_stack([x[:, :-1], np.ones(len(x))]),
        np.array([*before.as_vector[:-1], before.bias]),
    )

    def loss(weights: np.ndarray) -> float:
        return float(
            np.sum(np.logaddexp(0.0, -signs * (x @ weights + given)))
            + _STRENGTH * np.sum((weights - start) ** 2)
        )

    bounds = [(0.0, None)] * (len(start) - 1) + [(None, None)]
    found, chance, inliers, share, spread, distinct, lesser_side, even, bias = (
        float(weight)
        for weight in np.round(minimize(loss, start, bounds=bounds, method="L-BFGS-B").x, 3)
    )
    by_sides = {"distinct": distinct, "lesser_side": lesser_side}
    shares = {"inlier_share": share, "even_share": even}
    return replace(
        before,
        found=found,
        chance=chance,
        inliers=inliers,
        spread=spread,
        bias=bias,
        **by_sides,
        **shares,
    ), len(told)
