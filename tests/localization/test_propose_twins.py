"""An image far from all nodes is compared with other places that show the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from built_room import built_room, unseen_views
from doubled_room import twice
from tiny_world import CAMERA
from topoloc.localization import map_query, propose_twins as twins
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.feature_map import FeatureMap
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import NotLocalized
from topoloc.localization.search import Search, Trace
from topoloc.mapping.topomap import TopoMetricMap

# pooled with its copy, a node's matches would fail the ratio test
ONE_NODE = LocalizerConfig(num_candidates=1)


@pytest.fixture(scope="module")
def room(tiny_recording: Path) -> TopoMetricMap:
    return built_room(tiny_recording)


@pytest.mark.parametrize("is_far", [True, False])
def test_a_pose_far_from_all_nodes_is_compared_with_places_that_show_the_same(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch, is_far: bool
):
    sources = set[str]()
    monkeypatch.setattr(FeatureMap, "remoteness", lambda *_: 2.0 if is_far else 0.5)
    monkeypatch.setattr(Search, "is_clear", False)  # similar places are searched for clear poses
    monkeypatch.setattr(map_query, "propose_more", twins.propose_twins)
    localizer, results = Localizer(twice(room), ONE_NODE), []
    for picture, _ in unseen_views():
        trace = Trace()
        results.append(localizer.localize(picture, CAMERA, trace=trace))
        sources.update(tried.source for tried in trace.tried)
    assert ("look-alikes" in sources) == is_far
    ambiguous = [isinstance(one, NotLocalized) and one.reason == "ambiguous" for one in results]
    assert any(ambiguous) == is_far
