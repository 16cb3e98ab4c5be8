"""Is a pose that the walls let expect believed, beside what the map's nodes say?

Much of what speaks for a pose is the same as in `verification.py`, with weights of its own: a wall repeats itself more than a room
does, and less of it is recognised at a slant. The weights are set by hand, on a rendered corridor and a rendered street that were mapped
in one direction and walked in the other, and on queries from elsewhere, of which none came near (docs/journal.md, "The other way round").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

from topoloc.bounds import AtLeast, Between, Fitted
from topoloc.localization.attempt import Judgement
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.stages import StageClock
from topoloc.localization.verification import Evidence


@dataclass(frozen=True)
class SideVerdictConfig:
    """The weights of the evidence, and what is asked of an answer; all in logarithms of odds."""

    found_weight: Annotated[float, Fitted()] = 0.89
    chance_weight: Annotated[float, Fitted()] = 1.47
    inliers_weight: Annotated[float, Fitted()] = 0.54
    inlier_share_weight: Annotated[float, Fitted()] = 2.16
    spread_weight: Annotated[float, Fitted()] = 0.6
    doubt_weight: Annotated[float, Fitted()] = -0.5
    distinct_weight: Annotated[float, Fitted()] = 0.8
    bias: Annotated[float, Fitted()] = 2.96
    min_lead: Annotated[float, AtLeast(0)] = 2.0
    """By how much the best of the walls' poses must lead the next one, and that of the nodes, be that believed or not; and by how much
    a believed one of the nodes must lead it, not to be called in question."""
    rival_log_odds: Annotated[float, Between(-100, 100)] = 2.5
    """Of a pose found by the nodes with more for it, the walls are not asked."""
    min_probability: Annotated[float, Between(0, 1)] = 0.5
    """Of the right place and a precise pose together: less probable poses are not reported."""


def side_log_odds(e: Evidence, num_distinct: int, config: SideVerdictConfig) -> float:
    """Logarithm of the odds that a pose is right.

    Args:
        num_distinct: inliers that look more like the map's point here than like any elsewhere.
    """
    return (
        config.found_weight * math.log((e.num_found + 1) / (e.num_visible + 20))
        + config.chance_weight * math.log((e.num_found + 1) / (e.num_by_chance + 5))
        + config.inliers_weight * math.log(e.num_inliers + 1)
        + config.inlier_share_weight * math.log((e.num_inliers + 1) / (e.num_matches + 10))
        + config.spread_weight * math.log(e.spread + 0.02)
        + config.doubt_weight * math.log(max(e.doubt, 0.01))
        + config.distinct_weight * math.log(num_distinct + 1)
        + config.bias
    )


def decide_with_sides(judgement: Judgement, sides: list[Judgement], config: SideVerdictConfig, clock: StageClock) -> Judgement:
    """What the nodes say, or the best of what the walls say (`sides`, best first), or "ambiguous".

    The walls' poses are far from all nodes that look alike, so the two never agree.
    """
    times_ms = clock.times_ms()
    of_nodes = replace(judgement, result=replace(judgement.result, times_ms=times_ms))
    if not sides:
        return of_nodes
    best, next_best = sides[0].log_odds, sides[1].log_odds if len(sides) > 1 else -math.inf
    is_localized = isinstance(judgement.result, Localization)
    if is_localized and judgement.log_odds - best >= config.min_lead:
        return of_nodes
    is_ahead = best - max(next_best, judgement.log_odds) >= config.min_lead
    answer, evidence = sides[0].result, sides[0].evidence
    assert isinstance(answer, Localization)
    assert evidence is not None
    # a wall alone may leave a pose imprecise though the place is beyond doubt
    is_precise = math.erf(1.0 / (math.sqrt(2.0) * evidence.doubt))
    probability = is_precise / (1.0 + math.exp(-best) + math.exp(next_best - best))
    if is_ahead and probability >= config.min_probability:
        return replace(sides[0], result=replace(answer, probability=probability, times_ms=times_ms))
    if not is_localized:
        return of_nodes
    r = judgement.result
    refusal = NotLocalized("ambiguous", r.candidates, r.num_matches, r.num_inliers, times_ms, "the walls to both sides say otherwise")
    return replace(of_nodes, result=refusal)
