"""Is this pose right? The evidence for it, weighed as a probability.

A count of inliers alone is no test: RANSAC finds a dozen of them in any picture, and poses of repeated patterns collect
many more. What a wrong pose cannot have is agreement beyond what it was fitted to: most map points that must be in view
are then not found where they must be. So the share of those that are found counts, beside the number and the share of
the first matches that agreed before anything was known of the pose.

The weights are those of a logistic regression on 1,557 poses, half of them wrong: rooms and streets asked about
themselves, in good light and bad, about each other, about noise, lettering and repeated patterns
(``benchmarks/acceptance.py``, which also leaves out each place in turn).
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Evidence:
    """What speaks for a pose.

    `num_matches` and `num_inliers` are those of the first, unguided match; `num_found` of the `num_visible` map points that
    must be in view were found where they must be seen.
    """

    num_matches: int
    num_inliers: int
    num_found: int
    num_visible: int


@dataclass(frozen=True)
class VerificationConfig:
    """Weights of the logistic regression, and what is asked of an answer."""

    min_inliers: int = 5
    """With fewer, a first pose is not even tried out."""
    min_found: int = 12
    """Map points found where the pose says they must be, at least."""
    min_probability: float = 0.5
    """Poses less probable than this are not reported."""
    found_weight: float = 2.66
    inliers_weight: float = 1.57
    inlier_share_weight: float = 1.85
    bias: float = 7.09


def probability_of(evidence: Evidence, config: VerificationConfig) -> float:
    """The probability, in [0, 1], that the pose is right. The added constants keep small counts from weighing too much."""
    e = evidence
    score = (
        config.found_weight * math.log((e.num_found + 1) / (e.num_visible + 20))
        + config.inliers_weight * math.log(e.num_inliers + 1)
        + config.inlier_share_weight * math.log((e.num_inliers + 1) / (e.num_matches + 10))
        + config.bias
    )
    return 1.0 / (1.0 + math.exp(-score))
