"""Localize single images in a map of a rendered room with exact true poses."""

from __future__ import annotations

import json
import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from built_room import built_room, unseen_views
from tiny_world import CAMERA
from topoloc.errors import EmptyMapError, MapError, QueryError
from topoloc.features.features import Features
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.camera import Camera
from topoloc.localization.belief import Belief
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Trace
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import NodeScore

PICTURE, TRUTH = unseen_views()[2]


@pytest.fixture(scope="module")
def localizer(tiny_recording: Path) -> Localizer:
    return Localizer(built_room(tiny_recording))


def _facts(result: Localization | NotLocalized) -> dict:
    return {key: value for key, value in result.to_json("").items() if key != "times_ms"}


def test_unseen_pictures_of_the_place_are_localized_within_two_centimetres(localizer: Localizer):
    results = [(localizer.localize(picture, CAMERA), truth) for picture, truth in unseen_views()]
    within = [
        isinstance(result, Localization)
        and translation_error(result.world_from_cam, truth) < 0.02
        and rotation_error(result.world_from_cam, truth) < np.deg2rad(0.5)
        for result, truth in results
    ]
    assert np.mean(within) >= 0.95


def test_a_localization_contains_its_evidence(localizer: Localizer):
    result = localizer.localize(PICTURE, CAMERA)
    assert isinstance(result, Localization)
    assert 12 <= result.num_inliers <= result.num_matches
    assert 0.5 < result.probability <= 1.0
    assert (
        len({candidate.node_id for candidate in result.candidates})
        == len(result.candidates)
        == localizer.config.num_candidates
    )
    scores = [candidate.score for candidate in result.candidates]
    assert scores == sorted(scores, reverse=True)
    node = localizer.topomap.summaries[result.node_id].world_from_cam
    assert translation_error(node, TRUTH) < 0.6
    assert result.times_ms.keys() >= {
        "patch_normalization",
        "features",
        "coarse",
        "matching",
        "pnp",
        "total",
    }
    assert (
        sum(ms for stage, ms in result.times_ms.items() if stage != "total")
        <= result.times_ms["total"]
    )


def test_the_covariance_is_one_and_of_the_size_of_the_errors(localizer: Localizer):
    distances = []
    for picture, truth in unseen_views():
        result = localizer.localize(picture, CAMERA)
        assert isinstance(result, Localization)
        np.testing.assert_allclose(result.covariance, result.covariance.T, rtol=1e-9, atol=1e-18)
        assert np.linalg.eigvalsh(result.covariance).min() > 0
        xi = (
            truth @ result.world_from_cam.inverse()
        ).log()  # the left perturbation that leads to the truth
        distances.append(float(xi @ np.linalg.solve(result.covariance, xi)))
    assert 0.02 < np.median(distances) < 30.0  # chi-square of six degrees: median 5.3


def test_the_same_picture_gets_the_same_answer_also_from_a_fresh_localizer(localizer: Localizer):
    first = _facts(localizer.localize(PICTURE, CAMERA))
    assert _facts(localizer.localize(PICTURE, CAMERA)) == first
    assert _facts(Localizer(localizer.topomap).localize(PICTURE, CAMERA)) == first


def test_grey_and_the_same_grey_in_three_channels_get_the_same_answer(localizer: Localizer):
    rgb = np.repeat(PICTURE[:, :, None], 3, axis=2)
    assert _facts(localizer.localize(rgb, CAMERA)) == _facts(localizer.localize(PICTURE, CAMERA))


def test_a_map_from_its_file_answers_as_the_one_in_memory(localizer: Localizer, tmp_path: Path):
    localizer.topomap.save(tmp_path / "room.topo")
    stored = Localizer(TopoMetricMap.load(tmp_path / "room.topo"))
    one, other = localizer.localize(PICTURE, CAMERA), stored.localize(PICTURE, CAMERA)
    assert isinstance(one, Localization)
    assert isinstance(other, Localization)
    assert translation_error(one.world_from_cam, other.world_from_cam) < 0.005


@pytest.mark.parametrize("num_candidates", [1, 100])
def test_any_number_of_candidates(num_candidates: int, localizer: Localizer):
    result = Localizer(localizer.topomap, LocalizerConfig(num_candidates=num_candidates)).localize(
        PICTURE, CAMERA
    )
    assert isinstance(result, Localization)
    assert len(result.candidates) == min(num_candidates, len(localizer.topomap.nodes))
    assert translation_error(result.world_from_cam, TRUTH) < 0.02


