"""Test the order of the proposals for one image, and when they end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from built_corridor import WIDE, corridor_of_two_kinds
from built_room import unseen_views
from tiny_world import CAMERA
from topoloc.errors import MapError
from topoloc.localization import map_query, propose
from topoloc.localization.fitted_weights import NodeStop
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_query import MapQuery, verify_all
from topoloc.localization.propose import min_rival_inliers, propose_quick
from topoloc.localization.query import Deadline, QueryImage, StageClock
from topoloc.localization.refine import find_best_case
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Search, Trace
from topoloc.mapping.topomap import TopoMetricMap

FOREVER = Deadline()


@pytest.fixture(scope="module")
def localizer(room_map: Path) -> Iterator[Localizer]:
    with TopoMetricMap.load(room_map) as topomap:
        yield Localizer(topomap)


def _searches(
    localizer: Localizer, image: np.ndarray, deadline: Deadline = FOREVER
) -> list[Search]:
    return localizer.context.searches(QueryImage(image, CAMERA), StageClock(), deadline)


def test_an_exhaustive_search_continues_from_the_coarse_one(
    localizer: Localizer, monkeypatch: pytest.MonkeyPatch
):
    image = unseen_views()[0][0]
    fast = Localizer(localizer.topomap, LocalizerConfig(exactness="fast"))
    at_once = fast.localize(image, CAMERA)
    query = MapQuery(localizer.context, _searches(localizer, image))
    num_matched, matcher = list[int](), propose.Matcher
    monkeypatch.setattr(propose, "Matcher", lambda *args: num_matched.append(1) or matcher(*args))
    coarse = query.search_first().result
    assert num_matched == [1]
    result = query.search_all().result
    assert num_matched == [1], "retrieval is not repeated"
    assert isinstance(coarse, Localization)
    assert isinstance(at_once, Localization)
    assert isinstance(result, Localization)
    assert np.array_equal(result.world_from_cam.matrix(), at_once.world_from_cam.matrix())
    assert result.probability == at_once.probability


def test_after_the_deadline_one_proposal_is_finished(localizer: Localizer):
    (search,) = searches = _searches(localizer, unseen_views(seed=1)[1][0], deadline=Deadline(0.0))
    search.trace = Trace()
    MapQuery(localizer.context, searches).search_all()
    assert [one.source for one in search.trace.tried] == ["retrieval"]
    assert search.is_stopped


def test_a_search_that_another_thread_stops_tries_no_further_proposal(localizer: Localizer):
    image, deadline = np.roll(unseen_views()[0][0], 150, axis=1), Deadline()
    whole, stopped = Trace(), Trace()
    localizer.localize(image, CAMERA, max_ms=deadline, trace=whole)
    assert len(whole.tried) > 1
    deadline.stop.set()
    localizer.localize(image, CAMERA, max_ms=deadline, trace=stopped)
    assert len(stopped.tried) == 1


def test_a_map_that_cannot_be_read_ends_the_search(
    localizer: Localizer, monkeypatch: pytest.MonkeyPatch
):
    searches = _searches(localizer, unseen_views()[0][0])

    def cut_off(*_: object) -> None:
        raise MapError("cut off")

    monkeypatch.setattr(searches[0].map, "local_map", cut_off)
    with pytest.raises(MapError, match="cut off"):
        MapQuery(localizer.context, searches).search_all()


def test_the_best_case_is_no_less_than_the_evidence_found(localizer: Localizer):
    weights = localizer.context.first.weights
    for image, _ in unseen_views()[::4]:
        (search,) = _searches(localizer, image)
        quick = propose_quick(search, min_rival_inliers(search))
        assert quick is not None
        best, result = find_best_case(quick), localizer.localize(image, CAMERA)
        assert isinstance(result, Localization)
        assert best is not None
        assert result.evidence is not None
        assert best.log_odds >= weights.log_odds(result.evidence)


def test_an_image_of_another_place_has_no_quick_proposal(localizer: Localizer):
    (search,) = _searches(localizer, unseen_views(seed=1)[1][0])
    assert propose_quick(search, 20.0) is None


@pytest.mark.parametrize("min_inliers", [0, 20])
def test_nodes_are_given_up_if_retrieval_finds_too_little(
    localizer: Localizer, monkeypatch: pytest.MonkeyPatch, min_inliers: int
):
    (search,) = _searches(localizer, unseen_views(seed=1)[1][0])
    search.weights = replace(search.weights, stop=NodeStop(min_inliers))
    asked, match = list[int](), propose.match_predicted
    monkeypatch.setattr(propose, "match_predicted", lambda *a: asked.append(1) or match(*a))
    result = MapQuery(localizer.context, [search]).search_all().result
    assert isinstance(result, NotLocalized)
    assert search.num_retrieved < 20
    assert bool(asked) == (min_inliers == 0)


def test_a_probable_pose_keeps_the_search_of_nodes_open(localizer: Localizer):
    (search,) = _searches(localizer, unseen_views()[0][0])
    search.weights = replace(search.weights, stop=NodeStop(10_000))
    first = propose.propose_first(search, None)
    assert search.is_hopeless
    verify_all(search, [first])
    assert search.best is not None
    assert search.best.probability > 0.5
    assert not search.is_hopeless


@pytest.mark.parametrize("continues", [True, False])
def test_earlier_feature_types_are_continued_unless_the_last_one_needs_none(
    monkeypatch: pytest.MonkeyPatch, continues: bool
):
    localizer = Localizer(corridor_of_two_kinds())
    blank = np.zeros((WIDE.height, WIDE.width), np.uint8)
    searches = localizer.context.searches(QueryImage(blank, WIDE), StageClock(), FOREVER)
    first, last = searches
    last.weights = replace(last.weights, stop=NodeStop(continues_earlier=continues))
    asked = list[Search]()
    monkeypatch.setattr(map_query, "propose_more", lambda one: asked.append(one) or [])
    MapQuery(localizer.context, searches).search_all()
    assert asked == ([last, first] if continues else [last])
