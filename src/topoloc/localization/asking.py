"""One picture put to one map, at a glance or by all means; by all means after a glance goes on from
there."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.answer import Verdict, answer, final_answer
from topoloc.localization.belief import Belief, Hypothesis
from topoloc.localization.evidence import Evidence
from topoloc.localization.propose import least_inliers, propose, propose_briefly, propose_more
from topoloc.localization.refine import best_case, hypothesis_of, say_on
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Proposal, Search

# log odds of a pose that only the features asked first found: twins of the true place come to 1.2
_LEAST_SECOND = 1.4


@dataclass(eq=False)
class Asking:
    """`searches` are one by each kind of the map's features, in turn; `prior` is about where the
    camera is (world_from_cam); `completed` adds what else the map says of an answer."""

    searches: list[Search]
    prior: Rigid3 | None
    completed: Callable[[Verdict], Verdict]

    def best_case(self, least: float) -> Evidence | None:
        """The most that a glance could say for a pose, by the strongest features of the first kind;
        None where fewer than `least` of these agree, or nothing speaks for it. Far cheaper than a
        glance where the picture is of another place."""
        brief = replace(self.searches[0])
        proposal = propose_briefly(brief, least)
        return best_case(brief, proposal) if proposal is not None else None

    def at_a_glance(self) -> Verdict:
        """What retrieval by the first kind of features says alone: the cheapest question that a
        clear picture answers."""
        first = self.searches[0]
        _follow_up(first, islice(self._first_proposals, 1))
        return self.completed(answer(first))

    def by_all_means(self) -> Verdict:
        """What is believed once all is tried that may settle it."""
        return self.completed(self._answered())

    @property
    def times_ms(self) -> dict[str, float]:
        """Milliseconds of each stage so far."""
        return self.searches[0].query.clock.times_ms()

    @property
    def features(self) -> str:
        """The kind that is asked at a glance."""
        return self.searches[0].map.kind.name

    @property
    def least_inliers(self) -> float:
        """How many of the picture's strongest features of the first kind must agree on a pose
        elsewhere for it to be a rival of what is believed."""
        return least_inliers(self.searches[0])

    @cached_property
    def _first_proposals(self) -> Iterable[Proposal]:
        return propose(self.searches[0], self.prior)

    def _answered(self) -> Verdict:
        verdict: Verdict | None = None
        for number, search in enumerate(self.searches):
            _follow_up(search, propose(search, self.prior) if number else self._first_proposals)
            is_last = search.is_stopped or search.is_settled or search.is_last
            verdict = final_answer(search) if is_last else answer(search)
            if (
                search.is_stopped
                or (is_last and isinstance(verdict[0], Localization))
                or _is_of_another_camera(verdict[0])
            ):
                return verdict
            is_open = number == 0 and self.prior is not None and not is_last
            if is_open and verdict[1] and (seconded := self._seconded())[1]:
                return seconded
        assert verdict is not None
        if len(self.searches) > 1 and not verdict[1] and self.prior is None:
            _follow_up(self.searches[0], propose_more(self.searches[0]))
            of_first = self._seconded()
            return of_first if of_first[1] else verdict
        return verdict

    def _seconded(self) -> Verdict:
        """What the first kind of features believes; the last one is heard on it. The pose is that
        of the one for which more speaks: in other light the first one's points are found by chance,
        and hold the pose where it is."""
        first, last = self.searches[0], self.searches[-1]
        evidence, weights = first.config.evidence, first.weights.rivals
        seconded, by_last = Belief(), dict[int, Hypothesis]()
        for one in (
            one for one in first.belief.hypotheses if one.probability >= evidence.min_probability
        ):
            said, of_last = (0.0, None) if one.is_from_walls else say_on(last, one)
            heard = replace(one, log_odds=one.log_odds + said)
            if one.is_from_walls or heard.log_odds >= _LEAST_SECOND:
                seconded = seconded.given(heard, evidence, weights)
            if of_last is not None and of_last.log_odds > one.log_odds:
                by_last[id(heard)] = replace(of_last, log_odds=heard.log_odds)
        verdict = final_answer(replace(first, belief=seconded))
        best = seconded.best(weights)
        if not isinstance(verdict[0], Localization) or best is None or id(best) not in by_last:
            return verdict
        return final_answer(
            replace(last, belief=Belief().given(by_last[id(best)], evidence, last.weights.rivals))
        )


def _is_of_another_camera(result: Localization | NotLocalized) -> bool:
    """Was the pose refused because the picture contradicts its calibration? What other features say
    of the place, less precisely, is as wrong: the calibration is the same."""
    return isinstance(result, NotLocalized) and result.seen_camera is not None


def _follow_up(search: Search, proposals: Iterable[Proposal]) -> None:
    """All that is proposed, until time is up."""
    for proposal in proposals:
        hypothesis = hypothesis_of(search, proposal)
        if hypothesis is not None:
            search.belief = search.belief.given(
                hypothesis, search.config.evidence, search.weights.rivals
            )
        if search.query.is_late:
            search.is_stopped = True
            return
