"""Two places that look alike: the answer is "ambiguous" where nothing tells them apart, and the right one where something does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from topoloc.localization.rivals import RivalsConfig

from built_room import built_room, unseen_views
from tiny_world import CAMERA
from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.result import Localization, NotLocalized
from topoloc.map.topomap import TopoMetricMap, TopoNode
from topoloc.places.vlad import SurfVlad

ELSEWHERE = Rigid3(exp_so3(np.array([0.0, 0.0, 1.0])), np.array([40.0, -15.0, 0.0]))
"""Where the second room stands, in the world of the first."""


def _moved(node: TopoNode, node_id: int) -> TopoNode:
    summary = node.summary
    return replace(node, summary=replace(summary, node_id=node_id, world_from_cam=ELSEWHERE @ summary.world_from_cam))


def _twice(topomap: TopoMetricMap, share_alike: float = 1.0) -> TopoMetricMap:
    """A map that holds the room a second time, elsewhere; only this share of its points looks the same there."""
    num_nodes, rng = len(topomap.nodes), np.random.default_rng(0)
    copies = []
    for node in topomap.nodes:
        descriptors = node.features.descriptors.copy()
        other = rng.random(len(descriptors)) >= share_alike
        descriptors[other] = rng.normal(size=(np.count_nonzero(other), descriptors.shape[1]))
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        changed = replace(node, features=replace(node.features, descriptors=descriptors))
        copies.append(_moved(changed, num_nodes + node.summary.node_id))
    nodes = [*topomap.nodes, *copies]
    model = topomap.coarse_models[SurfVlad.name]
    ids = model.arrays["node_ids"]
    arrays = dict(model.arrays) | {
        "vectors": np.concatenate([model.arrays["vectors"]] * 2),
        "node_ids": np.concatenate([ids, ids + num_nodes]).astype(ids.dtype),
    }
    coarse = {SurfVlad.name: replace(model, arrays=arrays)}
    return replace(topomap, nodes=nodes, summaries=[node.summary for node in nodes], coarse_models=coarse, edges=[])


@pytest.fixture(scope="module")
def room(tiny_recording: Path) -> TopoMetricMap:
    return built_room(tiny_recording)


def test_a_place_that_is_in_the_map_twice_is_ambiguous(room: TopoMetricMap):
    localizer = Localizer(_twice(room))
    results = [localizer.localize(picture, CAMERA) for picture, _ in unseen_views()]
    assert not any(isinstance(result, Localization) for result in results)
    reasons = [result.reason for result in results if isinstance(result, NotLocalized)]
    assert reasons.count("ambiguous") >= 0.9 * len(reasons)


def test_unasked_rivals_leave_the_second_place_unnoticed_or_the_picture_without_an_answer(room: TopoMetricMap):
    """What the step is for: without it the reason is a wrong one."""
    localizer = Localizer(_twice(room), LocalizerConfig(rivals=RivalsConfig(max_groups=0)))
    results = [localizer.localize(picture, CAMERA) for picture, _ in unseen_views()]
    assert not any(isinstance(result, NotLocalized) and result.reason == "ambiguous" for result in results)


def test_a_place_that_is_only_partly_like_another_is_told_apart(room: TopoMetricMap):
    localizer = Localizer(_twice(room, share_alike=0.2))
    found = [(localizer.localize(picture, CAMERA), truth) for picture, truth in unseen_views()]
    right = [isinstance(r, Localization) and translation_error(r.world_from_cam, truth) < 0.05 for r, truth in found]
    assert np.mean(right) >= 0.8
    assert not any(isinstance(r, Localization) and translation_error(r.world_from_cam, truth) > 0.5 for r, truth in found)


def test_a_place_that_is_in_the_map_once_has_no_rival(room: TopoMetricMap):
    with_rivals, without = Localizer(room), Localizer(room, LocalizerConfig(rivals=RivalsConfig(max_groups=0)))
    for picture, _ in unseen_views():
        one, other = with_rivals.localize(picture, CAMERA), without.localize(picture, CAMERA)
        assert isinstance(one, Localization)
        assert isinstance(other, Localization)
        np.testing.assert_array_equal(one.world_from_cam.matrix(), other.world_from_cam.matrix())
