"""Test the poses of a stream that a drone gets: which are sent, which count as a reset, and in
which world and clock."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tiny_world
from built_room import built_room
from heard_autopilot import received, receiver
from topoloc import Localization, Localizer, NotLocalized, StreamedPose, Tracker, open_sequence
from topoloc.apps.cli import main
from topoloc.apps.robots.map_to_odom import ContinuityGate, StreamPose
from topoloc.apps.robots.mavlink import DroneLocalizer, choose_origin
from topoloc.errors import MapError
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.provenance import Provenance
from topoloc.mapping.build import BuildConfig

_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def _answer(
    t_ns: int, x: float, probability: float = 0.95, origin: float = 0.0, track: int = 0
) -> StreamedPose:
    pose = Rigid3(_FORWARD, np.array([origin + x, origin, 1.0]))
    covariance = Rigid3(np.eye(3), pose.translation).transform_covariance(1e-4 * np.eye(6))
    result = Localization(pose, covariance, probability, 0, [], 90, 80, {"total": 9.0})
    return StreamedPose(t_ns, "localized", result, pose, covariance, track=track)


def _refusal(t_ns: int, state: Any, reason: Any) -> StreamedPose:
    return StreamedPose(t_ns, state, NotLocalized(reason))


_LOST = [("predicted", "too_few_matches")] * 9 + [("lost", "too_few_matches")]
_JUMP = [("predicted", "jump"), ("ambiguous", "ambiguous")]


@pytest.mark.parametrize(
    ("refused", "metres", "track", "is_reset"),
    [
        ([], 0.0, 0, False),
        ([], 0.5, 0, True),  # unseen by the stream
        (_JUMP, 0.5, 1, True),
        (_JUMP, 0.0, 1, True),  # the stream says so
        (_JUMP[:1], 0.0, 0, False),  # one wrong image
        (_LOST, 0.0, 1, False),  # a dark second
        (_LOST, 9.0, 1, True),
        (_LOST * 2, 0.0, 1, True),  # nobody knows where it flew meanwhile
        (_JUMP + _LOST, 0.5, 1, True),
    ],
)
def test_a_pose_that_does_not_continue_the_last_one_is_a_reset(
    refused: list[tuple[str, str]], metres: float, track: int, is_reset: bool
):
    """The drone flies one metre per second. After a refusal three images must agree."""
    warnings, times = list[str](), iter(range(0, 10**10, 10**8))
    with receiver() as heard:
        drone = DroneLocalizer(f"udpout:127.0.0.1:{heard.getsockname()[1]}", warnings.append)
        for t_ns in islice(times, 6):
            drone.take(_answer(t_ns, t_ns / 1e9))
        for (state, reason), t_ns in zip(refused, times, strict=False):
            drone.take(_refusal(t_ns, state, reason))
        restart_ns = 10**8 * (6 + len(refused))
        for t_ns in range(restart_ns, restart_ns + 6 * 10**8, 10**8):
            drone.take(_answer(t_ns, t_ns / 1e9 + metres, track=track))
        found = {t_us * 1000: resets for t_us, _, resets in received(heard)}
        drone.close()
    wait_ns = 2 * 10**8 if refused or is_reset else 0
    later = {t_ns: resets for t_ns, resets in found.items() if t_ns >= restart_ns}
    assert min(later) == restart_ns + wait_ns
    assert set(later.values()) == {int(is_reset)}
    assert {resets for t_ns, resets in found.items() if t_ns < restart_ns} == {0}
    assert warnings == []


def test_a_map_without_scale_sends_no_metres():
    unscaled = Provenance("0123456789abcdef", has_scale=False)
    with receiver() as heard:
        drone = DroneLocalizer(f"udpout:127.0.0.1:{heard.getsockname()[1]}", print)
        for number in range(4):
            answer = _answer(10**8 * number, 0.1 * number)
            answer = replace(answer, result=replace(answer.result, provenance=unscaled))
            with pytest.raises(MapError, match=r"abcdef has no scale, but a drone needs metres"):
                drone.take(answer)
        found = received(heard)
        drone.close()
    assert found == []


def test_positions_of_far_worlds_are_sent_relative_to_an_origin():
    """Numbers of 32 bits hold 5,800,000 m to half a metre."""
    far = 5_800_000.0
    origin = choose_origin(np.array([[far - 300.0, far + 100.0, 20.0], [far, far, 10.0]]))
    assert origin is not None
    assert origin.tolist() == [far, far, 0.0]
    assert choose_origin(np.array([[5000.0, -9000.0, 10.0]])) is None
    with receiver() as heard:
        drone = DroneLocalizer(f"udpout:127.0.0.1:{heard.getsockname()[1]}", print, origin)
        for number in range(4):
            drone.take(_answer(10**8 * number, 0.1 * number, origin=far))
        found = {t_us // 100_000: at for t_us, at, _ in received(heard)}
        drone.close()
    np.testing.assert_allclose(found[3], [0.3, 0.0, -1.0], atol=1e-6)


def test_a_jump_is_sent_once_three_images_agree_on_it():
    warnings = list[str]()
    with receiver() as heard:
        drone = DroneLocalizer(f"udpout:127.0.0.1:{heard.getsockname()[1]}", warnings.append)
        xs = [0.0, 0.1, 0.2, 0.3, 20.0, 0.4, 20.0, 20.1, 20.2, 20.3]
        for number, x in enumerate(xs):
            drone.take(_answer(100_000_000 * number, x, 0.5 if number == 9 else 0.95))
        found = received(heard)
        drone.close()
    sent = {(t_us // 100_000, round(float(at[0]), 3), resets) for t_us, at, resets in found}
    assert sent == {(2, 0.2, 0), (3, 0.3, 0), (5, 0.4, 0), (8, 20.2, 1)}
    assert warnings == []


def test_a_pose_is_repeated_while_it_is_new():
    with receiver() as heard:
        drone = DroneLocalizer(f"udpout:127.0.0.1:{heard.getsockname()[1]}", print)
        for number in range(3):
            drone.take(_answer(number, 0.0))
        found = received(heard)
        drone.close()
    assert 3 <= len(found) <= 8
    assert {t_us for t_us, *_ in found} == {0}


def test_follow_sends_localized_poses(room_map: Path, tiny_recording: Path):
    sequence = open_sequence(tiny_recording)
    with receiver() as heard:
        address = f"udpout:127.0.0.1:{heard.getsockname()[1]}"
        assert main(["follow", str(room_map), str(tiny_recording), "--mavlink", address]) == 0
        found = {t_us: at for t_us, at, _ in received(heard)}
    truth = {t_ns // 1000: pose for t_ns, pose in zip(sequence.t_ns, sequence.poses, strict=True)}
    assert len(found) >= 10
    for t_us, at in found.items():
        pose = truth[t_us]
        assert pose is not None
        assert np.linalg.norm(at * [1.0, -1.0, -1.0] - pose.translation) < 0.03


def test_a_recording_in_realtime_has_this_machines_times(
    room_map: Path, tiny_recording: Path, capsys: pytest.CaptureFixture[str]
):
    before_ns = time.time_ns()
    with receiver() as heard:
        address = f"udpout:127.0.0.1:{heard.getsockname()[1]}"
        words = [str(room_map), str(tiny_recording), "--realtime", "--mavlink", address]
        assert main(["follow", *words]) == 0
        found = [t_us * 1000 for t_us, *_ in received(heard)]
    times = [json.loads(line)["t_ns"] for line in capsys.readouterr().out.splitlines()]
    spans = np.diff(times) / 1e8
    np.testing.assert_allclose(spans, np.round(spans), atol=1e-3)  # ten images per second
    assert before_ns <= times[0] < times[-1] <= time.time_ns()
    assert all(before_ns <= t_ns <= time.time_ns() for t_ns in found)


def test_realtime_is_for_recordings(complaint: Callable[..., str], room_map: Path):
    text = complaint("follow", room_map, "0", "--realtime", status=2)
    assert "--realtime plays a recording; leave it out for a live camera" in text


def test_a_map_in_utm_is_sent_relative_to_a_stated_origin(
    tiny_recording: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    """The world of the map is UTM: 400 km east, 5,800 km north."""
    far = shutil.copytree(tiny_recording, tmp_path / "far")
    lines = (far / "truth.tum").read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    shift = np.array([400_040.25, 5_800_123.5, 30.0])
    for row in rows:
        row[1:4] = [f"{float(word) + one:.6f}" for word, one in zip(row[1:4], shift, strict=True)]
    (far / "truth.tum").write_text("".join(f"{' '.join(row)}\n" for row in rows))
    build_map(open_sequence(far), BuildConfig(other_kinds=())).save(tmp_path / "far.topo")
    sequence = open_sequence(far)
    with receiver() as heard:
        address = f"udpout:127.0.0.1:{heard.getsockname()[1]}"
        assert main(["follow", str(tmp_path / "far.topo"), str(far), "--mavlink", address]) == 0
        found = {t_us: at for t_us, at, _ in received(heard)}
    said = capfd.readouterr().err
    assert "positions are sent relative to 400000,5800000,0 m of its world" in said
    truth = {t_ns // 1000: pose for t_ns, pose in zip(sequence.t_ns, sequence.poses, strict=True)}
    assert len(found) >= 10
    for t_us, at in found.items():
        pose = truth[t_us]
        assert pose is not None
        place = at * [1.0, -1.0, -1.0] + [400_000.0, 5_800_000.0, 0.0]
        assert np.linalg.norm(place - pose.translation) < 0.03


def _resets(tracker: Tracker, pictures: list[np.ndarray]) -> list[tuple[int, bool]]:
    """Return the images whose poses are sent at ten images per second, and whether with a reset."""
    gate, sent = ContinuityGate(), list[tuple[int, bool]]()
    for number, picture in enumerate(pictures):
        answer = tracker.process(picture, tiny_world.CAMERA, 100_000_000 * number)
        gate.observe(answer)
        result = answer.result
        if isinstance(result, Localization):
            pose = result.world_from_cam
            seen = StreamPose(answer.t_ns, pose, result.position_sigma_m, answer.track)
            verdict = gate.judge(seen)
            sent += [(number, verdict == "jumped" and bool(sent))] * (verdict != "doubted")
    return sent


@pytest.mark.parametrize("num", [6, pytest.param(200, marks=pytest.mark.slow)])
def test_cuts_of_a_video_are_resets_and_darkness_is_none(tiny_recording: Path, num: int):
    """The camera flies 0.2 m/s, and is moved by half a metre or more at a cut."""
    localizer, panels = Localizer(built_room(tiny_recording)), tiny_world.room()
    poses = [tiny_world.path_pose(1.0 + 0.15 * k) for k in range(74)]
    shown = [tiny_world.render(panels, one, noise_seed=k)[0] for k, one in enumerate(poses)]
    draw = np.random.default_rng(1).integers
    done = 0
    while done < num:
        first, length, second = draw(0, 60), draw(6, 14), draw(0, 62)
        cut = poses[second].translation - poses[first + length - 1].translation
        if np.linalg.norm(cut) < 0.5:
            continue
        flight = [*shown[first : first + length], *shown[second : second + 12]]
        sent = _resets(Tracker(localizer), flight)
        assert [number for number, is_reset in sent if is_reset] == [
            min(number for number, _ in sent if number >= length)
        ], (first, length, second)
        done += 1
    for start in draw(8, 40, max(1, num // 10)).tolist():
        flight = [
            np.zeros_like(one) if start <= k < start + 10 else one for k, one in enumerate(shown)
        ]
        sent = _resets(Tracker(localizer), flight)
        assert max(number for number, _ in sent) == len(shown) - 1
        assert not any(is_reset for _, is_reset in sent)
