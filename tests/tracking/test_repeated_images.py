"""Test images that equal the one before: of a robot that stands in a simulator without noise, and
of a camera that hangs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import tiny_world
from built_room import built_room
from room_stream import far_away, room_stream
from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.tracking.config import TrackerConfig
from topoloc.tracking.stream_result import StreamedPose
from topoloc.tracking.tracker import Tracker

STEP_NS = 100_000_000
Seen = tuple[np.ndarray, Rigid3 | None]


@pytest.fixture(scope="module")
def localizer(tiny_recording: Path) -> Localizer:
    return Localizer(built_room(tiny_recording))


def _play(tracker: Tracker, seen: Sequence[Seen], start: int = 0) -> list[StreamedPose]:
    """Return the answers at ten images per second."""
    return [
        tracker.process(grey.copy(), tiny_world.CAMERA, (start + number) * STEP_NS, odom_from_cam)
        for number, (grey, odom_from_cam) in enumerate(seen)
    ]


def _drive(first: int, last: int) -> list[Seen]:
    return [(grey, pose) for _, grey, pose in room_stream()[first:last]]


def _noisy(seen: Seen, num: int) -> list[Seen]:
    """Return images of a camera that stands, with noise."""
    rng = np.random.default_rng(0)
    noise = rng.integers(-2, 3, (num, *seen[0].shape))
    return [(np.clip(seen[0] + one, 0, 255).astype(np.uint8), seen[1]) for one in noise]


def _states(answers: Sequence[StreamedPose]) -> set[str]:
    return {answer.state for answer in answers}


def _detail(answer: StreamedPose) -> str:
    assert isinstance(answer.result, NotLocalized)
    return answer.result.detail


def _covariance(answer: StreamedPose) -> np.ndarray:
    assert answer.smoothed_covariance is not None
    return answer.smoothed_covariance


def test_a_robot_that_stands_is_never_lost_and_learns_nothing(localizer: Localizer):
    tracker = Tracker(localizer)
    standing = _play(tracker, _drive(0, 1) * 300)
    assert _states(standing) == {"localized"}
    assert all(answer.is_measured and answer.is_confirmed for answer in standing[1:])
    assert all(np.array_equal(_covariance(one), _covariance(standing[0])) for one in standing)
    onward = _play(tracker, _drive(1, 20), 300)
    assert _states(onward) <= {"localized", "tracked"}
    for answer, (_, _, truth) in zip(onward, room_stream()[1:], strict=False):
        assert answer.smoothed is not None
        assert translation_error(answer.smoothed, truth) < 0.03


def test_odometry_that_drifts_a_little_stands(localizer: Localizer):
    (image, pose), tracker = _drive(0, 1)[0], Tracker(localizer)
    drift = [Rigid3.exp(np.array([1e-4 * k, 0.0, 0.0, 0.0, 0.0, 1e-4 * k])) for k in range(300)]
    assert _states(_play(tracker, [(image, pose @ one) for one in drift if pose])) == {"localized"}


@pytest.mark.parametrize("num_moved", [1, 2])
def test_after_a_kidnapping_equal_images_are_localized(localizer: Localizer, num_moved: int):
    """Wheels do not turn while the robot is carried."""
    tracker, odom_from_cam = Tracker(localizer), room_stream()[9][2]
    _play(tracker, _drive(0, 10))
    there = [(grey, odom_from_cam) for grey, _ in far_away()[:num_moved]]
    answers = _play(tracker, there + there[-1:] * 9, 10)
    truth = far_away()[num_moved - 1][1]
    assert _states(answers[-7:]) == {"localized"}
    assert all(isinstance(answer.result, Localization) for answer in answers[-7:])
    found = answers[-1].smoothed
    assert found is not None
    assert translation_error(found, truth) < 0.03
    (alone,) = _play(Tracker(localizer), there[-1:])
    assert np.all(np.diag(_covariance(answers[-1])) >= 0.999 * np.diag(_covariance(alone)))


def test_a_camera_that_hangs_on_a_robot_that_drives_is_lost(localizer: Localizer):
    tracker = Tracker(localizer)
    _play(tracker, _drive(0, 5))
    frozen, poses = room_stream()[4][1], [pose for _, _, pose in room_stream()[5:40]]
    answers = _play(tracker, [(frozen, pose) for pose in poses], 5)
    assert not any(answer.is_measured for answer in answers[2:])
    assert _states(answers[15:]) == {"lost"}
    assert "the camera hangs: its images are equal while odometry moved" in _detail(answers[-1])
    assert "restart its driver" in _detail(answers[-1])
    (again,) = _play(tracker, _drive(39, 40), 40)
    assert again.state == "localized"
    assert again.smoothed is not None
    assert translation_error(again.smoothed, room_stream()[39][2]) < 0.03


def test_a_camera_with_noise_that_hangs_on_a_robot_that_is_carried_is_lost(localizer: Localizer):
    tracker = Tracker(localizer)
    noisy = _noisy(_drive(0, 1)[0], 40)
    assert _states(_play(tracker, noisy)) <= {"localized", "tracked"}
    answers = _play(tracker, noisy[-1:] * 20, 40)
    assert _states(answers[12:]) == {"lost"}
    assert "differed before while the robot stood" in _detail(answers[-1])


def test_what_moves_before_a_simulated_camera_is_no_noise(localizer: Localizer):
    tracker, seen = Tracker(localizer), list[Seen]()
    for number in range(60):
        grey, pose = _drive(0, 1)[0]
        grey = grey.copy()
        grey[200:220, number : number + 10] = 255
        seen.append((grey, pose))
    _play(tracker, seen)
    assert _states(_play(tracker, seen[-1:] * 30, 60)) <= {"localized", "tracked"}


def test_without_odometry_equal_images_are_no_evidence_unless_simulated(localizer: Localizer):
    still = [(room_stream()[0][1], None)] * 30
    answers = _play(Tracker(localizer), still)
    assert not any(answer.is_measured for answer in answers[1:])
    assert _states(answers[11:]) == {"lost"}
    assert _detail(answers[-1]) == (
        "the images are equal: the camera hangs, or stands in a simulator without noise; restart"
        " its driver, or for a simulator give --simulated of `follow` (setting track.simulated)"
    )
    simulated = _play(Tracker(localizer, TrackerConfig(simulated=True)), still)
    assert _states(simulated) == {"localized"}
    assert all(answer.is_measured for answer in simulated)


def test_one_image_that_a_driver_sends_twice_is_no_fault(localizer: Localizer):
    tracker = Tracker(localizer)
    twice = [one for seen in _drive(0, 20) for one in (seen, (seen[0], None))]
    assert "lost" not in _states(_play(tracker, twice))
