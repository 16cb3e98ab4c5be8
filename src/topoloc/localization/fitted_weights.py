"""Hold the values fitted to data: the weights of the evidence and the correlated errors of a map.

All probabilities and covariances depend on these values. Each feature type has its own file
`weights/KIND.json`. It also holds the corpus, the command, and the calibration error on places
outside the fit. They are not settings. A feature type without a file uses the weights of a similar
type, and its results are marked as not calibrated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from msgspec import Struct, to_builtins
from msgspec.structs import astuple

from topoloc.errors import FeatureTypeError
from topoloc.features.feature_types import FEATURE_TYPES, LEARNED_TYPES
from topoloc.json_data import Finite, decode_json

WEIGHTS_FOLDER = Path(__file__).parent / "weights"
FALLBACK_TYPE, LEARNED_FALLBACK_TYPE = "surf", LEARNED_TYPES[0].name
"""Feature types whose weights are the fallback: for types without a network, and with one."""


class EvidenceWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the weights of the evidence for one pose (`evidence.py`), in log-odds.

    A pose with more than `clear_log_odds` is clear. Only very similar places of the map are then
    searched.
    """

    even_share: Finite
    chance: Finite
    inliers: Finite
    inlier_share: Finite
    spread: Finite
    doubt: Finite
    bias: Finite
    clear_log_odds: Finite

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


class RivalWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the weights that compare two poses of one image (`belief.py`).

    They weigh the log-odds, the spatially uniform inlier ratio and the normalized uncertainty, in
    logarithms. `unclear_lead` is the minimum log-odds margin of a pose that is not clear over each
    pose elsewhere.
    """

    odds: Finite
    even_share: Finite
    doubt: Finite
    unclear_lead: Finite


class VirtualViewWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the weights of the evidence for a pose from virtual views (`walls/`), in log-odds.

    `sigma_px` is the standard deviation (pixels) of a key point found at a slant. `few_points` over
    n is the covariance factor for n points, relative to independent errors. If few points are
    found, guided matching has biased most of them towards the pose.
    """

    found: Finite
    chance: Finite
    inliers: Finite
    inlier_share: Finite
    spread: Finite
    doubt: Finite
    distinct: Finite
    lesser_side: Finite
    even_share: Finite
    bias: Finite
    sigma_px: Finite
    few_points: Finite

    @property
    def as_vector(self) -> tuple[float, ...]:
        """Return the weights in the order of `compute_virtual_view_features`, without the bias."""
        shares = (self.found, self.chance, self.inliers, self.inlier_share, self.spread)
        return (*shares, self.distinct, self.lesser_side, self.even_share, self.doubt)


class CorrelatedErrorWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the conversion from a comparison of neighbouring nodes to rho (`correlated_errors.py`).

    `factor` corrects for errors that neighbours share, which a comparison cannot show. `least` is
    the minimum of rho. `unknown` is rho if too few nodes can be compared.
    """

    factor: Finite
    least: Finite
    unknown: Finite


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
        """Return the JSON object of a file of weights."""
        groups = ("evidence", "rivals", "walls", "shared_errors")
        weights = {name: to_builtins(getattr(self, name)) for name in groups}
        return {
            "kind": self.kind,
            "corpus": self.corpus,
            "date": self.date,
            "command": self.command,
            "calibration_error": self.calibration_error,
            "weights": weights,
        }


class _Groups(Struct, frozen=True, forbid_unknown_fields=True):
    evidence: EvidenceWeights
    rivals: RivalWeights
    walls: VirtualViewWeights
    shared_errors: CorrelatedErrorWeights


class _WeightsFile(Struct, frozen=True, forbid_unknown_fields=True):
    kind: str
    corpus: str
    date: str
    command: str
    calibration_error: Finite
    weights: _Groups


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
    fault = f"cannot read the weights in {path}"
    try:
        text = path.read_bytes()
    except OSError as error:
        raise FeatureTypeError(f"{fault}: {error.strerror}") from None
    file = decode_json(text, _WeightsFile, FeatureTypeError, fault)
    source = (file.kind, file.corpus, file.date, file.command, file.calibration_error)
    return FittedWeights(*source, *astuple(file.weights))
