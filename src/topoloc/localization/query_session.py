"""Localize one image in one map, coarse only or exhaustively.

The exhaustive search continues from the coarse one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.belief import Belief, Hypothesis
from topoloc.localization.propose import min_rival_inliers, propose, propose_more, propose_quick
from topoloc.localization.provenance import Evidence
from topoloc.localization.refine import (
    compute_best_case_evidence,
    cross_check_hypothesis,
    evaluate_proposal,
)
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.result_decision import (
    ResultWithInliers,
    decide_final_result,
    decide_result,
)
from topoloc.localization.search import Proposal, Search

# minimum log-odds of a pose found only by the first feature type; similar places reach 1.2
_MIN_CONFIRMED_LOG_ODDS = 1.4


@dataclass(eq=False)
class QuerySession:
    """Hold the state of one query in one map.

    `searches` holds one search for each feature type, in order. `prior` is the approximate pose
    (world_from_cam). `with_provenance` adds the map's identity to a result.
    """

    searches: list[Search]
    prior: Rigid3 | None
    with_provenance: Callable[[ResultWithInliers], ResultWithInliers]

    def compute_best_case_evidence(self, least: float) -> Evidence | None:
        """Return the best evidence that a coarse search could give, from the strongest features.

        It uses the first feature type. It returns None if fewer than `least` features agree or too
        few points are found. For an out-of-map image this is much cheaper than a coarse search.
        """
        quick_search = replace(self.searches[0])
        proposal = propose_quick(quick_search, least)
        return compute_best_case_evidence(quick_search, proposal) if proposal is not None else None

    def localize_coarse_only(self) -> ResultWithInliers:
        """Return the result of retrieval with the first feature type only.

        It is the cheapest search that localizes a clear image.
        """
        first = self.searches[0]
        _evaluate_proposals(first, islice(self._first_proposals, 1))
        return self.with_provenance(decide_result(first))

    def localize_exhaustive(self) -> ResultWithInliers:
        """Return the result after all proposals that can settle it."""
        return self.with_provenance(self._localize_all())

    @property
    def times_ms(self) -> dict[str, float]:
        """Return the milliseconds of each stage so far."""
        return self.searches[0].query.clock.times_ms()

    @property
    def features(self) -> str:
        """Return the feature type of the coarse search."""
        return self.searches[0].map.kind.name

    @property
    def min_rival_inliers(self) -> float:
        """Return the minimum number of inliers for a pose elsewhere to rival the best pose.

        They are counted among the strongest features of the first type.
        """
        return min_rival_inliers(self.searches[0])

    @cached_property
    def _first_proposals(self) -> Iterable[Proposal]:
        return propose(self.searches[0], self.prior)

    def _localize_all(self) -> ResultWithInliers:
        outcome: ResultWithInliers | None = None
        for number, search in enumerate(self.searches):
            _evaluate_proposals(
                search, propose(search, self.prior) if number else self._first_proposals
            )
            is_final = search.is_stopped or search.is_settled or search.is_last
            outcome = decide_final_result(search) if is_final else decide_result(search)
            if (
                search.is_stopped
                or (is_final and isinstance(outcome[0], Localization))
                or _is_calibration_contradicted(outcome[0])
            ):
                return outcome
            may_confirm = number == 0 and self.prior is not None and not is_final
            if may_confirm and outcome[1] and (confirmed := self._confirm_with_last_type())[1]:
                return confirmed
        assert outcome is not None
        if len(self.searches) > 1 and not outcome[1] and self.prior is None:
            _evaluate_proposals(self.searches[0], propose_more(self.searches[0]))
            by_first = self._confirm_with_last_type()
            return by_first if by_first[1] else outcome
        return outcome

    def _confirm_with_last_type(self) -> ResultWithInliers:
        """Confirm the hypotheses of the first feature type with the last one.

        The reported pose is the one with the higher log-odds. In changed light, points of the first
        type may be found by chance and hold the pose in place.
        """
        first, last = self.searches[0], self.searches[-1]
        evidence, weights = first.config.evidence, first.weights.rivals
        confirmed, by_last = Belief(), dict[int, Hypothesis]()
        for one in (
            one for one in first.belief.hypotheses if one.probability >= evidence.min_probability
        ):
            added_log_odds, from_last = (
                (0.0, None) if one.is_from_virtual_views else cross_check_hypothesis(last, one)
            )
            updated = replace(one, log_odds=one.log_odds + added_log_odds)
            if one.is_from_virtual_views or updated.log_odds >= _MIN_CONFIRMED_LOG_ODDS:
                confirmed = confirmed.with_hypothesis(updated, evidence, weights)
            if from_last is not None and from_last.log_odds > one.log_odds:
                by_last[id(updated)] = replace(from_last, log_odds=updated.log_odds)
        outcome = decide_final_result(replace(first, belief=confirmed))
        best = confirmed.best(weights)
        if not isinstance(outcome[0], Localization) or best is None or id(best) not in by_last:
            return outcome
        return decide_final_result(
            replace(
                last,
                belief=Belief().with_hypothesis(by_last[id(best)], evidence, last.weights.rivals),
            )
        )


def _is_calibration_contradicted(result: Localization | NotLocalized) -> bool:
    """Return whether the pose was refused because the image contradicts its calibration.

    Other feature types are skipped then, because they have the same wrong calibration.
    """
    return isinstance(result, NotLocalized) and result.seen_camera is not None


def _evaluate_proposals(search: Search, proposals: Iterable[Proposal]) -> None:
    """Evaluate the proposals until the time limit."""
    for proposal in proposals:
        hypothesis = evaluate_proposal(search, proposal)
        if hypothesis is not None:
            search.belief = search.belief.with_hypothesis(
                hypothesis, search.config.evidence, search.weights.rivals
            )
        if search.query.is_past_deadline:
            search.is_stopped = True
            return
