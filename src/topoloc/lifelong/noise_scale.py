"""Estimate the noise scales of a session's motion and of the map's localizations from each other.

Assumed sigmas are wrong by a different factor in each recording. SLAM of a rendered loop drifts by
about a thousandth of the distance. A hand-held camera with a nominal calibration drifts by some
hundredths. The localizations' sigmas describe the worst parts of a map. The scatter between
consecutive localizations and its growth with distance separate the two (variance components,
Harville, JASA 72, 1977). A Kalman filter predicts the motion from localization to localization and
corrects it by each. The factors with the highest likelihood are selected. Student's t distribution
limits the effect of wrong localizations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3

_DEGREES_OF_FREEDOM = 4.0  # of Student's t distribution: fewer give an outlier less weight
_NUM_DIMENSIONS = 6


@dataclass(frozen=True)
class NoiseScale:
    """Hold the factors by which the sigmas of the motion and of the localizations differ from the
    assumed ones."""

    motion: float = 1.0
    answers: float = 1.0


@dataclass(frozen=True, eq=False)
class LocalizedStep:
    """Hold a localized image and the motion to it from the previous localized image.

    The first step's `cam_from_before` and `motion_covariance` (6, 6) have no meaning. Covariances
    belong to left perturbations (translation, rotation, in metres and radians) of `cam_from_before`
    and of the localization `cam_from_world`.
    """

    cam_from_before: Rigid3
    motion_covariance: Float[np.ndarray, "6 6"]
    cam_from_world: Rigid3
    covariance: Float[np.ndarray, "6 6"]


def estimate_noise_scale(
    steps: Sequence[LocalizedStep], motion_scales: Sequence[float], answer_scales: Sequence[float]
) -> NoiseScale:
    """Return the pair of factors with the highest likelihood, or 1 and 1 if there are fewer than
    two steps."""
    if len(steps) < 2:
        return NoiseScale()
    adjoints = [step.cam_from_before.adjoint() for step in steps]
    return min(
        (NoiseScale(*pair) for pair in product(motion_scales, answer_scales)),
        key=lambda scale: _negative_log_likelihood(steps, adjoints, scale),
    )


def _negative_log_likelihood(
    steps: Sequence[LocalizedStep], adjoints: Sequence[Float[np.ndarray, "6 6"]], scale: NoiseScale
) -> float:
    """Compute -2 times the log-likelihood of the localizations after the first, without
    constants."""
    pose, covariance = steps[0].cam_from_world, scale.answers**2 * steps[0].covariance
    cost = 0.0
    for step, adjoint in zip(steps[1:], adjoints[1:], strict=True):
        pose = step.cam_from_before @ pose
        covariance = adjoint @ covariance @ adjoint.T + scale.motion**2 * step.motion_covariance
        of_answer = scale.answers**2 * step.covariance
        off = (step.cam_from_world @ pose.inverse()).log()
        both = covariance + of_answer
        square = float(off @ np.linalg.solve(both, off))
        cost += float(np.linalg.slogdet(both)[1]) + (
            _DEGREES_OF_FREEDOM + _NUM_DIMENSIONS
        ) * np.log1p(square / _DEGREES_OF_FREEDOM)
        # an outlier corrects the pose less
        inflation = max(
            (_DEGREES_OF_FREEDOM + square) / (_DEGREES_OF_FREEDOM + _NUM_DIMENSIONS), 1.0
        )
        gain = np.linalg.solve(covariance + inflation * of_answer, covariance).T
        pose = Rigid3.exp(gain @ off) @ pose
        covariance = covariance - gain @ covariance
        covariance = (covariance + covariance.T) / 2.0
    return cost
