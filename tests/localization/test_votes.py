"""Test places voted by single features, if the coarse localizer ranks other places first."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from built_room import built_room, unseen_views
from doubled_room import twice
from tiny_world import CAMERA
from topoloc.features.features import Features
from topoloc.geometry.alignment import translation_error
from topoloc.localization import decision, map_query, propose
from topoloc.localization.config import LocalizerConfig, NodeViewpointsConfig
from topoloc.localization.exact.pixel_evidence import weigh_pixels
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Proposal, Search, Trace
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import Row
from topoloc.retrieval.coarse import Image, NodeScore


@pytest.fixture(scope="module")
def room(tiny_recording: Path) -> TopoMetricMap:
    """Return a map of two rooms with few common points."""
    return twice(built_room(tiny_recording), share_alike=0.02)


@pytest.fixture
def any_agreement(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use votes even if the retrieved nodes agree by chance."""
    monkeypatch.setattr(LocalizerConfig, "num_chance_inliers", 0)


class OtherRoomFirst:
    """Rank the nodes of the second room before those of the first."""

    def __init__(self, topomap: TopoMetricMap) -> None:
        self._num_nodes = len(topomap.nodes)

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        rows = reversed(range(self._num_nodes))
        return [NodeScore(Row(row), float(row + 1)) for row in rows][:num_candidates]


@pytest.mark.usefixtures("any_agreement")
def test_votes_find_the_place_when_other_nodes_rank_first(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch
):
    config = LocalizerConfig(viewpoints=NodeViewpointsConfig(num_nodes=0))
    localizer, trace = Localizer(room, config, OtherRoomFirst(room)), Trace()
    views = unseen_views()
    for picture, truth in views:
        found = localizer.localize(picture, CAMERA, trace=trace)
        assert isinstance(found, Localization)
        assert translation_error(found.world_from_cam, truth) < 0.05
    assert "votes" in {one.source for one in trace.tried}
    monkeypatch.setattr(map_query, "propose_voted_places", lambda _: iter(()))
    without_pixels = tuple(one for one in decision.CHECKS if one is not weigh_pixels)
    monkeypatch.setattr(decision, "CHECKS", without_pixels)  # they recognise a pose with low odds
    lost = [localizer.localize(picture, CAMERA) for picture, _ in views]
    assert sum(isinstance(one, NotLocalized) for one in lost) >= len(views) // 2


@pytest.mark.usefixtures("any_agreement")
def test_votes_are_few_for_out_of_map_images_and_excluded_nodes_have_none(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch
):
    counted, count_votes = list[tuple[list[int], float]](), propose.count_votes

    def noting(search: Search):
        found = count_votes(search)
        counted.append(([search.map.node_ids[row] for row in found[0]], found[2].max()))
        return found

    monkeypatch.setattr(propose, "count_votes", noting)
    localizer = Localizer(room, coarse=OtherRoomFirst(room))
    for picture, _ in unseen_views():
        localizer.localize(picture, CAMERA)
    here = [most for _, most in counted]
    counted.clear()
    for picture, _ in unseen_views(seed=1, step=4.0):
        assert isinstance(localizer.localize(picture, CAMERA), NotLocalized)
    assert max(most for _, most in counted) < min(here)
    counted.clear()
    localizer.without([0, 1]).localize(unseen_views()[0][0], CAMERA)
    assert counted
    assert not {0, 1} & {*counted[0][0]}


def test_a_blank_image_has_no_place(room: TopoMetricMap):
    blank = np.full((240, 320), 128, np.uint8)
    assert isinstance(Localizer(room).localize(blank, CAMERA), NotLocalized)


def test_votes_come_last_if_the_retrieved_nodes_agree_by_chance(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch
):
    order, count_votes = list[str](), propose.count_votes

    def count_walls(search: Search) -> Iterator[Proposal]:
        order.append("virtual views")
        yield from ()

    monkeypatch.setattr(map_query, "propose_virtual_views", count_walls)
    monkeypatch.setattr(
        propose, "count_votes", lambda search: order.append("votes") or count_votes(search)
    )
    for picture, _ in unseen_views(seed=1, step=4.0):
        order.clear()
        assert isinstance(Localizer(room).localize(picture, CAMERA), NotLocalized)
        assert order == ["virtual views", "votes"]


@pytest.mark.parametrize("is_by_chance", [True, False])
def test_votes_find_the_place_if_retrieval_agrees_by_chance(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch, is_by_chance: bool
):
    monkeypatch.setattr(LocalizerConfig, "num_chance_inliers", 7 if is_by_chance else 0)
    monkeypatch.setattr(map_query, "propose_node_viewpoints", lambda _: iter(()))
    localizer, trace = Localizer(room, coarse=OtherRoomFirst(room)), Trace()
    for picture, truth in unseen_views():
        found = localizer.localize(picture, CAMERA, trace=trace)
        assert isinstance(found, Localization)
        assert translation_error(found.world_from_cam, truth) < 0.05
    assert "votes" in {one.source for one in trace.tried}
