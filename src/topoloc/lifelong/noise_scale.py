"""How far a session's motion and the map's answers are to be trusted, as they tell of each other.

Sigmas that are assumed are wrong by different factors in each recording: SLAM of a rendered lap
drifts by a thousandth of its way, that of a hand-held camera whose calibration is nominal by some
hundredths, and what a map says of its answers' errors holds for its worst parts. How much the
answers scatter from one to the next, and how much further they are off after a longer way, tells
both apart (variance components; Harville, JASA 72, 1977). The motion is predicted from answer to
answer and corrected by each (Kalman filter); the factors under which the answers are the least
surprise win. A few answers may be wrong: each counts as one of Student's t distribution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3

_DEGREES_OF_FREEDOM = 4.0  # of Student's t: the fewer, the less does one wrong answer tell
_NUM_DIMENSIONS = 6


@dataclass(frozen=True)
class NoiseScale:
    """By how many times the sigmas of the motion, and of the answers, are as large as they were
    assumed to be."""

    motion: float = 1.0
    answers: float = 1.0


@dataclass(frozen=True, eq=False)
class LocalizedStep:
    """A picture that the map answered, and the motion to it from the one that was answered before.

    `cam_from_before` and `motion_covariance` (6, 6) say nothing in the first one. Covariances are
    those of left perturbations (translation, rotation; metres and radians) of `cam_from_before` and
    of the answer, `cam_from_world`.
    """

    cam_from_before: Rigid3
    motion_covariance: Float[np.ndarray, "6 6"]
    cam_from_world: Rigid3
    covariance: Float[np.ndarray, "6 6"]


def estimate_noise_scale(
    steps: Sequence[LocalizedStep], motion_scales: Sequence[float], answer_scales: Sequence[float]
) -> NoiseScale:
    """The pair of these factors under which the answers are the least surprise; 1 and 1 where fewer
    than two pictures were answered."""
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
    """-2 times the logarithm of how likely the answers are after the first one, but for a
    constant."""
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
        # an answer that strays corrects less
        inflation = max(
            (_DEGREES_OF_FREEDOM + square) / (_DEGREES_OF_FREEDOM + _NUM_DIMENSIONS), 1.0
        )
        gain = np.linalg.solve(covariance + inflation * of_answer, covariance).T
        pose = Rigid3.exp(gain @ off) @ pose
        covariance = covariance - gain @ covariance
        covariance = (covariance + covariance.T) / 2.0
    return cost
