"""Hold the values fitted to data: the weights of the evidence and the correlated errors of a map.

All probabilities and covariances depend on these values. Each feature type has its own file
`weights/KIND.json`. It also holds the corpus, the command, and the calibration error on places
outside the fit. They are not settings. A feature type without a file uses the weights of a similar
type, and its results are marked as not calibrated.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from topoloc.errors import FeatureTypeError
from topoloc.features.feature_types import FEATURE_TYPES, LEARNED_TYPES

WEIGHTS_FOLDER = Path(__file__).parent / "weights"
FALLBACK_TYPE, LEARNED_FALLBACK_TYPE = "surf", LEARNED_TYPES[0].name
"""Feature types whose weights are the fallback: for types without a network, and with one."""

_T = TypeVar("_T")


@dataclass(frozen=True)
class EvidenceWeights:
    """Hold the weights of the evidence for one pose (`evidence.py`), in log-odds.

    A pose with more than `clear_log_odds` is clear. Only very similar places of the map are then
    searched.
    """

    even_share: float
    chance: float
    inliers: float
    inlier_share: float
    spread: float
    doubt: float
    bias: float
    clear_log_odds: float

    @property
    def as_vector(self) -> tuple[float, ...]:
        """Return the weights in the order of `compute_score_features`, without the bias."""
        return (
            self.even_share,
            self.chance,
            self.inliers,
            self.inlier_share,
            self.spread,
            self.doubt,
        )


@dataclass(frozen=True)
class RivalWeights:
    """Hold the weights that compare two poses of one image (`belief.py`).

    They weigh the log-odds, the spatially uniform inlier ratio and the normalized uncertainty, in
    logarithms. `unclear_lead` is the minimum log-odds margin of a pose that is not clear over each
    pose elsewhere.
    """

    odds: float
    even_share: float
    doubt: float
    unclear_lead: float


@dataclass(frozen=True)
class VirtualViewWeights:
    """Hold the weights of the evidence for a pose from virtual views (`walls/`), in log-odds.

    `sigma_px` is the standard deviation (pixels) of a key point found at a slant. `few_points` over
    n is the covariance factor for n points, relative to independent errors. If few points are
    found, guided matching has biased most of them towards the pose.
    """

    found: float
    chance: float
    inliers: float
    inlier_share: float
    spread: float
    doubt: float
    distinct: float
    lesser_side: float
    even_share: float
    bias: float
    sigma_px: float
    few_points: float

    @property
    def as_vector(self) -> tuple[float, ...]:
        """Return the weights in the order of `compute_virtual_view_features`, without the bias."""
        shares = (self.found, self.chance, self.inliers, self.inlier_share, self.spread)
        return (*shares, self.distinct, self.lesser_side, self.even_share, self.doubt)


@dataclass(frozen=True)
class CorrelatedErrorWeights:
    """Hold the conversion from a comparison of neighbouring nodes to rho (`correlated_errors.py`).

    `factor` corrects for errors that neighbours share, which a comparison cannot show. `least` is
    the minimum of rho. `unknown` is rho if too few nodes can be compared.
    """

    factor: float
    least: float
    unknown: float


@dataclass(frozen=True)
class FittedWeights:
    """Hold the weights of one feature type and their source.

    `calibration_error` is the mean difference, over ten bins, of the reported probability and the
    share of right poses. It is measured on places outside the fit. None: the weights were not
    fitted to this feature type.
    """

    kind: str
    corpus: str
    date: str
    command: str
    calibration_error: float | None
    evidence: EvidenceWeights
    rivals: RivalWeights
    walls: VirtualViewWeights
    shared_errors: CorrelatedErrorWeights

    @property
    def is_calibrated(self) -> bool:
        """Return whether the weights were fitted to this feature type."""
        return self.calibration_error is not None

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object that `parse_fitted_weights` reads."""
        whole = asdict(self)
        return {name: whole.pop(name) for name in _SOURCE} | {"weights": whole}


_GROUPS = {
    "evidence": EvidenceWeights,
    "rivals": RivalWeights,
    "walls": VirtualViewWeights,
    "shared_errors": CorrelatedErrorWeights,
}
_SOURCE = ("kind", "corpus", "date", "command", "calibration_error")


@cache
def load_fitted_weights(kind: str) -> FittedWeights:
    """Return the shipped weights of a feature type.

    If there are none, return those of a similar type, marked as not calibrated.

    Raises:
        FeatureTypeError: the file is damaged, or of another feature type.
    """
    path = WEIGHTS_FOLDER / f"{kind}.json"
    if not path.exists():
        like = (
            LEARNED_FALLBACK_TYPE
            if kind in FEATURE_TYPES and FEATURE_TYPES[kind].network is not None
            else FALLBACK_TYPE
        )
        return replace(load_fitted_weights(like), kind=kind, calibration_error=None)
    weights = read_weights(path)
    if weights.kind != kind:
        raise FeatureTypeError(f"{path}: weights of {weights.kind}, not of {kind}")
    return weights


def read_weights(path: Path) -> FittedWeights:
    """Read the weights from a file.

    Raises:
        FeatureTypeError: the file cannot be read, or has not the format of `FittedWeights.to_json`.
    """
    try:
        return parse_fitted_weights(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError) as error:
        raise FeatureTypeError(f"cannot read the weights in {path}: {error}") from error


def parse_fitted_weights(read: Any) -> FittedWeights:
    """Parse the object that `FittedWeights.to_json` returns.

    Raises:
        ValueError: a key is missing, unknown or of the wrong type.
    """
    _check_keys(read, {*_SOURCE, "weights"}, "the file")
    _check_keys(read["weights"], set(_GROUPS), "weights")
    for name in _SOURCE[:-1]:
        if not isinstance(read[name], str):
            raise ValueError(f"{name} is not a text")
    values: dict[str, Any] = {name: read[name] for name in _SOURCE}
    values["calibration_error"] = _number(read["calibration_error"], "calibration_error")
    values |= {
        name: _parse_weight_group(group, read["weights"][name], name)
        for name, group in _GROUPS.items()
    }
    return FittedWeights(**values)


def _parse_weight_group(group: type[_T], read: Any, name: str) -> _T:
    names = [field.name for field in fields(group)]  # pyright: ignore[reportArgumentType]
    _check_keys(read, set(names), name)
    return group(*(_number(read[key], f"{name}.{key}") for key in names))


def _check_keys(read: Any, expected: set[str], where: str) -> None:
    if not isinstance(read, dict):
        raise ValueError(f"{where} is no table of names and values")
    if missing := sorted(expected - set(read)):
        raise ValueError(f"{where} lacks {missing[0]}")
    if unknown := sorted(set(read) - expected):
        raise ValueError(f"{where} has an unknown {unknown[0]}")


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name} is not a finite number")
    return float(value)
