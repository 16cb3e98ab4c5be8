"""Test the belief over several hypotheses of one image and its result, which do not
depend on the order."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st
from msgspec import structs

from made_hypotheses import CANDIDATES, WEIGHTS, believed, made_features, made_fit, made_hypothesis
from topoloc.localization.answer import lead
from topoloc.localization.belief import (
    Hypothesis,
    is_same_fit,
    log_odds_margin,
)
from topoloc.localization.config import EvidenceConfig, LocalizerConfig
from topoloc.localization.provenance import Evidence
from topoloc.localization.result import Localization, NotLocalized

CONFIG = EvidenceConfig()
POINTS = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 3))


def _answered(*hypotheses: Hypothesis) -> Localization | NotLocalized:
    return lead(believed(list(hypotheses))).result


def _along(result: Localization | NotLocalized) -> float:
    """Return x in metres of the reported pose."""
    assert isinstance(result, Localization)
    return float(result.world_from_cam.translation[0])


# the strongest hypothesis of each pose


def test_a_hypothesis_of_the_same_pose_replaces_the_weaker_one_and_not_the_stronger():
    weak, strong, elsewhere = (
        made_hypothesis(1.0),
        made_hypothesis(3.0, x=0.1),
        made_hypothesis(0.5, x=9.0),
    )
    search = believed([weak, elsewhere, strong, made_hypothesis(2.0, x=0.05)])
    assert {id(one) for one in search.belief.hypotheses} == {id(strong), id(elsewhere)}
    assert search.best is strong


def test_poses_within_twice_the_tolerance_are_one():
    here = made_fit(0.0)
    assert is_same_fit(here, made_fit(0.4), CONFIG)
    assert not is_same_fit(here, made_fit(0.6), CONFIG)


@pytest.mark.parametrize(
    ("moved", "expected"),
    [(0.0, True), (0.04, True), (5.0, False)],
    ids=["same", "in doubt", "elsewhere"],
)
def test_distant_poses_with_the_same_matches_are_one(moved: float, expected: bool):
    """One pose is not precise yet. At two similar places, the same features match other points."""
    features = made_features(len(POINTS))
    one = made_fit(0.0, POINTS, features)
    assert (
        is_same_fit(one, made_fit(1.0, POINTS + np.array([moved, 0.0, 0.0]), features), CONFIG)
        is expected
    )
    assert not is_same_fit(
        one, made_fit(1.0, POINTS, made_features(len(POINTS))), CONFIG
    )  # of other features nothing follows


def test_poses_so_uncertain_that_both_may_be_right_are_one():
    here, there = made_hypothesis(3.0), made_hypothesis(3.0, x=1.5)
    assert len(believed([here, there]).belief.hypotheses) == 2
    unsure = replace(there, covariance=np.diag([0.5, 1e-8, 1e-8, 1e-8, 1e-8, 1e-8]))
    assert len(believed([here, unsure]).belief.hypotheses) == 1


# one posterior

hypotheses_of_nodes = st.builds(
    made_hypothesis,
    st.floats(-8.0, 12.0),
    st.integers(0, 5).map(lambda k: 10.0 * k),
    st.floats(0.0, 1.0),
    st.floats(0.01, 50.0),
)
hypotheses_of_walls = st.builds(
    made_hypothesis,
    st.floats(-8.0, 12.0),
    st.integers(6, 9).map(lambda k: 10.0 * k),
    st.floats(0.0, 1.0),
    st.floats(0.01, 50.0),
    st.just(True),
)
some_hypotheses = st.lists(hypotheses_of_nodes | hypotheses_of_walls, max_size=6)


@given(some_hypotheses)
def test_probabilities_of_exclusive_hypotheses_sum_to_at_most_one(
    hypotheses: list[Hypothesis],
):
    result = _answered(*hypotheses)
    if isinstance(result, Localization):
        assert CONFIG.min_probability <= result.probability <= 1.0
        return
    probabilities = [one.probability for one in result.alternatives]
    assert probabilities == sorted(probabilities, reverse=True)
    assert all(0.0 < probability <= 1.0 for probability in probabilities)
    assert sum(probabilities) <= 1.0 + 1e-12
    assert (result.reason == "ambiguous") == (len(probabilities) > 1)


@given(some_hypotheses)
def test_a_reported_pose_leads_all_others(hypotheses: list[Hypothesis]):
    search = believed(hypotheses)
    result = lead(search).result
    if isinstance(result, Localization):
        assert search.best is not None
        assert result.world_from_cam == search.best.world_from_cam or np.array_equal(
            result.world_from_cam.matrix(), search.best.world_from_cam.matrix()
        )
        others = [one for one in search.belief.hypotheses if one is not search.best]
        assert all(
            log_odds_margin(search.best, other, WEIGHTS.rivals) >= WEIGHTS.rivals.lead
            for other in others
        )


@given(
    some_hypotheses.filter(lambda those: len({one.log_odds for one in those}) == len(those)),
    st.randoms(use_true_random=False),
)
def test_the_result_does_not_depend_on_the_order_of_hypotheses(
    hypotheses: list[Hypothesis], random
):
    other_order = list(hypotheses)
    random.shuffle(other_order)
    one, other = _answered(*hypotheses), _answered(*other_order)
    facts, others = (result.to_json("") | {"times_ms": {}} for result in (one, other))
    assert facts.keys() == others.keys()
    for key in ("localized", "reason", "detail", "world_from_cam", "node"):
        assert facts.get(key) == others.get(key)
    assert facts.get("probability", 0.0) == pytest.approx(others.get("probability", 0.0))
    mine, theirs = (
        [(x["world_from_cam"], pytest.approx(x["probability"])) for x in f.get("alternatives", [])]
        for f in (facts, others)
    )
    assert mine == theirs


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 1, 0), (0, 2, 1)], ids=str)
def test_chains_of_near_poses_are_split_equally_in_any_order(
    order: tuple[int, ...],
):
    """The middle pose equals both ends, and the ends differ."""
    chain = [made_hypothesis(3.0, x=0.0), made_hypothesis(2.0, x=0.4), made_hypothesis(1.0, x=0.8)]
    belief = believed([chain[k] for k in order]).belief
    assert [one.log_odds for one in belief.hypotheses] == [3.0, 1.0]


def test_alone_a_hypothesis_is_as_probable_as_its_odds_against_nowhere():
    result = _answered(made_hypothesis(2.0, x=3.0))
    assert isinstance(result, Localization)
    assert result.probability == pytest.approx(1.0 / (1.0 + math.exp(-2.0)))
    assert _along(result) == pytest.approx(3.0)
    assert result.candidates == CANDIDATES


def test_another_hypothesis_far_behind_takes_a_little_of_the_probability():
    best, other = made_hypothesis(4.0), made_hypothesis(-1.0, x=9.0, even_share=0.06)
    alone, beside = _answered(best), _answered(other, best)
    assert isinstance(alone, Localization)
    assert isinstance(beside, Localization)
    behind = log_odds_margin(best, other, WEIGHTS.rivals)
    assert behind > WEIGHTS.rivals.lead
    assert beside.probability == pytest.approx(1.0 / (1.0 + math.exp(-4.0) + math.exp(-behind)))
    assert beside.probability < alone.probability


# two similar places


def test_two_similar_places_are_ambiguous_and_both_are_named():
    one, other = (
        made_hypothesis(4.0, fit=made_fit(0.0, POINTS, node_id=3)),
        made_hypothesis(3.8, fit=made_fit(9.0, POINTS, node_id=8)),
    )
    result = _answered(one, other)
    assert isinstance(result, NotLocalized)
    assert result.reason == "ambiguous"
    assert [alternative.node_id for alternative in result.alternatives] == [3, 8]
    assert [alternative.world_from_cam.translation[0] for alternative in result.alternatives] == [
        0.0,
        9.0,
    ]
    assert sum(alternative.probability for alternative in result.alternatives) > 0.95
    assert result.detail == "as much like node 8 as like node 3"
    line = json.loads(json.dumps(result.to_json("a.png"), allow_nan=False))
    assert "world_from_cam" not in line
    assert [named["node"] for named in line["alternatives"]] == [3, 8]
    assert line["alternatives"][1]["world_from_cam"] == {
        "translation": [9.0, 0.0, 0.0],
        "quat_wxyz": [1.0, 0.0, 0.0, 0.0],
    }
    assert line["alternatives"][0]["probability"] == result.alternatives[0].probability


def test_spatial_uniformity_decides_between_poses_with_equal_odds():
    full, half = (
        made_hypothesis(5.0, even_share=0.2, doubt=0.1),
        made_hypothesis(5.0, x=9.0, even_share=0.02, doubt=0.5),
    )
    assert _along(_answered(half, full)) == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("log_odds", "other", "is_answered"), [(3.0, 0.5, True), (3.0, 1.5, False), (6.0, 5.0, True)]
)
def test_an_unclear_pose_must_also_lead_by_its_odds(
    log_odds: float, other: float, is_answered: bool
):
    """A place outside of the map may have as much evidence as a wrong place in the map."""
    best, wrong = (
        made_hypothesis(log_odds, even_share=0.2),
        made_hypothesis(other, x=9.0, even_share=0.02),
    )
    assert isinstance(_answered(best, wrong), Localization) is is_answered


# virtual views


@pytest.mark.parametrize(
    "of_nodes", [[], [made_hypothesis(-3.0)]], ids=["nothing", "hardly anything"]
)
def test_virtual_views_are_reported_if_nodes_find_nothing(of_nodes: list[Hypothesis]):
    walls = [made_hypothesis(1.5, x=-9.0, walls=True), made_hypothesis(-2.0, x=4.0, walls=True)]
    result = _answered(*of_nodes, *walls)
    assert isinstance(result, Localization)
    assert _along(result) == pytest.approx(-9.0)
    assert CONFIG.min_probability <= result.probability <= 1.0 / (1.0 + math.exp(-1.5))


@pytest.mark.parametrize(
    ("log_odds", "is_answered"), [(2.0, False), (WEIGHTS.evidence.clear_log_odds + 0.1, True)]
)
def test_an_unclear_pose_must_lead_by_the_margin_of_its_feature_type(
    log_odds: float, is_answered: bool
):
    search = believed(
        [made_hypothesis(log_odds, even_share=0.3), made_hypothesis(log_odds - 3.0, x=9.0)]
    )
    assert isinstance(lead(search).result, Localization)
    strict = replace(WEIGHTS, rivals=structs.replace(WEIGHTS.rivals, unclear_lead=4.0))
    assert isinstance(lead(replace(search, weights=strict)).result, Localization) == is_answered


def test_virtual_views_need_no_margin_of_unclear_node_poses():
    """Each of their points was compared with all other virtual views."""
    strict = replace(WEIGHTS, rivals=structs.replace(WEIGHTS.rivals, unclear_lead=4.0))
    for walls in (True, False):
        search = believed(
            [
                made_hypothesis(2.5, x=-9.0, walls=walls),
                made_hypothesis(2.5 - WEIGHTS.rivals.lead - 0.1),
            ]
        )
        assert isinstance(lead(replace(search, weights=strict)).result, Localization) == walls


@pytest.mark.parametrize("doubt", [0.9, 1.5])
def test_unclear_node_poses_need_a_margin_only_over_reportable_virtual_views(
    doubt: float,
):
    strict = replace(WEIGHTS, rivals=structs.replace(WEIGHTS.rivals, unclear_lead=4.0))
    behind = 2.5 - WEIGHTS.rivals.lead - 0.1
    search = believed(
        [made_hypothesis(2.5), made_hypothesis(behind, x=-9.0, walls=True, doubt=doubt)]
    )
    result = lead(replace(search, weights=strict)).result
    assert isinstance(result, Localization) == (doubt > 1.0)


def test_of_virtual_views_and_nodes_the_far_stronger_pose_is_reported():
    behind = 3.0 - WEIGHTS.rivals.lead - 0.1
    assert _along(
        _answered(made_hypothesis(behind), made_hypothesis(3.0, x=-9.0, walls=True))
    ) == pytest.approx(-9.0)
    assert _along(
        _answered(made_hypothesis(3.0), made_hypothesis(behind, x=-9.0, walls=True))
    ) == pytest.approx(0.0)


@pytest.mark.parametrize("ahead", [-0.9, 0.0, 0.9])
def test_a_node_pose_that_virtual_views_contradict_is_ambiguous(ahead: float):
    result = _answered(
        made_hypothesis(2.0), made_hypothesis(2.0 + ahead * WEIGHTS.rivals.lead, x=-9.0, walls=True)
    )
    assert isinstance(result, NotLocalized)
    assert result.reason == "ambiguous"
    assert {alternative.world_from_cam.translation[0] for alternative in result.alternatives} == {
        0.0,
        -9.0,
    }


@pytest.mark.parametrize(
    "of_nodes", [[], [made_hypothesis(2.0)]], ids=["without nodes", "with nodes"]
)
def test_two_similar_virtual_views_give_no_pose(of_nodes: list[Hypothesis]):
    walls = [
        made_hypothesis(3.0, x=-9.0, walls=True),
        made_hypothesis(3.0 - 0.9 * WEIGHTS.rivals.lead, x=4.0, walls=True),
    ]
    result = _answered(*of_nodes, *walls)
    assert isinstance(result, NotLocalized)
    assert result.reason == "ambiguous"


def test_virtual_views_that_do_not_lead_an_unreported_node_pose_give_no_pose():
    unlikely = made_hypothesis(-0.1)
    assert unlikely.probability < CONFIG.min_probability
    assert isinstance(_answered(unlikely, made_hypothesis(1.5, x=-9.0, walls=True)), NotLocalized)


def test_a_certain_but_imprecise_place_is_not_reported():
    evidence = Evidence(
        150, 40, 60, 200, 12, spread=0.5, doubt=0.3, even_share=0.2, num_distinct=30
    )
    of_wall = replace(made_hypothesis(8.0, x=-9.0, walls=True), evidence=evidence)
    precise, imprecise = (
        _answered(replace(of_wall, evidence=replace(evidence, doubt=doubt))) for doubt in (0.3, 3.0)
    )
    assert isinstance(precise, Localization)
    assert precise.probability > 0.99
    assert isinstance(imprecise, NotLocalized)
    assert imprecise.reason == "imprecise"
    assert imprecise.detail.startswith("in the map, but where is known to")


# no probable hypothesis


def test_improbable_hypotheses_give_no_pose():
    result = _answered(made_hypothesis(-2.0, x=4.0), made_hypothesis(-0.5, x=-9.0, walls=True))
    assert isinstance(result, NotLocalized)
    assert result.reason == "not_in_map"
    assert result.alternatives == ()


def test_without_a_hypothesis_there_is_none_to_name():
    result = _answered()
    assert isinstance(result, NotLocalized)
    assert (result.reason, result.candidates, result.alternatives) == (
        "too_few_matches",
        CANDIDATES,
        (),
    )
    assert believed([]).best is None


def test_a_stopped_search_is_reported():
    imprecise = replace(
        made_hypothesis(-1.0),
        evidence=Evidence(150, 90, 300, 1700, 20, spread=0.8, doubt=40.0, even_share=0.15),
    )
    alike = [made_hypothesis(4.0), made_hypothesis(4.0, x=9.0)]
    for hypotheses in ([], [made_hypothesis(-2.0)], [imprecise], alike):
        search = believed(hypotheses)
        search.is_stopped = True
        result = lead(search).result
        assert isinstance(result, NotLocalized)
        assert "time was up" in result.detail


def test_the_conditions_of_a_reported_pose_can_be_set():
    strict = LocalizerConfig(evidence=EvidenceConfig(min_probability=0.95))
    for log_odds, is_answer in ((2.0, False), (4.0, True)):
        result = lead(believed([made_hypothesis(log_odds)], strict)).result
        assert isinstance(result, Localization) is is_answer


# when the search ends


def test_a_search_is_settled_if_its_pose_is_clear_without_a_rival():
    clear = made_hypothesis(8.0)
    assert believed([clear]).is_settled
    assert believed([clear, made_hypothesis(-5.0, x=9.0, even_share=0.01)]).is_settled
    assert not believed([clear, made_hypothesis(7.0, x=9.0)]).is_settled
    assert not believed([made_hypothesis(2.0)]).is_settled
    assert not believed([]).is_settled
