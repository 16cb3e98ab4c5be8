"""Could it be elsewhere in the map? Two places that look alike are told apart here, or the answer is "ambiguous".

The pool of the best candidates hides a second place: where its nodes are in the pool, points that are in both fail the ratio
test; where they are not, nobody asks. So nodes that look as much like the image as the best one does, but stand far from the
pose found, are asked once more on their own, and so are the poses that comparison with what nodes saw suggests (`standpoints.py`).

Two poses exclude each other, and their odds against nothing at all say little of which of them it is: a place that repeats itself
has most of its things twice. What tells them apart is the part of the picture where the two differ, in which the wrong pose finds
nothing (the even share found), and that the wrong pose, which has only some of the picture to stand on, is less precise (the doubt).
The weights of both were chosen by hand on pairs of a right and a wrong pose of one picture (`benchmarks/rival_weights.py`). With odds o
of the best pose against "neither" and odds of e^d against each other one, by which it leads that, it is right with the probability
1 / (1 + 1/o + sum of e^-d).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from topoloc.bounds import AtLeast, Between, Fitted
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.attempt import Judgement
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.stages import StageClock
from topoloc.localization.viewing import viewing_distances
from topoloc.map.nodes import NodePoses, node_distances
from topoloc.places.coarse import NodeScore


@dataclass(frozen=True)
class RivalsConfig:
    """When another part of the map is asked, and what makes an answer ambiguous."""

    num_ranked: Annotated[int, Between(1, 10_000)] = 48
    """Nodes that the coarse localizer ranks, the candidates among them; rivals come from these."""
    min_score_share: Annotated[tuple[float, float], Between(0, 1)] = (0.85, 0.4)
    """A rival's score is at least this share of the best one's: where the pose is clear, and where it is not."""
    reach: Annotated[float, AtLeast(0)] = 5.0
    """Nodes within so many D_thresh of a pose (Eq. 1) belong to it; rivals are farther away."""
    agreement: Annotated[float, AtLeast(0)] = 3.0
    """Two poses within so many D_thresh are one."""
    max_groups: Annotated[int, Between(0, 100)] = 3
    """Parts of the map that are asked on their own, at most; 0 asks none, and compares no picture with what nodes saw."""
    odds_weight: Annotated[float, Fitted()] = 0.3
    even_share_weight: Annotated[float, Fitted()] = 6.0
    doubt_weight: Annotated[float, Fitted()] = -3.0
    """How much the odds, the even share found and the doubt count between two poses, in logarithms."""
    min_lead: Annotated[float, AtLeast(0)] = 2.0
    """By how much the best pose must lead the next one, in logarithms of odds."""


def rival_groups(
    ranked: list[NodeScore],
    asked: list[int],
    found: Rigid3 | None,
    is_clear: bool,
    nodes: NodePoses,
    lambda_rot: float,
    d_thresh: float,
    num_candidates: int,
    config: RivalsConfig,
) -> list[list[int]]:
    """Groups of node ids, each of one part of the map, that look like the image about as much as the best node does.

    Args:
        asked: the nodes that were asked together already.
        found: world_from_cam that came of it, if any: nodes around it are no rivals; and whether it is clear.
    """
    reach = config.reach * d_thresh
    least = config.min_score_share[0 if is_clear else 1] * ranked[0].score if ranked else 0.0
    left = [candidate.node_id for candidate in ranked if candidate.score >= least]
    if found is not None:
        far = viewing_distances(found, nodes, lambda_rot) > reach
        left = [node_id for node_id in left if far[node_id]]
    groups: list[list[int]] = []
    while left and len(groups) < config.max_groups:
        leader = Rigid3(nodes.rotations[left[0]], nodes.centres[left[0]])
        near = node_distances(leader, nodes, lambda_rot) <= reach
        group = [node_id for node_id in left if near[node_id]]
        left = [node_id for node_id in left if not near[node_id]]
        if set(group) != set(asked):
            groups.append(group[:num_candidates])
    return groups


def decide(judgements: list[Judgement], lambda_rot: float, d_thresh: float, config: RivalsConfig, clock: StageClock) -> Judgement:
    """The best of them, as probable as the others leave it, or "ambiguous"; the first where none has a pose that is believed."""
    best = max(judgements, key=lambda judgement: (isinstance(judgement.result, Localization), _strength(judgement, config)))
    if not isinstance(best.result, Localization):
        return judgements[0]
    result = replace(best.result, times_ms=clock.times_ms())
    rivals = [j for j in judgements if j is not best and j.evidence and not _agree(best, j, lambda_rot, d_thresh, config)]
    if not rivals:
        return replace(best, result=result)
    leads = [_strength(best, config) - _strength(rival, config) for rival in rivals]
    if min(leads) < config.min_lead:
        detail = f"as much like node {rivals[int(np.argmin(leads))].final.node_id} as like node {result.node_id}"
        refusal = NotLocalized("ambiguous", result.candidates, result.num_matches, result.num_inliers, result.times_ms, detail)
        return replace(best, result=refusal)
    others = math.exp(-best.log_odds) + sum(math.exp(-lead) for lead in leads)
    return replace(best, result=replace(result, probability=1.0 / (1.0 + others)))


def _strength(judgement: Judgement, config: RivalsConfig) -> float:
    """What is compared between two poses; minus infinity where there is none."""
    evidence = judgement.evidence
    if evidence is None:
        return float("-inf")
    odds, even = config.odds_weight * judgement.log_odds, config.even_share_weight * math.log(evidence.even_share + 0.002)
    return odds + even + config.doubt_weight * math.log(max(evidence.doubt, 0.01))


def _agree(a: Judgement, b: Judgement, lambda_rot: float, d_thresh: float, config: RivalsConfig) -> bool:
    if a.final.pose is None or b.final.pose is None:
        return True
    one, other = a.final.pose.cam_from_world.inverse(), b.final.pose.cam_from_world.inverse()
    return float(node_distances(one, NodePoses.of([other]), lambda_rot)[0]) <= config.agreement * d_thresh
