"""What the search for one query image shares: the image, the map, the settings, what is believed so
far; and what it is fed with."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from topoloc.localization.belief import Belief, Hypothesis, log_odds_margin
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.evidence import Evidence
from topoloc.localization.fitted_weights import FittedWeights
from topoloc.localization.open_map import OpenMap
from topoloc.localization.pose_fit import PoseFit
from topoloc.localization.query import Query
from topoloc.retrieval.coarse import NodeScore


@dataclass(frozen=True, eq=False)
class TriedProposal:
    """A first pose and what became of it.

    `refined` is the pose found around the first one (None: the first was not followed up, as where
    that pose was found already), `hypothesis` that with its evidence (None: too little was found
    for any), `milliseconds` the time since the query began, `features` the kind that was asked.
    """

    source: str
    first: PoseFit
    refined: PoseFit | None
    hypothesis: Hypothesis | None
    milliseconds: float
    features: str

    @property
    def fit(self) -> PoseFit:
        """The last fit of it: that of the hypothesis, else the refined one if it has a pose."""
        if self.hypothesis is not None:
            return self.hypothesis.fit
        if self.refined is not None and self.refined.pose is not None:
            return self.refined
        return self.first


@dataclass(eq=False)
class Trace:
    """All first poses that were tried, in order."""

    tried: list[TriedProposal] = field(default_factory=list)


Source = Literal[
    "prior", "retrieval", "other features", "look-alikes", "viewpoints", "repetition", "walls"
]


@dataclass(frozen=True, eq=False)
class Proposal:
    """A first pose (`fit.pose`, None where the matches agree on none), and where it comes from.

    `is_guided`: were the matches sought where a pose expects them? Then they are no evidence for
    it. `repeats`: the evidence for the pose that this one repeats; matches that no pose guided
    speak for both.
    """

    source: Source
    fit: PoseFit
    is_guided: bool
    repeats: Evidence | None = None


@dataclass(eq=False)
class Search:
    """`rho` are the map's correlated errors, `ranked` is what the coarse localizer names, the best
    first, by rows."""

    query: Query
    map: OpenMap
    config: LocalizerConfig
    weights: FittedWeights
    correlated_error_share: float
    trace: Trace | None = None
    previous: Search | None = None
    """The search by the kind of features that was asked before, and left it open."""
    is_last: bool = True
    """No other kind is asked where this one leaves it open."""
    belief: Belief = field(default_factory=Belief)
    ranked: list[NodeScore] = field(default_factory=list)
    retrieved: PoseFit | None = None
    """What retrieval led to."""
    first: PoseFit | None = None
    """What was tried first: where nothing is believed, it says why."""
    is_repetitive: bool = False
    """What is believed is one of many poses from which the place looks alike."""
    is_stopped: bool = False
    """Time was up before everything was tried."""

    @property
    def candidates(self) -> list[NodeScore]:
        """The nodes that were asked together, by their rows."""
        return self.ranked[: self.config.num_candidates]

    @property
    def named(self) -> list[NodeScore]:
        """The same by their ids, as they are reported."""
        return self.map.with_node_ids(self.candidates)

    @property
    def best(self) -> Hypothesis | None:
        """The likeliest hypothesis so far, believed or not."""
        return self.belief.best(self.weights.rivals)

    @property
    def is_clear(self) -> bool:
        """Is there so much for one hypothesis that only parts of the map that look nearly the same
        are asked still?"""
        best = self.best
        return best is not None and best.log_odds > self.weights.evidence.clear_log_odds

    @property
    def is_settled(self) -> bool:
        """Is it clear, and every other hypothesis as far behind as nowhere is? A twin of the place
        that this kind of features believes may be told from it by another one."""
        if not self.is_clear:
            return False
        best, *others = self.belief.ranked(self.weights.rivals)
        return all(
            log_odds_margin(best, other, self.weights.rivals) > self.weights.evidence.clear_log_odds
            for other in others
        )