@pytest.mark.parametrize(
    "picture",
    [
        np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8),
        np.random.default_rng(1).integers(0, 256, (240, 320, 3), dtype=np.uint8),
        np.zeros((240, 320), np.uint8),
        *(picture for picture, _ in unseen_views(seed=1, step=4.0)),
    ],
    ids=[
        "grey noise",
        "coloured noise",
        "black",
        "other world 0",
        "other world 1",
        "other world 2",
        "other world 3",
    ],
)
def test_out_of_map_images_are_not_localized(picture: np.ndarray, localizer: Localizer):
    result = localizer.localize(picture, CAMERA)
    assert isinstance(result, NotLocalized)
    assert result.reason in ("too_few_matches", "too_few_inliers", "not_in_map")


@pytest.mark.parametrize("size", [(1, 1), (1, 400), (400, 1), (7, 5)], ids=str)
def test_tiny_pictures_are_not_localized(size: tuple[int, int], localizer: Localizer):
    width, height = size
    picture = np.random.default_rng(2).integers(0, 256, (height, width), dtype=np.uint8)
    assert isinstance(
        localizer.localize(picture, Camera.pinhole(width, height, 260.0, 260.0, 0.0, 0.0)),
        NotLocalized,
    )


def test_a_camera_of_another_size_is_an_error(localizer: Localizer):
    with pytest.raises(QueryError, match="the image is 320x240, its camera 640x480"):
        localizer.localize(PICTURE, CAMERA.rescaled(640, 480))


def test_a_map_without_nodes_cannot_be_queried(localizer: Localizer):
    with pytest.raises(EmptyMapError, match="no nodes"):
        Localizer(replace(localizer.topomap, summaries=[]))


class _FromBelow:
    """Rank nodes by their order alone, and count the queries."""

    num_asked = 0

    def rank(self, image: np.ndarray, features: Features, num_candidates: int) -> list[NodeScore]:
        self.num_asked += 1
        return [NodeScore(node_id, -float(node_id)) for node_id in range(num_candidates)]


def test_without_all_nodes_there_is_no_map(localizer: Localizer):
    with pytest.raises(EmptyMapError, match="no node of the map remains"):
        localizer.without(one.node_id for one in localizer.topomap.summaries)
    first, *others = (one.node_id for one in localizer.topomap.summaries)
    last = localizer.without(others)
    assert last.localize(PICTURE, CAMERA).candidates[0].node_id == first
    with pytest.raises(EmptyMapError, match="no node of the map remains"):
        last.without([first])


def test_a_coarse_localizer_of_one_s_own_answers_instead_of_the_map_s(localizer: Localizer):
    own = _FromBelow()
    without = localizer.topomap.with_first_layer(coarse_models={})
    result = Localizer(
        without, LocalizerConfig(num_candidates=2, coarse="netvlad"), coarse=own
    ).localize(PICTURE, CAMERA)
    assert own.num_asked == 1
    assert [candidate.node_id for candidate in result.candidates] == [0, 1]


def test_an_unknown_coarse_localizer_is_an_error_that_lists_all(localizer: Localizer):
    with pytest.raises(MapError, match=r"'netvlad' \(it has: surf-vlad\)"):
        Localizer(localizer.topomap, LocalizerConfig(coarse="netvlad"))
    with pytest.raises(MapError, match="it has: none"):
        Localizer(localizer.topomap.with_first_layer(coarse_models={}))


# time


NOISE = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)


@pytest.mark.parametrize(
    "picture", [*(picture for picture, _ in unseen_views(step=4.0)), NOISE, np.zeros_like(NOISE)]
)
def test_without_time_the_first_hypothesis_or_the_time_limit_is_reported(
    picture: np.ndarray, localizer: Localizer
):
    trace = Trace()
    result = localizer.localize(picture, CAMERA, max_ms=0.0, trace=trace)
    assert [tried.source for tried in trace.tried] == ["retrieval"]
    assert isinstance(result, Localization) or "time was up" in result.detail


