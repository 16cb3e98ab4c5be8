"""Hold the state of the search for one query image, and verify its pose proposals."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Int

from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import OneLine
from topoloc.localization.belief import Belief, Hypothesis, log_odds_margin
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.exact.templates import NodeTemplates, PointTemplates
from topoloc.localization.feature_map import FeatureMap
from topoloc.localization.fitted_weights import FittedWeights
from topoloc.localization.pose_fit import PointMatches, PoseFit
from topoloc.localization.query import Query
from topoloc.localization.result import CandidateNode
from topoloc.node_ids import NodeId
from topoloc.retrieval.coarse import NodeScore

if TYPE_CHECKING:
    from topoloc.localization.answer import Finding


@dataclass(frozen=True, eq=False, repr=False)
class TriedProposal(OneLine):
    """Record a pose proposal and its outcome.

    `first` is the proposal, and `refined` the pose found around it. It is None if the proposal was
    not refined, for example because that pose was found already. `hypothesis` is the refined pose
    with its evidence, None if too few points were found. `milliseconds` is the time since the query
    began. `features` is the feature type.
    """

    source: str
    first: PointMatches
    refined: PointMatches | None
    hypothesis: Hypothesis | None
    milliseconds: float
    features: str

    @property
    def world_from_cam(self) -> Rigid3 | None:
        """Return the pose, None if the matches agree on none."""
        return self.fit.world_from_cam if isinstance(self.fit, PoseFit) else None

    @property
    def fit(self) -> PointMatches:
        """The last fit of it: that of the hypothesis, else the refined one if it has a pose."""
        if self.hypothesis is not None:
            return self.hypothesis.fit
        if isinstance(self.refined, PoseFit):
            return self.refined
        return self.first


@dataclass(eq=False, repr=False)
class Trace(OneLine):
    """Collect all tried pose proposals and the findings of the checks, in order, and the nodes
    without a usable image that the last step met."""

    tried: list[TriedProposal] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    nodes_without_image: set[NodeId] = field(default_factory=set)


Source = Literal[
    "prior",
    "retrieval",
    "votes",
    "other features",
    "look-alikes",
    "viewpoints",
    "repetition",
    "walls",
]


@dataclass(frozen=True, eq=False)
class Proposal(ABC):
    """Hold a pose proposal: its search, which is a feature type of a tile, and its source.

    `fit` is a `PoseFit` if the matches agree on a pose. The view of the map that a proposal comes
    from, the nodes or the virtual views, knows how to refine and to score it.
    """

    search: Search
    source: Source
    fit: PointMatches

    @abstractmethod
    def refine(self) -> PointMatches | None:
        """Return the refined pose. None if it was found already or too few points agree."""

    @abstractmethod
    def score(self, final: PointMatches) -> Hypothesis | None:
        """Return the refined pose as a hypothesis. None if too few points were found."""


@dataclass(eq=False)
class Search:
    """Hold the state of a search with one feature type.

    `correlated_error_share` is rho of the map. `ranked` holds the nodes by row, as ranked by the
    coarse localizer, best first.
    """

    query: Query
    map: FeatureMap
    config: LocalizerConfig
    weights: FittedWeights
    correlated_error_share: float
    trace: Trace | None = None
    previous: Search | None = None
    """The search with the preceding feature type, which left the pose unclear."""
    is_last: bool = True
    """True if no other feature type follows."""
    belief: Belief = field(default_factory=Belief)
    ranked: list[NodeScore] = field(default_factory=list)
    retrieved: PointMatches | None = None
    """The fit to the retrieved candidates, whose matches no pose guided."""
    first: PointMatches | None = None
    """The first fit tried. It gives the reason if there is no hypothesis."""
    is_stopped: bool = False
    """True if the time limit was reached before all proposals were tried."""

    @property
    def candidates(self) -> list[NodeScore]:
        """Return the nodes whose points are pooled, by row."""
        return self.ranked[: self.config.num_candidates]

    @property
    def candidate_nodes(self) -> list[CandidateNode]:
        """Return the candidates by node id, as they are reported."""
        return [CandidateNode(self.map.node_ids[one.row], one.score) for one in self.candidates]

    @property
    def best(self) -> Hypothesis | None:
        """Return the likeliest hypothesis so far, even if its probability is low."""
        return self.belief.hypotheses[0] if self.belief.hypotheses else None

    @property
    def num_retrieved(self) -> int:
        """Return the number of inliers of the fit to the retrieved candidates."""
        return 0 if self.retrieved is None else self.retrieved.num_inliers

    @property
    def is_clear(self) -> bool:
        """Return whether the best hypothesis is clear. Only very similar places are then
        searched."""
        best = self.best
        return best is not None and best.log_odds > self.weights.evidence.clear_log_odds

    @property
    def is_settled(self) -> bool:
        """Return whether the best hypothesis is clear and leads each other one by the same margin.

        If it does not, another feature type may separate the place from a similar one.
        """
        if not self.is_clear:
            return False
        best, *others = self.belief.hypotheses
        return all(
            log_odds_margin(best, other, self.weights.rivals) > self.weights.evidence.clear_log_odds
            for other in others
        )

    @property
    def is_hopeless(self) -> bool:
        """Return whether more proposals of nodes would find nothing, because retrieval found
        nothing with this feature type and none before it left a probable pose."""
        least = self.config.evidence.min_probability
        searches = [self] if self.previous is None else [self, self.previous]
        found = [one.best for one in searches]
        is_open = any(best is not None and best.probability >= least for best in found)
        return not is_open and self.num_retrieved < self.weights.stop.min_inliers

    def templates(self, node_of_point: Int[np.ndarray, " n"]) -> PointTemplates:
        """Return the images of the nodes of points. The trace collects nodes without one."""
        node_ids, of_point = np.unique(node_of_point, return_inverse=True)
        templates = self.map.templates(node_ids.tolist())
        if self.trace is not None:
            pairs = zip(node_ids.tolist(), templates, strict=True)
            self.trace.nodes_without_image.update(one for one, image in pairs if image.is_black)
        return PointTemplates(NodeTemplates(templates), of_point)


def verify(proposal: Proposal) -> None:
    """Refine a proposal, score it, and add the hypothesis to the belief of its search.

    There is none if too few points were found, or the pose was found already.
    """
    search, final = proposal.search, proposal.refine()
    hypothesis = None if final is None else proposal.score(final)
    if search.first is None:
        search.first = final if isinstance(final, PoseFit) else proposal.fit
    if search.trace is not None:
        milliseconds = search.query.clock.times_ms()["total"]
        kind = search.query.feature_config.kind
        search.trace.tried.append(
            TriedProposal(proposal.source, proposal.fit, final, hypothesis, milliseconds, kind)
        )
    if hypothesis is not None:
        search.belief = search.belief.with_hypothesis(
            hypothesis, search.config.evidence, search.weights.rivals
        )
