"""Estimate the variance of residuals of which some are outliers."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from topoloc.compiled import kernel

CAUCHY_SCALE = 2.3849  # 95 % efficiency on Gaussian residuals (Holland and Welsch, 1977)
_MAX_STEPS = 30
_MEAN_WEIGHTED_SQUARE = 0.6302  # E[w r^2] / 2 of Gaussian residuals r and Cauchy's weights w


def estimate_noise_scale(
    squares: Float[np.ndarray, " n"], num_unknowns: int, least: float = 1.0
) -> float:
    """Return the factor by which the noise exceeds its assumed standard deviation, from squared
    whitened residuals of a fit of some unknowns (Huber's proposal 2, 1964).

    It is at least `least`. If few matches fit well, this is due to chance or to the fit itself.
    """
    num_free = max(2 * len(squares) - num_unknowns, 1)
    return math.sqrt(_fit_variance(squares, num_free, least**2))


@kernel(error_model="numpy")
def _fit_variance(squares, num_free, least):
    """Return the variance of `estimate_noise_scale`."""
    variance = 1.0
    for _ in range(_MAX_STEPS):
        total = 0.0
        for square in squares:
            total += square / (variance + square / CAUCHY_SCALE**2)
        better = max(least, variance * total / (_MEAN_WEIGHTED_SQUARE * num_free))
        if abs(better / variance - 1.0) <= 0.001:
            break
        variance = better
    return variance
