"""What is answered where the nodes and the walls both have something to say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from topoloc.localization.attempt import Attempt, Judgement
from topoloc.localization.side_verdict import SideVerdictConfig, decide_with_sides, side_log_odds
from topoloc.localization.verification import Evidence

from built_corridor import WIDE
from topoloc.features.features import Features, Matches
from topoloc.geometry.absolute_pose import AbsolutePose
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.fitted_weights import weights_of
from topoloc.localization.local_map import LocalMap
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.stages import StageClock
from topoloc.places.coarse import NodeScore

CONFIG, WEIGHTS = SideVerdictConfig(), weights_of("surf").walls
EVIDENCE = Evidence(num_matches=150, num_inliers=40, num_found=60, num_visible=200, num_by_chance=12, spread=0.5, doubt=0.3, even_share=0.2)
CANDIDATES = [NodeScore(3, 0.5)]


def _attempt(at: float) -> Attempt:
    empty, one, rows = np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int32)
    local_map = LocalMap(np.zeros((0, 64), np.float32), empty, np.zeros((0, 3, 3)), one, np.zeros(0, int), one, empty)
    pose = AbsolutePose(Rigid3(np.eye(3), np.array([at, 0.0, 0.0])), np.zeros(0, bool), np.eye(6), one)
    return Attempt(Features.empty(64), WIDE, WIDE, local_map, Matches(rows, rows, np.zeros(0, np.float32)), pose)


def _localized(log_odds: float, at: float = 0.0, doubt: float = 0.3) -> Judgement:
    """A pose `at` metres along x."""
    attempt, evidence = _attempt(at), replace(EVIDENCE, doubt=doubt)
    assert attempt.pose is not None
    answer = Localization(attempt.pose.cam_from_world.inverse(), np.eye(6), 0.9, 1, CANDIDATES, 150, 60, evidence=evidence)
    return Judgement(answer, attempt, evidence, log_odds)


def _not_localized(log_odds: float = -math.inf) -> Judgement:
    return Judgement(NotLocalized("not_in_map", CANDIDATES, 90, 9), _attempt(0.0), EVIDENCE, log_odds)


def _decide(judgement: Judgement, sides: list[Judgement]) -> Judgement:
    return decide_with_sides(judgement, sides, CONFIG, StageClock())


def _is_answer_of(decided: Judgement, judgement: Judgement) -> bool:
    if decided.final is not judgement.final:
        return False
    one, other = decided.result, judgement.result
    if isinstance(one, Localization) and isinstance(other, Localization):
        return one.world_from_cam is other.world_from_cam
    return isinstance(one, NotLocalized) and isinstance(other, NotLocalized) and one.reason == other.reason


@pytest.mark.parametrize("judgement", [_localized(0.7), _not_localized(-3.0)], ids=["localized", "not localized"])
def test_where_the_walls_say_nothing_the_nodes_do(judgement: Judgement):
    decided = _decide(judgement, [])
    assert _is_answer_of(decided, judgement)
    assert decided.log_odds == judgement.log_odds
    assert "total" in decided.result.times_ms  # with the time that it took to ask the walls


@pytest.mark.parametrize("log_odds", [-math.inf, -2.0])
def test_walls_lead_where_nodes_know_nothing(log_odds: float):
    sides = [_localized(1.5, at=-9.0), _localized(-2.0, at=4.0)]
    decided = _decide(_not_localized(log_odds), sides)
    assert _is_answer_of(decided, sides[0])
    assert isinstance(decided.result, Localization)
    assert CONFIG.min_probability <= decided.result.probability <= 1.0 / (1.0 + math.exp(-1.5))
    assert "total" in decided.result.times_ms


def test_walls_lead_a_pose_of_the_nodes_that_has_much_less_for_it():
    sides = [_localized(3.0, at=-9.0)]
    assert _is_answer_of(_decide(_localized(3.0 - CONFIG.min_lead - 0.1), sides), sides[0])


def test_nodes_lead_walls_that_have_much_less_for_them():
    judgement = _localized(1.0)
    decided = _decide(judgement, [_localized(1.0 - CONFIG.min_lead - 0.1, at=-9.0)])
    assert _is_answer_of(decided, judgement)
    assert isinstance(decided.result, Localization)
    assert decided.result.probability == 0.9  # what the nodes said, untouched


@pytest.mark.parametrize("lead", [-0.9, 0.0, 0.9])
def test_a_pose_of_the_nodes_that_the_walls_contradict_is_ambiguous(lead: float):
    decided = _decide(_localized(2.0), [_localized(2.0 + lead * CONFIG.min_lead, at=-9.0)])
    assert isinstance(decided.result, NotLocalized)
    assert decided.result.reason == "ambiguous"
    assert decided.result.candidates == CANDIDATES
    assert "walls" in decided.result.detail


@pytest.mark.parametrize("judgement", [_not_localized(), _localized(2.0)], ids=["not localized", "localized"])
def test_two_walls_that_look_alike_are_no_answer(judgement: Judgement):
    decided = _decide(judgement, [_localized(3.0, at=-9.0), _localized(3.0 - 0.9 * CONFIG.min_lead, at=4.0)])
    assert isinstance(decided.result, NotLocalized)
    assert decided.result.reason == ("ambiguous" if isinstance(judgement.result, Localization) else "not_in_map")


def test_an_unbelieved_pose_of_the_nodes_counts_as_a_rival():
    """It was not believed, but the walls do not lead it by enough either."""
    assert isinstance(_decide(_not_localized(0.9), [_localized(1.5, at=-9.0)]).result, NotLocalized)


def test_a_place_beyond_doubt_but_imprecise_is_not_answered():
    precise, imprecise = (_decide(_not_localized(), [_localized(8.0, at=-9.0, doubt=doubt)]).result for doubt in (0.3, 3.0))
    assert isinstance(precise, Localization)
    assert precise.probability > 0.99
    assert isinstance(imprecise, NotLocalized)


def test_walls_that_are_not_probable_are_not_answered():
    assert isinstance(_decide(_not_localized(), [_localized(-0.5, at=-9.0)]).result, NotLocalized)


@given(
    of_nodes=st.floats(-6.0, 6.0),
    believed=st.booleans(),
    of_walls=st.lists(st.floats(-6.0, 8.0), max_size=4),
    doubt=st.floats(0.05, 4.0),
)
def test_whatever_is_said_an_answer_leads_all_others(of_nodes: float, believed: bool, of_walls: list[float], doubt: float):
    sides = [_localized(x, at=-9.0 - k, doubt=doubt) for k, x in enumerate(sorted(of_walls, reverse=True))]
    judgement = _localized(of_nodes) if believed else _not_localized(of_nodes)
    decided = _decide(judgement, sides)
    if isinstance(decided.result, Localization):
        assert _is_answer_of(decided, judgement) or _is_answer_of(decided, sides[0])
        others = [other.log_odds for other in (judgement, *sides) if not _is_answer_of(decided, other)]
        assert decided.log_odds - max(others, default=-math.inf) >= CONFIG.min_lead
        assert decided.result.probability >= CONFIG.min_probability
    elif believed:
        assert decided.result.reason == "ambiguous"


MORE = {
    "found": (replace(EVIDENCE, num_found=90), 30),
    "less must be in view": (replace(EVIDENCE, num_visible=120), 30),
    "less by chance": (replace(EVIDENCE, num_by_chance=3), 30),
    "inliers": (replace(EVIDENCE, num_inliers=60), 30),
    "fewer matches that agree with nothing": (replace(EVIDENCE, num_matches=80), 30),
    "spread": (replace(EVIDENCE, spread=0.8), 30),
    "precise": (replace(EVIDENCE, doubt=0.1), 30),
    "distinct": (EVIDENCE, 50),
}


@pytest.mark.parametrize(("evidence", "num_distinct"), MORE.values(), ids=MORE.keys())
def test_more_evidence_means_better_odds(evidence: Evidence, num_distinct: int):
    assert side_log_odds(evidence, num_distinct, WEIGHTS) > side_log_odds(EVIDENCE, 30, WEIGHTS) + 0.1


def test_no_evidence_at_all_is_odds_all_the_same():
    nothing = Evidence(num_matches=0, num_inliers=0, num_found=0, num_visible=0, num_by_chance=0, spread=0.0, doubt=50.0, even_share=0.0)
    assert side_log_odds(nothing, 0, WEIGHTS) < -5.0
