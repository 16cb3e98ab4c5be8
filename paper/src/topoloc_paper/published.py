"""The paper's own numbers, as they are printed in its tables I to III, and the figures that ours
are held against."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MedianErrors:
    """Median translation (metres) and rotation (degrees)."""

    metres: float
    degrees: float


# Table I: rows of data sets, a number for each method.
TABLE_ONE: dict[str, dict[str, MedianErrors]] = {
    "street": {
        "posenet": MedianErrors(3.114, 0.810),
        "cnn-fc": MedianErrors(1.842, 0.604),
        "cnn-nn": MedianErrors(1.822, 0.601),
        "vlad-nn": MedianErrors(1.845, 0.644),
    },
    "corridor": {
        "posenet": MedianErrors(0.529, 3.377),
        "cnn-fc": MedianErrors(0.0458, 0.945),
        "cnn-nn": MedianErrors(0.0451, 0.943),
        "vlad-nn": MedianErrors(0.0446, 0.937),
    },
    "lab": {
        "posenet": MedianErrors(0.131, 1.015),
        "cnn-fc": MedianErrors(0.0207, 0.328),
        "cnn-nn": MedianErrors(0.0202, 0.350),
        "vlad-nn": MedianErrors(0.0202, 0.363),
    },
}

# Table II, of the street. Its first row is Table I's in another order; it stands here as it is
# printed.
TABLE_TWO: dict[str, dict[str, MedianErrors]] = {
    "clear": {
        "cnn-fc": MedianErrors(1.845, 0.601),
        "cnn-nn": MedianErrors(1.842, 0.644),
        "vlad-nn": MedianErrors(1.822, 0.604),
    },
    "cloudy": {
        "cnn-fc": MedianErrors(2.526, 0.806),
        "cnn-nn": MedianErrors(2.702, 0.745),
        "vlad-nn": MedianErrors(2.371, 0.811),
    },
    "rain": {
        "cnn-fc": MedianErrors(2.982, 0.795),
        "cnn-nn": MedianErrors(2.817, 0.857),
        "vlad-nn": MedianErrors(2.812, 0.787),
    },
}

# Table III: seconds a stage, on an i7-4770K with a GTX 1660. "nn" is missing for CNN-FC, which has
# none.
TABLE_THREE: dict[str, dict[str, float]] = {
    "cnn-fc": {"cnn": 0.0086, "patch_normalization": 0.0020, "surf_pnp": 0.0238, "total": 0.0553},
    "cnn-nn": {
        "cnn": 0.0095,
        "nn": 0.198,
        "patch_normalization": 0.0020,
        "surf_pnp": 0.0228,
        "total": 0.256,
    },
    "vlad-nn": {
        "cnn": 0.0112,
        "nn": 0.267,
        "patch_normalization": 0.0020,
        "surf_pnp": 0.0238,
        "total": 0.324,
    },
}


@dataclass(frozen=True)
class Target:
    """Hold the largest permitted median errors (metres, degrees; None means no limit)."""

    dataset: str
    queries: str
    metres: float
    degrees: float | None


TARGETS = (
    Target("lab", "day", 0.010, 0.17),
    Target("corridor", "evening", 0.022, 0.45),
    Target("street", "clear", 0.40, 0.30),
    Target("street", "cloudy", 0.6, None),
    Target("street", "rain", 1.2, None),
)
MAX_MS_A_QUERY = 30.0
# The paper, section III-C: "improved the localization accuracy by ~20 % on non-simulated data".
NORMALIZATION_GAIN = 0.20
