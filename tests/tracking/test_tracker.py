"""Test streams of the rendered room: a good one, and streams with stops, frozen images, jumps
or wrong times."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import tiny_world
from built_room import built_room
from room_stream import INTERVAL_NS, far_away, room_stream
from topoloc.errors import QueryError
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.query import Deadline
from topoloc.localization.result import Localization, NotLocalized
from topoloc.recordings.frame_preparation import downscale_image
from topoloc.tracking.config import TrackerConfig
from topoloc.tracking.stream_result import StreamedPose
from topoloc.tracking.tracker import Tracker

CAMERA = tiny_world.CAMERA
NOTHING = np.random.default_rng(3).integers(0, 255, (CAMERA.height, CAMERA.width), dtype=np.uint8)
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def localizer(tiny_recording: Path) -> Localizer:
    return Localizer(built_room(tiny_recording))


@pytest.fixture(scope="module")
def answers(localizer: Localizer) -> list[StreamedPose]:
    """Return the results of the whole stream."""
    return _stream(Tracker(localizer), 0, len(room_stream()))


def _stream(tracker: Tracker, first: int, last: int, delay_ns: int = 0) -> list[StreamedPose]:
    return [
        tracker.process(grey, CAMERA, t_ns + delay_ns)
        for t_ns, grey, _ in room_stream()[first:last]
    ]


def test_no_further_search_follows_when_the_time_of_an_image_is_over(
    localizer: Localizer, monkeypatch: pytest.MonkeyPatch
):
    """One deadline holds for all searches, for a single image and for a stream."""
    limits, search = list[Deadline | None](), localizer.localize_query

    def localize_query(query, near=None, max_ms=None):
        limits.append(max_ms)
        return search(query, near, max_ms)

    monkeypatch.setattr(localizer, "localize_query", localize_query)
    over = Deadline()
    over.stop.set()
    (t_ns, grey, _), *_ = room_stream()
    for limit in (over, Deadline(), 1e6, None):
        answer = Tracker(localizer).process(grey, CAMERA, t_ns, max_ms=limit)
        assert answer.state == "localized"
        assert all(one is limits[0] for one in limits)
        assert (limits[0] is limit) == isinstance(limit, Deadline)
        limits.clear()
    unknown = Tracker(localizer).process(NOTHING, CAMERA, t_ns, max_ms=over)
    assert unknown.state == "lost"
    assert set(limits) == {over}


def _raw(answer: StreamedPose) -> Rigid3:
    assert isinstance(answer.result, Localization)
    return answer.result.world_from_cam


def _smoothed(answer: StreamedPose) -> Rigid3:
    assert answer.smoothed is not None
    return answer.smoothed


def _jitter(poses: list[Rigid3]) -> float:
    """Return the root mean square of the step errors in metres."""
    truths = [pose for _, _, pose in room_stream()]
    steps = [
        (a.inverse() @ b).translation - (c.inverse() @ d).translation
        for a, b, c, d in zip(poses, poses[1:], truths, truths[1:], strict=False)
    ]
    return float(np.sqrt(np.mean(np.sum(np.square(steps), axis=1))))


def test_every_picture_of_a_good_stream_has_a_pose_and_most_are_tracked(
    answers: list[StreamedPose],
):
    states = [answer.state for answer in answers]
    assert states[0] == "localized"
    assert set(states) == {"localized", "tracked"}
    assert states.count("tracked") > 0.6 * len(states)
    for answer, (t_ns, _, truth) in zip(answers, room_stream(), strict=True):
        assert answer.t_ns == t_ns
        for pose in (_raw(answer), _smoothed(answer)):
            assert translation_error(pose, truth) < 0.03
            assert rotation_error(pose, truth) < np.deg2rad(0.7)


def test_tracked_poses_are_not_copies(answers: list[StreamedPose]):
    steps = [translation_error(_raw(a), _raw(b)) for a, b in pairwise(answers)]
    assert min(steps) > 0.01, "the camera moves two centimetres a picture"


def test_smoothing_reduces_the_jitter_of_the_poses(answers: list[StreamedPose]):
    raw = _jitter([_raw(answer) for answer in answers])
    assert _jitter([_smoothed(answer) for answer in answers]) < 0.85 * raw


def test_no_coarse_search_while_tracked(localizer: Localizer, monkeypatch: pytest.MonkeyPatch):
    tracker = Tracker(localizer)
    _stream(tracker, 0, 3)
    monkeypatch.setattr(
        localizer.context.first.map.coarse,
        "rank",
        lambda *_: pytest.fail("the coarse localizer was asked"),
    )
    assert {answer.state for answer in _stream(tracker, 3, 25)} == {"localized", "tracked"}


def test_the_smoothed_covariance_is_of_the_size_of_the_error(answers: list[StreamedPose]):
    for answer, (_, _, truth) in zip(answers[5:], room_stream()[5:], strict=True):
        assert answer.smoothed_covariance is not None
        error = (_smoothed(answer) @ truth.inverse()).log()
        assert error @ np.linalg.solve(answer.smoothed_covariance, error) < 33.0


def test_shared_errors_of_the_map_are_no_noise(tiny_recording: Path, answers: list[StreamedPose]):
    """A larger error share of the map moves tracked poses by less than 1 cm, and raises
    their covariance."""
    topomap = built_room(tiny_recording)
    errors = topomap.first_layer.shared_errors
    assert errors is not None
    doubtful = Localizer(topomap.with_first_layer(shared_errors=replace(errors, rho=0.5)))
    others = _stream(Tracker(doubtful), 0, 30)
    for other, answer in zip(others, answers, strict=False):
        assert translation_error(_smoothed(other), _smoothed(answer)) < 0.01
        assert other.smoothed_covariance is not None
        assert answer.smoothed_covariance is not None
        assert np.trace(other.smoothed_covariance) > 10 * np.trace(answer.smoothed_covariance)
    for other, (_, _, truth) in zip(others[10:], room_stream()[10:], strict=False):
        assert translation_error(_smoothed(other), truth) < 0.02


def test_images_without_features_are_predicted_then_lost(localizer: Localizer):
    tracker = Tracker(localizer)
    _stream(tracker, 0, 10)
    t_ns, _, truth = room_stream()[12]
    covered = tracker.process(NOTHING, CAMERA, t_ns)
    assert covered.state == "predicted"
    assert isinstance(covered.result, NotLocalized)
    assert translation_error(_smoothed(covered), truth) < 0.08
    line = covered.to_json("12")
    assert not line["localized"]
    assert line["state"] == "predicted"
    assert "world_from_cam" not in line
    seen_again = tracker.process(room_stream()[14][1], CAMERA, room_stream()[14][0])
    assert seen_again.state in ("localized", "tracked")
    lost = [
        tracker.process(
            np.roll(NOTHING, k, axis=1), CAMERA, room_stream()[14][0] + k * SECOND * 6 // 10
        )
        for k in (1, 2)
    ]
    assert [answer.state for answer in lost] == ["predicted", "lost"]
    assert lost[1].smoothed is None
    assert lost[1].to_json("")["smoothed"] is None
    assert _stream(tracker, 20, 21, delay_ns=3 * SECOND)[0].state == "localized"


def test_after_a_stop_the_stream_goes_on_elsewhere(localizer: Localizer):
    tracker = Tracker(localizer)
    last = _stream(tracker, 0, 10)[-1]
    picture, truth = far_away()[0]
    answer = tracker.process(picture, CAMERA, last.t_ns + 60 * SECOND)
    assert answer.state == "localized"
    assert translation_error(_smoothed(answer), truth) < 0.02


def test_a_jump_is_refused_until_other_images_agree(localizer: Localizer):
    tracker = Tracker(localizer)
    last = _stream(tracker, 0, 10)[-1]
    jumped = [
        tracker.process(picture, CAMERA, last.t_ns + (k + 1) * INTERVAL_NS)
        for k, (picture, _) in enumerate(far_away())
    ]
    assert [answer.state for answer in jumped[:3]] == ["predicted", "ambiguous", "localized"]
    assert [answer.to_json("")["reason"] for answer in jumped[:2]] == ["jump", "ambiguous"]
    for answer, (_, truth) in zip(jumped[2:], far_away()[2:], strict=True):
        assert translation_error(_smoothed(answer), truth) < 0.03


def test_one_wild_pose_leaves_no_trace(localizer: Localizer):
    tracker = Tracker(localizer)
    _stream(tracker, 0, 10)
    wild = tracker.process(far_away()[0][0], CAMERA, room_stream()[10][0])
    assert wild.to_json("")["reason"] == "jump"
    assert translation_error(_smoothed(wild), room_stream()[10][2]) < 0.05
    for answer, (_, _, truth) in zip(_stream(tracker, 11, 16), room_stream()[11:], strict=False):
        assert translation_error(_smoothed(answer), truth) < 0.03


def test_a_repeated_image_gets_the_same_result_and_a_mark(localizer: Localizer):
    tracker = Tracker(localizer)
    last = _stream(tracker, 0, 8)[-1]
    _, grey, _ = room_stream()[7]
    for t_ns in (last.t_ns, last.t_ns + INTERVAL_NS):
        again = tracker.process(grey.copy(), CAMERA, t_ns)
        assert again.is_repeated
        assert again.to_json("")["repeated"] is True
        np.testing.assert_array_equal(_raw(again).matrix(), _raw(last).matrix())
    onward = _stream(tracker, 10, 14)
    assert not onward[0].is_repeated
    for answer, (_, _, truth) in zip(onward, room_stream()[10:], strict=False):
        assert translation_error(_smoothed(answer), truth) < 0.03


def test_images_in_reused_memory_are_not_frozen(localizer: Localizer):
    tracker, memory = Tracker(localizer), np.empty_like(NOTHING)
    for t_ns, grey, _ in room_stream()[:4]:
        memory[:] = grey
        assert not tracker.process(memory, CAMERA, t_ns).is_repeated


@pytest.mark.parametrize(
    ("t_ns", "words"), [(0, "goes backwards"), (7 * INTERVAL_NS, "stands still")]
)
def test_clocks_that_do_not_advance_are_refused(localizer: Localizer, t_ns: int, words: str):
    tracker = Tracker(localizer)
    _stream(tracker, 0, 8)
    with pytest.raises(QueryError, match=words):
        tracker.process(room_stream()[9][1], CAMERA, room_stream()[7][0] if t_ns else 0)
    tracker.reset()
    assert tracker.process(room_stream()[9][1], CAMERA, 0).state == "localized"


def test_another_resolution_with_its_camera_goes_on_and_without_it_is_refused(localizer: Localizer):
    import cv2

    tracker = Tracker(localizer)
    _stream(tracker, 0, 8)
    for number in (8, 9, 10):
        t_ns, grey, truth = room_stream()[number]
        larger = cv2.resize(grey, (480, 360), interpolation=cv2.INTER_CUBIC)
        with pytest.raises(QueryError, match="480x360"):
            tracker.process(larger, CAMERA, t_ns)
        answer = tracker.process(larger, CAMERA.rescaled(480, 360), t_ns)
        assert answer.state == ("localized" if number == 8 else "tracked")
        assert translation_error(_smoothed(answer), truth) < 0.03


def test_images_larger_than_the_tracking_size(
    localizer: Localizer, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(
        "topoloc.tracking.map_stream.downscale_image",
        lambda grey, camera, _: downscale_image(grey, camera, 200),
    )
    tracker = Tracker(localizer)
    answers = _stream(tracker, 0, 12)
    assert [answer.state for answer in answers].count("tracked") >= 6
    for answer, (_, _, truth) in zip(answers, room_stream(), strict=False):
        assert translation_error(_raw(answer), truth) < 0.04


def test_a_picture_that_cannot_be_read_is_predicted(localizer: Localizer):
    tracker = Tracker(localizer)
    assert tracker.process_missing(0, NotLocalized("unreadable")).state == "lost"
    _stream(tracker, 0, 8, delay_ns=1)
    missed = tracker.process_missing(
        room_stream()[8][0] + 1, NotLocalized("unreadable", detail="cut off")
    )
    assert missed.state == "predicted"
    assert translation_error(_smoothed(missed), room_stream()[8][2]) < 0.03
    assert missed.to_json("")["reason"] == "unreadable"


def test_odometry_bridges_images_without_features(localizer: Localizer):
    odom_from_world = Rigid3.from_quat_wxyz(
        np.array([0.7, 0.1, -0.5, 0.2]), np.array([9.0, 1.0, -4.0])
    )
    tracker = Tracker(localizer)
    for t_ns, grey, truth in room_stream()[:6]:
        tracker.process(grey, CAMERA, t_ns, odom_from_world @ truth)
    _, _, truth = room_stream()[36]
    late = tracker.process(NOTHING, CAMERA, 5 * SECOND, odom_from_world @ truth)
    assert late.state == "predicted"
    assert translation_error(_smoothed(late), truth) < 0.03


def test_the_papers_rule_copies_poses_with_a_mark(localizer: Localizer):
    tracker = Tracker(localizer, TrackerConfig(mode="paper", max_jump=0.5))
    first = _stream(tracker, 0, 2)[-1]
    refused = tracker.process(far_away()[0][0], CAMERA, first.t_ns + INTERVAL_NS)
    assert refused.state == "predicted"
    assert refused.to_json("")["reason"] == "jump"
    np.testing.assert_array_equal(_smoothed(refused).matrix(), _smoothed(first).matrix())
    assert _stream(tracker, 4, 5)[0].state == "localized"
    generous = Tracker(localizer, TrackerConfig(mode="paper", max_jump=5.0))
    generous.process(room_stream()[0][1], CAMERA, 0)
    assert generous.process(far_away()[0][0], CAMERA, 1).state == "localized"


def test_two_runs_give_the_same_bytes(localizer: Localizer, answers: list[StreamedPose]):
    again = _stream(Tracker(localizer), 0, 12)
    for one, other in zip(again, answers, strict=False):
        np.testing.assert_array_equal(_smoothed(one).matrix(), _smoothed(other).matrix())


def test_a_camera_of_another_size_is_refused(localizer: Localizer):
    with pytest.raises(QueryError, match="320x240"):
        Tracker(localizer).process(
            room_stream()[0][1], Camera.pinhole(640, 480, 500.0, 500.0, 320.0, 240.0), 0
        )
