"""Hold the values fitted to data: the weights of the evidence and the correlated errors of a map.

The weights come from a logistic regression on right and wrong poses, whose inputs are logarithms of
the evidence (`evidence.py`), with constants for small counts. The weight of the normalized
uncertainty is set by hand: a free weight would go to zero in corridors of many doors.

All probabilities and covariances depend on these values. Each feature type has its own file
`weights/KIND.json`, with the corpus, the command, and the calibration error on places outside the
fit. A type without a file uses the weights of a similar one; its results are not calibrated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

from msgspec import Struct, structs, to_builtins
from msgspec.structs import astuple

from topoloc.errors import FeatureTypeError
from topoloc.features.feature_types import FEATURE_TYPES, LEARNED_TYPES
from topoloc.json_data import Finite, decode_json
from topoloc.localization.provenance import Evidence

WEIGHTS_FOLDER = Path(__file__).parent / "weights"
FALLBACK_TYPE, LEARNED_FALLBACK_TYPE = "surf", LEARNED_TYPES[0].name
"""Feature types whose weights are the fallback: for types without a network, and with one."""


def _log_even_share(evidence: Evidence) -> float:
    """Return the logarithm of the spatially uniform inlier ratio, which is finite for 0, too."""
    return math.log(evidence.even_share + 0.002)


def _log_doubt(evidence: Evidence) -> float:
    """Return the logarithm of the normalized uncertainty, which is finite for 0, too."""
    return math.log(max(evidence.doubt, 0.01))


class EvidenceWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the weights of the evidence for a pose found by the map's nodes, in log-odds.

    A pose with more than `clear_log_odds` is clear. Only very similar places of the map are then
    searched. A pose with less than `hopeless_log_odds` cannot become probable by more matches.

    A pose whose points lie in less than `narrow_spread` of the image, such as a door, has at most
    `max_narrow_log_odds` at a doubt of 0.1, and `narrow_doubt` more for each e-fold of it
    (`benchmarks/aside_fits.py`, corridors of seeds 1 to 3, aside and in reverse).
    """

    even_share: Finite
    chance: Finite
    inliers: Finite
    inlier_share: Finite
    spread: Finite
    doubt: Finite
    bias: Finite
    clear_log_odds: Finite
    hopeless_log_odds: Finite = -3.0
    narrow_spread: Finite = 0.32
    max_narrow_log_odds: Finite = 2.2
    narrow_doubt: Finite = -1.4
    few_points: ClassVar[float] = 0.0
    """The covariance of few points is not inflated."""

    def highest_log_odds(self, evidence: Evidence) -> float:
        """Return the limit of the log-odds: that of a door if the points lie in a small part."""
        if evidence.spread >= self.narrow_spread:
            return math.inf
        return self.max_narrow_log_odds + self.narrow_doubt * (_log_doubt(evidence) - math.log(0.1))

    @property
    def as_vector(self) -> tuple[float, ...]:
        """Return the weights in the order of `features`, without the bias."""
        return (
            self.even_share,
            self.chance,
            self.inliers,
            self.inlier_share,
            self.spread,
            self.doubt,
        )

    @staticmethod
    def features(evidence: Evidence) -> tuple[float, ...]:
        """Return the inputs of the regression."""
        e = evidence
        return (
            _log_even_share(e),
            math.log((e.num_found + 1) / (e.num_by_chance + 5)),
            math.log(e.num_inliers + 1),
            math.log((e.num_inliers + 1) / (e.num_matches + 10)),
            math.log(e.spread + 0.02),
            _log_doubt(e),
        )

    def is_clear(self, log_odds: float) -> bool:
        """Return whether a pose with these log-odds is clear."""
        return log_odds > self.clear_log_odds


