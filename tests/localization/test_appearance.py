"""Check that the colours of all visible points distinguish two floors of a building."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from made_once import once_a_run
from topoloc.apps.cli import main
from topoloc.demo.recordings import SHIPPED
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.exact.appearance import SWAP_RED_AND_BLUE
from topoloc.localization.exact.templates import small_colours
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Trace
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoFrame, to_grey
from topoloc.recordings.open import open_sequence
from topoloc.tracking.tracker import Tracker
from topoloc.tracking.tracker_state import FloorEvidence


@once_a_run
def built_lab() -> TopoMetricMap:
    """Return a map of every second frame of a part of the demo's lab, of SURF alone."""
    return build_map(open_sequence(f"{SHIPPED / 'map_lap1'}@0:16:2"), BuildConfig(other_kinds=()))


@pytest.fixture(scope="module")
def lab() -> TopoMetricMap:
    return built_lab()


def test_an_uncalibrated_image_is_compared_by_the_estimated_camera(lab: TopoMetricMap):
    localizer = Localizer(lab)
    for frame in _unseen():
        found = localizer.localize(frame.image, None)
        assert isinstance(found, Localization)
        assert found.appearance is not None
        assert found.appearance > 0.99


def _with_look_alikes(lab: TopoMetricMap) -> TopoMetricMap:
    return replace(lab, config=replace(lab.config, look_alike_floors=True))


def _unseen() -> list[StereoFrame]:
    sequence = open_sequence(f"{SHIPPED / 'map_lap1'}@1:16:2")
    return [sequence[index] for index in range(len(sequence))]


def _painted(image: np.ndarray) -> np.ndarray:
    """Return the image with the colours of each square exchanged and its brightness kept."""
    painted = image.copy()
    for number, (row, column) in enumerate(np.ndindex(6, 10)):
        cell = np.s_[row * 80 : row * 80 + 80, column * 80 : column * 80 + 80]
        painted[cell] = np.roll(image[cell], number % 3, axis=2)
    grey, of_painted = (to_grey(one).astype(float)[..., None] for one in (image, painted))
    return np.clip(painted * (grey + 1.0) / (of_painted + 1.0), 0, 255).astype(np.uint8)


def _ask(lab: TopoMetricMap, images: list[np.ndarray]) -> list[Localization | NotLocalized]:
    localizer, camera = Localizer(lab), _unseen()[0].camera
    return [localizer.localize(image, camera) for image in images]


def test_an_image_of_the_mapped_colours_keeps_its_probability_and_names_its_appearance(
    lab: TopoMetricMap,
):
    for found in _ask(lab, [frame.image for frame in _unseen()[:3]]):
        assert isinstance(found, Localization)
        assert found.appearance is not None
        assert found.appearance > 0.99
        assert found.probability > 0.99
        line = json.dumps(found.to_json("day.jpg"))
        assert Localization.from_json(line).appearance == found.appearance


def test_a_painted_room_is_less_similar_and_is_localized_if_the_pose_is_clear(
    lab: TopoMetricMap,
):
    image, half = _unseen()[0].image, _unseen()[0].image.copy()
    middle = image.shape[1] // 2
    half[:, middle:] = _painted(image)[:, middle:]
    same, partly, all_over = (
        found.appearance for found in _ask(lab, [image, half, _painted(image)])
    )
    assert None not in (same, partly, all_over)
    assert (all_over or 0.0) < (partly or 0.0) < (same or 0.0)
    assert all(isinstance(found, Localization) for found in _ask(lab, [half, _painted(image)]))


def test_a_map_with_similar_floors_refuses_other_colours_and_grey_images(
    lab: TopoMetricMap,
):
    image = _unseen()[0].image
    right, painted, grey = _ask(_with_look_alikes(lab), [image, _painted(image), to_grey(image)])
    assert isinstance(right, Localization)
    assert right.probability > 0.9
    assert isinstance(painted, NotLocalized)
    assert painted.reason == "not_in_map"
    assert "another floor" in painted.detail
    assert painted.appearance is not None
    assert painted.appearance < 0.5
    assert NotLocalized.from_json(painted.to_json("x")).appearance == painted.appearance
    assert isinstance(grey, NotLocalized)
    assert "without colours in view" in grey.detail
    assert isinstance(_ask(lab, [to_grey(image)])[0], Localization)


def test_a_stream_in_a_map_with_similar_floors_is_certain_after_three_places(lab: TopoMetricMap):
    frames = _unseen()
    for topomap, num_waiting in ((lab, 0), (_with_look_alikes(lab), 4)):
        tracker, states = Tracker(Localizer(topomap)), list[str]()
        for number, frame in enumerate(frames):
            answer = tracker.process(frame.image, frame.camera, number * 2_000_000_000)
            states.append(answer.state)
        tracker.close()
        assert states[:num_waiting] == ["ambiguous"] * num_waiting  # the first 1.4 m
        assert states[num_waiting:] == ["localized"] * (len(frames) - num_waiting)


