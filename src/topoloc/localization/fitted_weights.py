"""What was fitted to data: how much each piece of evidence counts, and what the errors of a map's
points have in common.

These numbers carry every probability and covariance, and belong to one kind of features each:
`weights/KIND.json` holds them with the corpus and the command that they come from, and the
calibration error on places that they were not fitted to. They are no settings. A kind without a
file answers with those of a kind like it, and says that its probability is not calibrated.
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
"""The kinds whose weights others take that have none: where no network is asked, and where one
is."""

_T = TypeVar("_T")


@dataclass(frozen=True)
class EvidenceWeights:
    """Of the evidence for one pose (`evidence.py`), in logarithms of odds.

    A pose with more than `clear_log_odds` for it is clear: only parts of the map that look nearly
    the same are asked then.
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
    def parallel_map(self) -> tuple[float, ...]:
        """In the order of `compute_score_features`; without the bias."""
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
    """How much the odds, the even share found and the doubt count between two poses of one picture
    (`belief.py`), in logarithms.

    unclear_lead: by how much, in logarithms of odds, a pose that is not clear must lead each one
    elsewhere.
    """

    odds: float
    even_share: float
    doubt: float
    unclear_lead: float


@dataclass(frozen=True)
class VirtualViewWeights:
    """Of the evidence for a pose that the walls let expect (`walls/`), in logarithms of odds.

    sigma_px: standard deviation of a key point found at such a slant. few_points: from n points the
    covariance is this over n times as large as independent errors would have it: where few are
    found, guided matching has drawn most of them to the pose itself.
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
    def parallel_map(self) -> tuple[float, ...]:
        """In the order of `compute_virtual_view_features`; without the bias."""
        shares = (self.found, self.chance, self.inliers, self.inlier_share, self.spread)
        return (*shares, self.distinct, self.lesser_side, self.even_share, self.doubt)


@dataclass(frozen=True)
class CorrelatedErrorWeights:
    """What rho (`correlated_errors.py`) is taken to be, from what comparing neighbouring nodes
    gives.

    factor: what neighbours share cannot be seen by comparing them. unknown: where too few nodes can
    be compared.
    """

    factor: float
    least: float
    unknown: float


@dataclass(frozen=True)
class FittedWeights:
    """The weights of one kind of features, and where they come from.

    calibration_error: mean difference, over ten bins, of the probability said and the share that
    was right, on places that the weights were not fitted to; None where they were never fitted to
    this kind.
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
        return self.calibration_error is not None

    def to_json(self) -> dict[str, Any]:
        """What `parse_fitted_weights` reads."""
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
    """The weights that ship for this kind of features; those of a kind like it, not calibrated,
    where there are none.

    Raises:
        FeatureKindError: the file is damaged, or of another kind.
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
    """The weights in a file.

    Raises:
        FeatureKindError: it cannot be read, or is not what `FittedWeights.to_json` gives.
    """
    try:
        return parse_fitted_weights(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError) as error:
        raise FeatureTypeError(f"cannot read the weights in {path}: {error}") from error


def parse_fitted_weights(read: Any) -> FittedWeights:
    """The opposite of `FittedWeights.to_json`; ValueError where a key is missing, unknown or of the
    wrong type."""
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
