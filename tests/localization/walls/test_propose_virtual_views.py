"""Check that virtual views localize images in reverse direction along a corridor, and
no other images."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from built_corridor import (
    WIDE,
    back,
    built_corridor,
    corridor,
    corridor_of_two_kinds,
    is_by_walls,
    is_pose,
    is_right,
    seen_ahead,
    seen_on_the_way_back,
)
from tiny_world import path_pose, render, room
from topoloc.features.feature_types import (
    SURF,
)
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.belief import Hypothesis
from topoloc.localization.config import VirtualViewSearchConfig
from topoloc.localization.feature_map import FeatureMap
from topoloc.localization.fitted_weights import WallStop, load_fitted_weights
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.query import Deadline, Query, QueryImage, StageClock
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Search, verify
from topoloc.localization.walls import (
    propose_virtual_views as propose_walls_module,
    virtual_view_matching,
)
from topoloc.localization.walls.propose_virtual_views import Comparison, propose_virtual_views
from topoloc.localization.walls.virtual_view_matching import VirtualViewSearch
from topoloc.mapping.topomap import TopoMetricMap, VirtualNodes

NO_WALLS = LocalizerConfig(walls=VirtualViewSearchConfig(num_places=0))
DISTORTED = Camera("OPENCV", 560, 400, (260.0, 262.0, 283.0, 197.0, -0.12, 0.02, 0.0005, -0.0003))


@pytest.fixture(scope="module")
def localizer() -> Localizer:
    return Localizer(built_corridor())


@cache
def _found_on_the_way_back() -> list[tuple[Localization | NotLocalized, Rigid3]]:
    localizer = Localizer(built_corridor())
    return [(localizer.localize(picture, WIDE), truth) for picture, truth in seen_on_the_way_back()]


def test_the_reverse_direction_is_localized_by_virtual_views():
    assert all(is_right(result, truth) for result, truth in _found_on_the_way_back())
    without = Localizer(built_corridor(), NO_WALLS)
    answers = [
        (without.localize(picture, WIDE), truth) for picture, truth in seen_on_the_way_back()
    ]
    answered = [
        is_right(result, truth) for result, truth in answers if isinstance(result, Localization)
    ]
    assert len(answered) < len(answers)  # by nodes that show a part of the view
    assert all(answered)


def test_a_pose_of_virtual_views_contains_its_evidence(localizer: Localizer):
    topomap = localizer.topomap
    assert topomap.sides is not None
    with_sides = {summary.name for summary in topomap.sides.summaries}
    by_walls = [
        (result, truth) for result, truth in _found_on_the_way_back() if is_by_walls(result)
    ]
    assert len(by_walls) >= 3
    for result, truth in by_walls:
        assert isinstance(result, Localization)
        assert 20 <= result.num_inliers <= result.num_matches
        assert 0.5 <= result.probability <= 1.0
        node = topomap.summaries[
            result.node_id
        ]  # a mapping image of the same wall from the other direction
        assert node.name in with_sides
        assert 2.0 < truth.translation[1] - node.world_from_cam.translation[1] < 7.5
        assert len(result.candidates) == localizer.config.num_candidates
        assert result.times_ms["walls"] > 0.0
        assert (
            sum(ms for stage, ms in result.times_ms.items() if stage != "total")
            <= result.times_ms["total"]
        )
        # the covariance covers the error, and would not cover a wrong corridor's length
        assert np.linalg.eigvalsh(result.covariance).min() > 0.0
        xi = (result.world_from_cam.inverse() @ truth).log()
        assert float(xi @ np.linalg.solve(result.camera_covariance, xi)) < 30.0
        assert np.sqrt(np.linalg.eigvalsh(result.camera_covariance[:3, :3])[-1]) < 0.3


def test_the_matched_points_are_returned(localizer: Localizer):
    """Streams track the matched points. Each is a point of the virtual views, at its
    pixel in the image."""
    picture, truth = seen_on_the_way_back()[2]
    result, named = localizer.localize_query(QueryImage(picture, WIDE))
    assert isinstance(result, Localization)
    ((_, seen),) = named
    assert len(seen.points_img) == result.num_inliers
    offsets = np.linalg.norm(
        WIDE.img_from_cam(truth.inverse().apply(seen.points_world)) - seen.points_img, axis=1
    )
    assert np.median(offsets) < 3.0


def test_virtual_views_of_a_query_are_made_once_for_all_maps(
    localizer: Localizer, monkeypatch: pytest.MonkeyPatch
):
    extracted = list[tuple[int, ...]]()
    extract = virtual_view_matching.extract_from_normalized
    monkeypatch.setattr(
        virtual_view_matching,
        "extract_from_normalized",
        lambda grey, config: extracted.append(grey.shape) or extract(grey, config),
    )
    image, _ = seen_on_the_way_back()[2]
    picture = QueryImage(image, WIDE)
    first, second = (localizer.localize_query(picture)[0] for _ in range(2))
    assert isinstance(first, Localization)
    assert isinstance(second, Localization)
    assert np.array_equal(first.world_from_cam.matrix(), second.world_from_cam.matrix())
    assert len(extracted) == 2  # to the left and to the right


def test_a_distorted_camera_is_localized_in_reverse_direction(localizer: Localizer):
    truth = back(5.2, x=0.1, yaw=0.04)
    picture, _ = render(corridor(), truth, DISTORTED, noise_seed=3)
    assert is_right(localizer.localize(picture, DISTORTED), truth)


def test_images_in_the_mapped_direction_have_the_result_without_virtual_views(localizer: Localizer):
    without = Localizer(built_corridor(), NO_WALLS)
    for picture, _ in seen_ahead():
        one, other = localizer.localize(picture, WIDE), without.localize(picture, WIDE)
        assert isinstance(one, Localization)
        assert isinstance(other, Localization)
        np.testing.assert_array_equal(one.world_from_cam.matrix(), other.world_from_cam.matrix())
        np.testing.assert_array_equal(one.covariance, other.covariance)
        assert one.probability == other.probability
        assert "walls" not in one.times_ms  # nor did they wait


def _elsewhere() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    pictures = {"noise": rng.integers(0, 256, (WIDE.height, WIDE.width), dtype=np.uint8)}
    pictures["blank"] = np.full((WIDE.height, WIDE.width), 120, np.uint8)
    pictures["half blank"] = np.where(
        np.arange(WIDE.width) < 240, pictures["noise"], pictures["blank"]
    )
    pictures |= {f"room {k}": render(room(), path_pose(k), WIDE)[0] for k in (1, 9)}
    return pictures | {
        f"another corridor {k}": picture
        for k, (picture, _) in enumerate(seen_on_the_way_back(seed=5)[::2])
    }


def test_out_of_map_images_are_refused(localizer: Localizer):
    answered = [
        name
        for name, picture in _elsewhere().items()
        if isinstance(localizer.localize(picture, WIDE), Localization)
    ]
    assert answered == []


def test_a_mirrored_wall_is_refused(localizer: Localizer):
    for picture, _ in seen_on_the_way_back()[::3]:
        assert isinstance(
            localizer.localize(np.ascontiguousarray(picture[:, ::-1]), WIDE), NotLocalized
        )


def test_an_unknown_or_narrow_camera_gets_no_pose_of_virtual_views(localizer: Localizer):
    picture, truth = seen_on_the_way_back()[0]
    assert "walls" not in localizer.localize(picture, None).times_ms
    narrow = Camera.pinhole(480, 320, 900.0, 900.0, 239.5, 159.5)
    assert isinstance(
        localizer.localize(render(corridor(), truth, narrow)[0], narrow), NotLocalized
    )


def _twice(topomap: TopoMetricMap, apart: float) -> TopoMetricMap:
    """Return a map with a second copy of its virtual views, `apart` metres farther along."""
    sides = topomap.sides
    assert sides is not None
    moved = Rigid3(np.eye(3), np.array([0.0, apart, 0.0]))
    count, (model,) = len(sides.nodes), sides.coarse_models.values()
    copies = [
        replace(
            node,
            summary=replace(
                node.summary, node_id=count + k, world_from_cam=moved @ node.summary.world_from_cam
            ),
        )
        for k, node in enumerate(sides.nodes)
    ]
    nodes, ids = [*sides.nodes, *copies], model.arrays["node_ids"]
    arrays = dict(model.arrays) | {
        "vectors": np.concatenate([model.arrays["vectors"]] * 2),
        "node_ids": np.concatenate([ids, ids + count]).astype(ids.dtype),
        "centres": np.concatenate(
            [model.arrays["centres"], model.arrays["centres"] + moved.translation]
        ),
    }
    models = {model.name: replace(model, arrays=arrays)}
    return replace(
        topomap, sides=VirtualNodes([node.summary for node in nodes], nodes, models, sides.kind)
    )


def test_repeated_virtual_views_give_no_pose():
    localizer = Localizer(_twice(built_corridor(), apart=60.0))
    results = [
        (localizer.localize(picture, WIDE), truth) for picture, truth in seen_on_the_way_back()[::2]
    ]
    assert not any(is_by_walls(result) for result, _ in results)
    assert all(
        is_right(result, truth) for result, truth in results if isinstance(result, Localization)
    )  # of viewpoints


def _by_the_walls(
    topomap: TopoMetricMap, picture: np.ndarray, config: VirtualViewSearchConfig | None = None
) -> list[Hypothesis]:
    """Return the hypotheses of virtual views alone, the likeliest first."""
    search = _search(topomap, picture, config)
    for proposal in propose_virtual_views(search):
        verify(proposal)
    return list(search.belief.hypotheses)


def _search(
    topomap: TopoMetricMap, picture: np.ndarray, config: VirtualViewSearchConfig | None = None
) -> Search:
    feature_map = FeatureMap(topomap)
    resolved = LocalizerConfig(walls=config or VirtualViewSearchConfig()).for_feature_type(SURF)
    return Search(
        Query(picture, WIDE, 1.0, feature_map.feature_config),
        feature_map,
        resolved,
        load_fitted_weights("surf"),
        correlated_error_share=0.1,
    )


def test_an_inexact_place_is_tried_again_from_its_pose():
    picture, truth = seen_on_the_way_back()[2]
    search = _search(built_corridor(), picture)
    assert search.map.walls is not None
    walls = VirtualViewSearch.around(search, search.map.walls)
    away = Rigid3(truth.rotation, truth.translation + np.array([0.0, 2.0, 0.0]))
    from_there = Comparison.at_place(walls, away).match_all()
    from_here = Comparison.at_place(walls, truth).match_all()
    assert from_there is not None
    assert from_here is not None
    again = propose_walls_module._compare_again(from_there)
    assert from_there.num_agreeing < again.num_agreeing
    assert again.num_agreeing > 0.7 * from_here.num_agreeing
    assert propose_walls_module._compare_again(again).num_agreeing >= again.num_agreeing


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("num_retrieved", [0, 10])
def test_nearest_parts_are_matched_before_whole_views_unless_nodes_agree(
    monkeypatch: pytest.MonkeyPatch, seed: int, num_retrieved: int
):
    tangents, extract = list[float](), virtual_view_matching._extract_view_features

    def record(*arguments: Any) -> Features:
        tangents.append(arguments[-1])
        return extract(*arguments)

    monkeypatch.setattr(virtual_view_matching, "_extract_view_features", record)
    query_image = QueryImage(seen_on_the_way_back(seed)[0][0], WIDE)
    opened = Localizer(corridor_of_two_kinds()).context
    search = opened.searches(query_image, StageClock(), Deadline())[-1]
    monkeypatch.setattr(Search, "num_retrieved", num_retrieved)
    assert bool(list(propose_virtual_views(search))) == (seed == 0)
    near = search.weights.walls.stop.near_tangent
    nearest = [] if num_retrieved else [near, near]
    whole = [math.inf, math.inf] if num_retrieved or seed == 0 else []
    assert tangents == nearest + whole


def test_places_with_far_fewer_matches_are_skipped_beside_a_clear_pose(
    monkeypatch: pytest.MonkeyPatch,
):
    search, looked = _search(built_corridor(), seen_on_the_way_back()[0][0]), list[int]()
    look_closer = propose_walls_module._look_closer

    def record(*arguments: Any) -> Any:
        looked.append(arguments[0].num_strong)
        return look_closer(*arguments)

    monkeypatch.setattr(propose_walls_module, "_look_closer", record)
    stop = WallStop(num_strong=320)
    walls = structs.replace(search.weights.walls, stop=stop)
    search.weights = replace(search.weights, walls=walls)
    for proposal in propose_virtual_views(search):
        verify(proposal)
    assert search.is_clear
    assert search.map.walls is not None
    assert len(VirtualViewSearch.around(search, search.map.walls).places) > 1
    assert min(looked) >= 0.5 * max(looked) - 1


def test_poses_in_the_direction_of_nodes_are_left_to_the_nodes(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(VirtualViewSearchConfig, "min_distance", 0.0)
    picture, truth = seen_ahead()[1]
    assert not any(
        is_pose(one.world_from_cam, truth) for one in _by_the_walls(built_corridor(), picture)
    )
    monkeypatch.undo()
    picture, truth = seen_on_the_way_back()[2]
    assert is_pose(_by_the_walls(built_corridor(), picture)[0].world_from_cam, truth)
    monkeypatch.setattr(VirtualViewSearchConfig, "min_distance", 1e3)
    assert _by_the_walls(built_corridor(), picture) == []


def test_repeated_virtual_views_have_lower_odds():
    """Equal points are no evidence for one of the two places, and each place is proposed once."""
    picture, truth = seen_on_the_way_back()[2]
    once, twice = (
        _by_the_walls(m, picture) for m in (built_corridor(), _twice(built_corridor(), apart=60.0))
    )
    assert is_pose(once[0].world_from_cam, truth)
    assert len(twice) >= 2
    assert not any(hypothesis.evidence.is_of_nodes for hypothesis in (*once, *twice))
    assert once[0].log_odds > twice[0].log_odds + 0.5
    assert twice[0].log_odds >= twice[1].log_odds
    ways = [hypothesis.world_from_cam.translation[1] for hypothesis in twice]
    assert sorted(round((way - truth.translation[1]) / 60.0) for way in ways[:2]) == [0, 1]
