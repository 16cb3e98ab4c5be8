"""Test `topoloc follow --ros` as a user types it, beside a robot that drives in real time."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
from played_robot import BASE_FROM_CAM, PlayedRobot, Step, followed
from tiny_world import CAMERA, path_pose, render, room
from topoloc.demo.recordings import SHIPPED
from topoloc.localization.map_facts.map_building import build_map
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import as_monocular

DOMAIN = 100 + os.getpid() % 100  # tests run side by side
START_S = 150.0  # kernels may have to be compiled


@pytest.fixture
def robot() -> Iterator[PlayedRobot]:
    robot = PlayedRobot(CAMERA, DOMAIN)
    yield robot
    robot.close()


def _picture(place: float) -> np.ndarray:
    return render(room(), path_pose(place), noise_seed=round(1000 * place))[0]


def _dark(place: float) -> np.ndarray:
    return np.zeros((CAMERA.height, CAMERA.width), np.uint8)


def _drive(
    start: float, end: float, picture: Callable[[float], np.ndarray] = _picture
) -> list[Step]:
    """Return the steps of a drive at two centimetres per image."""
    places = np.arange(start, end, 0.15 if end > start else -0.15)
    return [Step(path_pose(place), picture(place)) for place in places.tolist()]


def _start(robot: PlayedRobot, step: Step) -> None:
    assert robot.wait_for_listener(START_S)
    assert robot.stand(step, lambda: bool(robot.heard.poses), START_S)
    robot.heard.poses.clear()
    robot.heard.statuses.clear()


def _levels(robot: PlayedRobot, steps: Sequence[int]) -> set[int]:
    """Return the levels of /diagnostics between two steps."""
    first, last = (robot.start_ns + round(step * 1e9 / robot.hz) for step in steps)
    return {level for at, level, _, _ in robot.heard.statuses if first <= at <= last}


def test_tf_is_right_through_wrong_images_darkness_and_a_kidnapping(
    robot: PlayedRobot, room_map: Path
):
    """The bounds allow for a busy machine. benchmarks/robot_simulation.py prints figures."""
    steps = _drive(1.0, 4.0)
    steps += _drive(4.0, 5.2, lambda place: _picture(place + 6.0))  # for 0.8 s another place
    steps += _drive(5.2, 7.0)
    dark = len(steps)
    steps += _drive(7.0, 9.7, _dark)
    light = len(steps)
    steps += _drive(9.7, 12.0)
    kidnapped = len(steps)
    steps += [Step(path_pose(3.0), _picture(3.0), is_carried=True), *_drive(3.15, 12.0)]
    with followed(room_map, DOMAIN, "--ros") as process:
        _start(robot, steps[0])
        robot.play(steps)
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
        assert process.stderr is not None
        assert process.stderr.read() == ""
    before, after = robot.errors(0, kidnapped - 1), robot.errors(kidnapped, len(steps) - 2)
    assert np.median(before) < 0.02
    assert before.max() < 0.3
    assert after[:10].max() > 1.0  # the robot cannot detect it at once
    assert after[-50:].max() < 0.05
    poses = robot.pose_errors()
    assert len(poses) > 30
    assert poses.max() < 0.3  # the wrong ones are not published
    assert np.median(poses) < 0.02
    assert robot.gaps().max() < 1.0
    assert np.median(robot.latencies()) < 1.0
    assert _levels(robot, (5, 18)) == {0}
    assert 1 in _levels(robot, (dark + 8, light + 5))  # WARN, with slack for a busy machine
    assert robot.heard.statuses[-1][1] == 0


@pytest.mark.parametrize("has_noise", [False, True])
def test_a_robot_that_stands_is_localized(robot: PlayedRobot, room_map: Path, has_noise: bool):
    """It stands at the start, on its way and where it was carried to. Images of a simulator are
    equal then."""
    robot.has_noise = has_noise
    stop = _drive(5.0, 5.1) * 30
    there = Step(path_pose(10.0), _picture(10.0))
    steps = _drive(1.0, 1.1) * 20 + _drive(1.15, 5.0) + stop + _drive(5.15, 6.0)
    kidnapped = len(steps)
    steps += [Step(path_pose(10.0), _picture(10.0), is_carried=True), *[there] * 50]
    steps += _drive(10.0, 12.0)
    with followed(room_map, DOMAIN, "--ros") as process:
        _start(robot, steps[0])
        robot.play(steps)
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
        assert process.stderr is not None
        assert process.stderr.read() == ""
    before, after = robot.errors(0, kidnapped - 1), robot.errors(kidnapped + 30, len(steps) - 2)
    assert before.max() < 0.1
    assert after.max() < 0.1  # three seconds after the kidnapping
    assert robot.pose_errors().max() < 0.1
    texts = {text for _, _, text, _ in robot.heard.statuses}
    assert texts <= {"localized", "the images contradict the pose"} | {
        text for text in texts if text.startswith("no evidence for 1.")
    }


def test_a_camera_that_hangs_is_lost(robot: PlayedRobot, room_map: Path):
    steps = [Step(path_pose(1.0 + 0.15 * k), _picture(1.0)) for k in range(40)]
    robot.has_noise = False
    with followed(room_map, DOMAIN, "--ros") as process:
        _start(robot, steps[0])
        robot.play(steps)
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
        assert process.stderr is not None
        (line,) = process.stderr.read().splitlines()
    assert line.startswith("warning: the camera hangs: its images are equal while odometry moved")
    _, level, text, _ = robot.heard.statuses[-1]
    assert level == 2
    assert text.startswith("the camera hangs")
    assert len(robot.heard.poses) < 10  # none while it drives


def test_images_without_calibration_wait_and_unknown_encodings_are_named(
    robot: PlayedRobot, room_map: Path
):
    step = _drive(1.0, 1.1)[0]
    robot.has_info = False
    with followed(room_map, DOMAIN, "--ros") as process:
        assert robot.wait_for_listener(START_S)

        def says(words: str) -> Callable[[], bool]:
            return lambda: any(words in text for _, _, text, _ in robot.heard.statuses[-3:])

        assert robot.stand(step, says("no calibration, so the images of"), START_S)
        robot.has_info, robot.encoding = True, "strange8"
        assert robot.stand(step, says("pixels of encoding 'strange8'; known are"), START_S)
        robot.encoding = None
        assert robot.stand(step, lambda: robot.heard.statuses[-1][2] == "localized", START_S)
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
        assert process.stderr is not None
        first, second = process.stderr.read().splitlines()
    assert first.startswith("warning: /camera/camera_info: no calibration, so the images")
    assert "pixels of encoding 'strange8'" in second


def test_a_camera_without_calibration_is_one_line(robot: PlayedRobot, room_map: Path):
    robot.is_calibrated = False
    with followed(room_map, DOMAIN) as process:
        assert robot.wait_for_listener(START_S)
        robot.stand(_drive(1.0, 1.1)[0], lambda: process.poll() is not None, START_S)
        assert process.wait(30) == 1
        assert process.stderr is not None
        (line,) = process.stderr.read().splitlines()
    assert line == (
        "error: /camera/camera_info: K is zero, the camera is not calibrated; calibrate it, or give"
        " --camera FILE"
    )


def test_a_bag_that_begins_again_is_followed_on(robot: PlayedRobot, room_map: Path, tmp_path: Path):
    path = tmp_path / "answers.jsonl"
    with path.open("w") as out, followed(room_map, DOMAIN, stdout=out) as process:
        assert robot.wait_for_listener(START_S)
        robot.steps, end = _drive(1.0, 1.1), time.monotonic() + START_S
        for start_s in (2_000, 1_000):
            answers = list[dict[str, Any]]()
            while not any(one["t_ns"] // 10**12 == start_s // 1000 for one in answers):
                assert process.poll() is None, process.stderr and process.stderr.read()
                assert time.monotonic() < end
                start_s += 1
                robot.start_ns = start_s * 10**9
                robot._play_images()
                time.sleep(0.1)
                answers = [json.loads(line) for line in path.read_text().splitlines()]
        assert [answers[0]["state"], answers[-1]["state"]] == ["localized"] * 2
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0


def test_without_odometry_tf_is_that_of_the_camera(robot: PlayedRobot, room_map: Path):
    names = ("--odom", "none", "--camera-frame", "front")
    with followed(room_map, DOMAIN, "--ros", *names, "--camera", "map"):
        steps = _drive(1.0, 2.0)
        _start(robot, steps[0])
        robot.play(steps)
    assert robot.heard.transforms == []
    child, stamp, pose = robot.heard.others[-1]
    camera = robot.world_from_cam(stamp)
    assert child == "front"
    assert np.linalg.norm(pose.translation - camera.translation) < 0.05
    assert np.allclose(robot.heard.poses[-1][2].matrix(), pose.matrix(), atol=1e-9)
    assert np.linalg.norm(BASE_FROM_CAM.translation) > 0.4  # it is not the robot's


@pytest.mark.slow
@pytest.mark.parametrize("place", ["lab", "kitchen"])
def test_tf_is_right_in_the_demos_lab_and_in_a_real_kitchen(
    request: pytest.FixtureRequest, place: str, tmp_path: Path
):
    """The lab plays at two images per second, 0.26 m apart. The kitchen of 7-Scenes has ground
    truth from a tracker. One frame in four is mapped, and others are played."""
    if place == "lab":
        mapped = [str(SHIPPED / "map_lap1"), str(SHIPPED / "map_lap2")]
        played, hz = str(SHIPPED / "day"), 1.92
    else:
        kitchen = request.getfixturevalue("shared") / "data" / "seven_scenes" / "kitchen" / "seq-01"
        if not kitchen.is_dir():
            pytest.skip(f"no recording at {kitchen}")
        mapped, played, hz = [f"{kitchen}@0::4"], f"{kitchen}@2::4", 10.0
    build_map([open_sequence(path) for path in mapped]).save(tmp_path / "place.topo")
    sequence, steps = as_monocular(open_sequence(played)), list[Step]()
    for frame in (sequence[index] for index in range(min(len(sequence), 120))):
        assert frame.world_from_cam is not None
        steps.append(Step(frame.world_from_cam, frame.image))
    camera = sequence[0].camera
    assert camera is not None
    robot = PlayedRobot(camera, DOMAIN, hz)
    with followed(tmp_path / "place.topo", DOMAIN, "--ros") as process:
        _start(robot, steps[0])
        robot.play(steps)
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
    errors, poses = robot.errors(0, len(steps) - 2), robot.pose_errors()
    robot.close()
    assert np.median(errors) < 0.02
    assert errors.max() < 0.3
    assert len(poses) > 0.5 * len(steps)
    assert poses.max() < 0.3