class WallStop(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold when virtual views, or a candidate place of theirs, are given up.

    First, the parts of both views within `near_tangent` ahead are compared alone (0: never). Of the
    `num_strong` strongest features of each view, `min_strong` matches must agree on one pose at
    some place. The same holds at each place for the whole views, where `min_agreeing` matches of
    all features must agree, too. The defaults are not fitted; `corpus` is that of others.
    """

    near_tangent: Finite = 0.0
    num_strong: int = 1
    min_strong: int = 0
    min_agreeing: int = 8
    corpus: str = ""
    date: str = ""
    command: str = ""


class VirtualViewWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the weights of the evidence for a pose from virtual views (`walls/`), in log-odds.

    Walls repeat more than rooms do, and fewer of their points are recognised at a slant. Two more
    features count here. `distinct` weighs the found key points that match here better than anywhere
    else in the map. `lesser_side` weighs the agreement of both side views, because one wall alone
    may match a similar place.

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
    stop: WallStop = WallStop()

    @property
    def as_vector(self) -> tuple[float, ...]:
        """Return the weights in the order of `features`, without the bias."""
        shares = (self.found, self.chance, self.inliers, self.inlier_share, self.spread)
        return (*shares, self.distinct, self.lesser_side, self.even_share, self.doubt)

    @staticmethod
    def features(evidence: Evidence) -> tuple[float, ...]:
        """Return the inputs of the regression."""
        e = evidence
        return (
            math.log((e.num_found + 1) / (e.num_visible + 20)),
            math.log((e.num_found + 1) / (e.num_by_chance + 5)),
            math.log(e.num_inliers + 1),
            math.log((e.num_inliers + 1) / (e.num_matches + 10)),
            math.log(e.spread + 0.02),
            math.log((e.num_distinct or 0) + 1),
            math.log((e.num_lesser_side or 0) + 2),
            _log_even_share(e),
            _log_doubt(e),
        )

    def highest_log_odds(self, evidence: Evidence) -> float:
        """Return infinity: virtual views have no limit."""
        return math.inf

    def is_clear(self, log_odds: float) -> bool:
        """Return True: this evidence is compared with all other virtual views already."""
        return True


def compute_log_odds(evidence: Evidence, weights: EvidenceWeights | VirtualViewWeights) -> float:
    """Compute the log-odds that a pose with this evidence is right."""
    features = weights.features(evidence)
    log_odds = sum(w * x for w, x in zip(weights.as_vector, features, strict=True)) + weights.bias
    return min(log_odds, weights.highest_log_odds(evidence))


class RivalWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the weights that compare two poses of one image.

    They weigh the log-odds, the spatially uniform inlier ratio and the normalized uncertainty, in
    logarithms. `lead` is the minimum log-odds margin of a reported pose over each other one,
    `unclear_lead` that of a pose that is not clear over each pose elsewhere.
    """

    odds: Finite
    even_share: Finite
    doubt: Finite
    unclear_lead: Finite
    lead: Finite = 2.0

    def score(self, evidence: Evidence, log_odds: float) -> float:
        """Return the score of a pose. The difference of two scores is a log-odds margin.

        It is NaN for virtual views, whose evidence is of another kind.
        """
        if not evidence.is_of_nodes:
            return math.nan
        even_share, doubt = _log_even_share(evidence), _log_doubt(evidence)
        return self.odds * log_odds + self.even_share * even_share + self.doubt * doubt


class ConfirmationWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the weights of a second feature type on a pose of the first one (`refine.py`).

    `max_log_odds` limits the log-odds that it adds, and `half_weight_matches` is the number of its
    matches that count half. A pose that it confirms has at least `min_log_odds`. Similar places
    reach 1.2.
    """

    max_log_odds: Finite = 3.0
    half_weight_matches: Finite = 30.0
    min_log_odds: Finite = 1.4


class NodeStop(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold when the nodes of a map are given up (`decision.py`).

    If the retrieved nodes give fewer than `min_inliers` inliers, a right pose would have shown
    itself, and of other nodes only places with `min_votes` (`propose.py`) are compared. Without
    `continues_earlier`, earlier feature types are not continued if this one finds no pose. The
    defaults never give up. `corpus` is what they were fitted to.
    """

    min_inliers: int = 0
    min_votes: Finite = 0.0
    continues_earlier: bool = True
    corpus: str = ""
    date: str = ""
    command: str = ""


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
    confirmation: ConfirmationWeights
    stop: NodeStop

    @property
    def is_calibrated(self) -> bool:
        """Return whether the weights were fitted to this feature type."""
        return self.calibration_error is not None

    def for_evidence(self, evidence: Evidence) -> EvidenceWeights | VirtualViewWeights:
        """Return the weights of this evidence: of the map's nodes, or of virtual views."""
        return self.evidence if evidence.is_of_nodes else self.walls

    def log_odds(self, evidence: Evidence) -> float:
        """Return the log-odds that a pose with this evidence is right."""
        return compute_log_odds(evidence, self.for_evidence(evidence))

    def place_log_odds(self, evidence: Evidence) -> float:
        """Return the log-odds that the place is right, for a pose of nodes, as if it were precise
        and its points lay everywhere in the image."""
        weights = structs.replace(self.evidence, narrow_spread=0.0)
        return compute_log_odds(replace(evidence, doubt=0.1), weights)

    def to_json(self) -> dict[str, Any]:
        """Return the JSON object of a file of weights."""
        file = to_builtins(self)
        file["weights"] = {name: file.pop(name) for name in _Groups.__struct_fields__}
        return file


class _Groups(Struct, frozen=True, forbid_unknown_fields=True):
    evidence: EvidenceWeights
    rivals: RivalWeights
    walls: VirtualViewWeights
    shared_errors: CorrelatedErrorWeights
    confirmation: ConfirmationWeights = ConfirmationWeights()
    stop: NodeStop = NodeStop()


class _WeightsFile(Struct, frozen=True, forbid_unknown_fields=True):
    kind: str
    corpus: str
    date: str
    command: str
    calibration_error: Finite
    weights: _Groups


@cache
def load_fitted_weights(kind: str) -> FittedWeights:
    """Return the shipped weights of a feature type. If there are none, return those of a similar
    type, marked as not calibrated. Raises FeatureTypeError: the file is damaged, or of another
    feature type.
    """
    path = WEIGHTS_FOLDER / f"{kind}.json"
    if not path.exists():
        is_learned = kind in FEATURE_TYPES and FEATURE_TYPES[kind].network is not None
        weights = load_fitted_weights(LEARNED_FALLBACK_TYPE if is_learned else FALLBACK_TYPE)
        return replace(weights, kind=kind, calibration_error=None)
    weights = read_weights(path)
    if weights.kind != kind:
        raise FeatureTypeError(f"{path}: weights of {weights.kind}, not of {kind}")
    return weights


def read_weights(path: Path) -> FittedWeights:
    """Read the weights from a file. Raises FeatureTypeError: it cannot be read, or has not the
    format of `FittedWeights.to_json`."""
    fault = f"cannot read the weights in {path}"
    try:
        text = path.read_bytes()
    except OSError as error:
        raise FeatureTypeError(f"{fault}: {error.strerror}") from None
    file = decode_json(text, _WeightsFile, FeatureTypeError, fault)
    source = (file.kind, file.corpus, file.date, file.command, file.calibration_error)
    return FittedWeights(*source, *astuple(file.weights))
