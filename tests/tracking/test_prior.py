"""Test a user's prior pose for a stream: it decides between similar places, and is no result."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from doubled_room import ELSEWHERE, twice
from room_stream import far_away, room_stream
from tiny_world import CAMERA
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.tracking.tracker import Tracker

ROUGHLY = np.diag([0.25, 0.25, 0.01, 0.01, 0.01, 0.07])
"""Covariance about the position, as RViz sends it."""
ASIDE = Rigid3(np.eye(3), np.array([0.3, -0.2, 0.05]))


def _about(pose: Rigid3) -> np.ndarray:
    return Rigid3(np.eye(3), pose.translation).transform_covariance(ROUGHLY)


@pytest.fixture(scope="module")
def doubled(room_map: Path) -> Localizer:
    return Localizer(twice(TopoMetricMap.load(room_map)))


@pytest.mark.parametrize("place", [Rigid3.identity(), ELSEWHERE])
def test_it_decides_between_two_similar_rooms(doubled: Localizer, place: Rigid3):
    stream = room_stream()[:4]
    tracker = Tracker(doubled)
    states = [tracker.process(image, CAMERA, t_ns).state for t_ns, image, _ in stream]
    assert set(states) <= {"ambiguous", "lost"}
    tracker = Tracker(doubled)
    given = ASIDE @ place @ stream[0][2]
    tracker.expect(given, _about(given), stream[0][0])
    for t_ns, image, truth in stream:
        answer = tracker.process(image, CAMERA, t_ns)
        assert answer.state in ("localized", "tracked")
        assert isinstance(answer.result, Localization)
        error = answer.result.world_from_cam.translation - (place @ truth).translation
        assert np.linalg.norm(error) < 0.05


def test_it_is_no_result(room_map: Path):
    """An image without content gets no pose from the prior."""
    tracker = Tracker(Localizer(TopoMetricMap.load(room_map)))
    pose = room_stream()[0][2]
    tracker.expect(pose, _about(pose), 0)
    answer = tracker.process(np.zeros((240, 320), np.uint8), CAMERA, 0)
    assert answer.state not in ("localized", "tracked")
    assert not isinstance(answer.result, Localization)


def test_a_wrong_prior_is_corrected(room_map: Path):
    tracker = Tracker(Localizer(TopoMetricMap.load(room_map)))
    wrong, (image, truth) = room_stream()[0][2], far_away()[0]
    tracker.expect(wrong, np.diag([1e-4] * 6), 0)
    answers = [tracker.process(image ^ number, CAMERA, number) for number in range(3)]
    assert isinstance(answers[-1].result, Localization)
    error = answers[-1].result.world_from_cam.translation - truth.translation
    assert np.linalg.norm(error) < 0.05


def test_a_stream_goes_on_from_it(room_map: Path):
    """Odometry moves the prior until an image is localized."""
    tracker = Tracker(Localizer(TopoMetricMap.load(room_map)))
    stream = room_stream()
    (t0, _, before), (t1, image, after) = stream[0], stream[20]
    tracker.expect(before, _about(before), t0, before)
    black = np.zeros((240, 320), np.uint8)
    for number in range(1, 5):
        tracker.process(black ^ number, CAMERA, t0 + number, before)
    answer = tracker.process(image, CAMERA, t1, after)
    assert answer.state == "localized"