def test_a_query_s_own_time_comes_before_that_of_the_settings(localizer: Localizer):
    hurried = Localizer(localizer.topomap, LocalizerConfig(max_ms=0.0))
    results = [
        hurried.localize(NOISE, CAMERA),
        hurried.localize(NOISE, CAMERA, max_ms=1e6),
        localizer.localize(NOISE, CAMERA),
    ]
    assert [
        "time was up" in result.detail for result in results if isinstance(result, NotLocalized)
    ] == [True, False, False]


# the trace


@pytest.mark.parametrize(
    "picture", [PICTURE, (0.05 * PICTURE).astype(np.uint8), NOISE], ids=["here", "dark", "noise"]
)
def test_the_trace_contains_all_proposals_and_explains_the_result(
    picture: np.ndarray, localizer: Localizer
):
    localizer = Localizer(localizer.topomap, LocalizerConfig(exactness="fast"))
    trace, weights, evidence = (
        Trace(),
        localizer.context.first.weights.rivals,
        localizer.config.evidence,
    )
    result = localizer.localize(picture, CAMERA, trace=trace)
    assert trace.tried[0].source == "retrieval"
    assert len(trace.tried[0].first.features) == len(trace.tried[-1].first.features)
    times_ms = [tried.milliseconds for tried in trace.tried]
    assert times_ms == sorted(times_ms)
    assert times_ms[-1] <= result.times_ms["total"]
    belief = Belief()
    for tried in trace.tried:
        if tried.hypothesis is not None:
            assert tried.hypothesis.source == tried.source
            assert tried.hypothesis.fit is tried.refined
            belief = belief.with_hypothesis(tried.hypothesis, evidence, weights)
    best = belief.hypotheses[0] if belief.hypotheses else None
    if isinstance(result, Localization):
        assert best is not None
        np.testing.assert_array_equal(result.world_from_cam.matrix(), best.world_from_cam.matrix())
        assert result.evidence == best.evidence
    else:
        assert (
            best is None
            or best.probability < evidence.min_probability
            or result.reason == "ambiguous"
        )


def test_a_trace_does_not_change_the_result(localizer: Localizer):
    assert _facts(localizer.localize(PICTURE, CAMERA, trace=Trace())) == _facts(
        localizer.localize(PICTURE, CAMERA)
    )


@pytest.mark.parametrize("kind", ["matrix", "tuple", "list", "text", "path"])
def test_a_camera_may_be_given_in_several_forms(localizer: Localizer, kind: str, tmp_path: Path):
    four = CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(CAMERA.to_json()))
    matrix = np.array([[four[0], 0.0, four[2]], [0.0, four[1], four[3]], [0.0, 0.0, 1.0]])
    given = {
        "matrix": matrix,
        "tuple": four,
        "list": list(four),
        "text": ",".join(map(str, four)),
        "path": path,
    }
    by_camera = localizer.localize(PICTURE, CAMERA)
    assert isinstance(by_camera, Localization)
    found = localizer.localize(PICTURE, given[kind])
    assert isinstance(found, Localization)
    assert translation_error(found.world_from_cam, by_camera.world_from_cam) < 1e-9


@pytest.mark.parametrize("given", [(1.0, 2.0), np.eye(4)])
def test_an_invalid_camera_is_named(localizer: Localizer, given: Any):
    with pytest.raises(QueryError, match=r"a 3x3 matrix K, \(fx, fy, cx, cy\) in pixels"):
        localizer.localize(PICTURE, given)


def test_a_localizer_of_a_file_answers_in_another_process(localizer: Localizer, tmp_path: Path):
    localizer.topomap.save(tmp_path / "room.topo")
    of_file = Localizer(tmp_path / "room.topo", LocalizerConfig(num_candidates=2))
    data = pickle.dumps(of_file)
    assert len(data) < 10_000, "the path and the settings, not the map"
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        there = pool.submit(pickle.loads(data).localize, PICTURE, CAMERA).result()
    here = of_file.localize(PICTURE, CAMERA)
    assert isinstance(there, Localization)
    assert isinstance(here, Localization)
    assert there.world_from_cam.to_json() == here.world_from_cam.to_json()
    part = of_file.without([of_file.topomap.summaries[0].node_id])
    with pytest.raises(TypeError, match="cannot be pickled: use one of its file"):
        pickle.dumps(part)
