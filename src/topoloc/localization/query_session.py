"""One picture put to one map, at a glance or by all means; by all means after a glance goes on from
there."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.belief import Belief, Hypothesis
from topoloc.localization.evidence import Evidence
from topoloc.localization.propose import min_rival_inliers, propose, propose_more, propose_quick
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

# log odds of a pose that only the features asked first found: twins of the true place come to 1.2
_MIN_CONFIRMED_LOG_ODDS = 1.4


@dataclass(eq=False)
class QuerySession:
    """`searches` are one by each kind of the map's features, in turn; `prior` is about where the
    camera is (world_from_cam); `with_provenance` adds what else the map says of an answer."""

    searches: list[Search]
    prior: Rigid3 | None
    with_provenance: Callable[[ResultWithInliers], ResultWithInliers]

    def compute_best_case_evidence(self, least: float) -> Evidence | None:
        """The most that a glance could say for a pose, by the strongest features of the first kind;
        None where fewer than `least` of these agree, or nothing speaks for it. Far cheaper than a
        glance where the picture is of another place."""
        quick_search = replace(self.searches[0])
        proposal = propose_quick(quick_search, least)
        return compute_best_case_evidence(quick_search, proposal) if proposal is not None else None

    def localize_coarse_only(self) -> ResultWithInliers:
        """What retrieval by the first kind of features says alone: the cheapest question that a
        clear picture answers."""
        first = self.searches[0]
        _evaluate_proposals(first, islice(self._first_proposals, 1))
        return self.with_provenance(decide_result(first))

    def localize_exhaustive(self) -> ResultWithInliers:
        """What is believed once all is tried that may settle it."""
        return self.with_provenance(self._localize_all())

    @property
    def times_ms(self) -> dict[str, float]:
        """Milliseconds of each stage so far."""
        return self.searches[0].query.clock.times_ms()

    @property
    def features(self) -> str:
        """The kind that is asked at a glance."""
        return self.searches[0].map.kind.name

    @property
    def min_rival_inliers(self) -> float:
        """How many of the picture's strongest features of the first kind must agree on a pose
        elsewhere for it to be a rival of what is believed."""
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
            is_last = search.is_stopped or search.is_settled or search.is_last
            outcome = decide_final_result(search) if is_last else decide_result(search)
            if (
                search.is_stopped
                or (is_last and isinstance(outcome[0], Localization))
                or _is_calibration_contradicted(outcome[0])
            ):
                return outcome
            is_open = number == 0 and self.prior is not None and not is_last
            if is_open and outcome[1] and (confirmed := self._confirm_with_other_features())[1]:
                return confirmed
        assert outcome is not None
        if len(self.searches) > 1 and not outcome[1] and self.prior is None:
            _evaluate_proposals(self.searches[0], propose_more(self.searches[0]))
            by_first = self._confirm_with_other_features()
            return by_first if by_first[1] else outcome
        return outcome

    def _confirm_with_other_features(self) -> ResultWithInliers:
        """What the first kind of features believes; the last one is heard on it. The pose is that
        of the one for which more speaks: in other light the first one's points are found by chance,
        and hold the pose where it is."""
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
    """Was the pose refused because the picture contradicts its calibration? What other features say
    of the place, less precisely, is as wrong: the calibration is the same."""
    return isinstance(result, NotLocalized) and result.seen_camera is not None


def _evaluate_proposals(search: Search, proposals: Iterable[Proposal]) -> None:
    """All that is proposed, until time is up."""
    for proposal in proposals:
        hypothesis = evaluate_proposal(search, proposal)
        if hypothesis is not None:
            search.belief = search.belief.with_hypothesis(
                hypothesis, search.config.evidence, search.weights.rivals
            )
        if search.query.is_past_deadline:
            search.is_stopped = True
            return