def test_the_floor_is_judged_by_places_and_not_by_images(lab: TopoMetricMap):
    first, *others = _ask(lab, [frame.image for frame in _unseen()[::2]])
    assert isinstance(first, Localization)
    evidence, usual = FloorEvidence(has_look_alikes=True), FloorEvidence(has_look_alikes=False)
    for _ in range(5):
        evidence.add(first)
        usual.add(replace(first, appearance=0.1))
    assert not evidence.is_sure
    assert usual.is_sure
    for other in others:
        evidence.add(other)
        usual.add(replace(other, appearance=0.1))
    assert evidence.is_sure
    assert not usual.is_sure


def test_weak_colours_settle_the_floor_at_five_places(lab: TopoMetricMap):
    (found,) = _ask(lab, [_unseen()[0].image])
    assert isinstance(found, Localization)
    states = list[bool]()
    for log_odds in (0.9, 1.1):
        evidence = FloorEvidence(has_look_alikes=True)
        for number in range(5):
            place = Rigid3(found.world_from_cam.rotation, np.array([1.0 * number, 0.0, 0.0]))
            appearance = 1.0 / (1.0 + np.exp(-log_odds))
            evidence.add(replace(found, world_from_cam=place, appearance=appearance))
            states.append(evidence.is_sure)
    assert states == [False] * 9 + [True]


def test_the_setting_is_an_option_of_build_is_shown_and_changed_later(
    lab: TopoMetricMap, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    strict, plain = str(tmp_path / "strict.topo"), str(tmp_path / "plain.topo")
    options = ["--features", "surf", "--look-alike-floors"]
    assert main(["build", f"{SHIPPED / 'map_lap1'}@0:4:2", strict, *options]) == 0
    lab.save(plain)
    shown = list[bool]()
    for path, change in ((strict, None), (plain, None), (plain, "yes"), (plain, "no")):
        if change is not None:
            capsys.readouterr()
            assert main(["update", path, "--look-alike-floors", change]) == 0
            assert "look alike" in capsys.readouterr().out
        capsys.readouterr()
        assert main(["info", path]) == 0
        (line,) = (one for one in capsys.readouterr().out.splitlines() if "look-alike" in one)
        with TopoMetricMap.load(path) as topomap:
            shown.append("do not look alike" not in line)
            assert topomap.config.look_alike_floors == shown[-1]
    assert shown == [True, False, True, False]
    with TopoMetricMap.load(plain) as topomap:
        assert topomap.edits[-1].name == "look-alike floors: no"
    assert main(["undo", plain]) == 0
    with TopoMetricMap.load(plain) as topomap:
        assert topomap.config.look_alike_floors


def test_a_map_of_grey_images_cannot_distinguish_floors_and_stays(
    room_map: Path, tmp_path: Path, complaint: Callable[..., str]
):
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    said = complaint("update", path, "--look-alike-floors", "yes")
    assert f"map {path} has no colours" in said
    assert f"`topoloc update {path} SEQ`" in said
    assert path.read_bytes() == room_map.read_bytes()


def test_swapped_colours_follow_from_those_of_the_image():
    image = np.random.default_rng(0).integers(0, 250, (60, 80, 3), np.uint8)
    found, swapped = small_colours(image), small_colours(image[:, :, ::-1].copy())
    assert found is not None
    assert swapped is not None
    assert np.allclose(found @ SWAP_RED_AND_BLUE, swapped, atol=1e-5)


def _tinted(image: np.ndarray, name: str) -> np.ndarray:
    """Return the image with another white balance, or in the tones of sepia."""
    by_channel = {"red": np.diag([1.4, 1.0, 0.6]), "blue": np.diag([0.6, 1.0, 1.4])}
    sepia = np.array([[0.393, 0.769, 0.189], [0.349, 0.686, 0.168], [0.272, 0.534, 0.131]])
    return np.clip(image @ by_channel.get(name, sepia).T, 0, 255).round().astype(np.uint8)


@pytest.mark.parametrize("name", ["red", "blue", "sepia"])
def test_a_false_white_balance_and_sepia_refuse_nobody(lab: TopoMetricMap, name: str):
    for found in _ask(lab, [_tinted(frame.image, name) for frame in _unseen()[:4]]):
        assert isinstance(found, Localization)
        assert found.probability > 0.9
        assert (found.appearance is None) == (name == "sepia")


def test_swapped_red_and_blue_are_told(lab: TopoMetricMap):
    localizer = Localizer(lab)
    for frame in _unseen()[:4]:
        trace = Trace()
        image = np.ascontiguousarray(frame.image[:, :, ::-1])
        found = localizer.localize(image, frame.camera, trace=trace)
        assert isinstance(found, Localization)
        assert found.appearance is not None
        assert found.appearance > 0.9
        assert any("red and blue of the image swapped" in one.text for one in trace.findings)
