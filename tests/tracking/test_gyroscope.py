"""Test the gyroscope of a stream with a camera whose rotation is known at each time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import tiny_world
from built_room import built_room
from room_stream import room_stream
from topoloc.geometry.alignment import rotation_error
from topoloc.geometry.rigid import Rigid3, exp_so3, log_so3
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.node_ids import NodeId
from topoloc.tracking.gyroscope import Gyroscope
from topoloc.tracking.stream_result import StreamedPose
from topoloc.tracking.tracker import Tracker

SECOND, STEP_NS = 1_000_000_000, 5_000_000
CAM_FROM_IMU = exp_so3(np.array([0.4, -1.9, 0.7]))
BIAS = np.radians([1.0, -0.6, 0.4])
Rates = Callable[[np.ndarray], np.ndarray]


def turned(t_ns: int) -> np.ndarray:
    """Return world_from_cam of a hand that turns the camera about all axes."""
    t = t_ns / SECOND
    return exp_so3(np.array([0.3 * np.sin(1.7 * t), 0.5 * np.sin(1.1 * t), 0.4 * np.sin(2.3 * t)]))


def panned(t_ns: int) -> np.ndarray:
    return exp_so3(np.array([0.0, 0.6 * np.sin(1.3 * t_ns / SECOND), 0.0]))


def right(rates: np.ndarray) -> np.ndarray:
    return rates


def observe(
    gyroscope: Gyroscope,
    motion: Callable[[int], np.ndarray] = turned,
    rates: Rates = right,
    seconds: float = 12.0,
) -> None:
    """Give the gyroscope its samples and a measured pose every tenth of a second."""
    rng = np.random.default_rng(5)
    for t_ns in range(0, int(seconds * SECOND), STEP_NS):
        rate = log_so3(motion(t_ns).T @ motion(t_ns + STEP_NS)) / (STEP_NS / SECOND)
        noise = rng.normal(0.0, 0.003, 3)
        gyroscope.add(t_ns + STEP_NS // 2, rates(CAM_FROM_IMU.T @ rate + BIAS + noise))
        if t_ns % (SECOND // 10) == 0 and t_ns > 0:
            error = exp_so3(rng.normal(0.0, 0.002, 3))
            pose = Rigid3(motion(t_ns) @ error, np.zeros(3))
            found = Localization(
                pose, 0.002**2 * np.eye(6), 0.99, NodeId(0), [], 90, 80, {"total": 1.0}
            )
            gyroscope.observe(StreamedPose(t_ns, "localized", found, pose, track=1))


def test_axes_and_bias_are_found_from_the_images():
    gyroscope = Gyroscope()
    observe(gyroscope)
    assert gyroscope.fault is None
    assert gyroscope.cam_from_imu is not None
    error = Rigid3(gyroscope.cam_from_imu.T @ CAM_FROM_IMU, np.zeros(3)).angle()
    assert error < np.radians(1.0)
    np.testing.assert_allclose(gyroscope.bias, BIAS, atol=np.radians(0.3))


def test_a_turn_is_measured_to_its_own_standard_deviation():
    gyroscope = Gyroscope()
    observe(gyroscope)
    start, end = 9 * SECOND + 1_234_567, 10 * SECOND
    turn = gyroscope.measure_turn(start, end)
    assert turn is not None
    error = np.linalg.norm(log_so3(turned(start).T @ turned(end)) - turn.rotvec)
    assert error < 3.0 * turn.sigma < np.radians(6.0)
    assert gyroscope.measure_turn(11 * SECOND, 13 * SECOND) is None  # the samples end at 12 s
    assert gyroscope.measure_turn(end, end) is None


def test_turns_about_one_axis_fix_no_axes_but_confirm_given_ones():
    found, given = Gyroscope(), Gyroscope(CAM_FROM_IMU)
    for gyroscope in (found, given):
        observe(gyroscope, panned)
    assert found.cam_from_imu is None
    assert found.fault is None
    assert given.measure_turn(8 * SECOND, 9 * SECOND) is not None


@pytest.mark.parametrize(
    ("given", "rates", "words"),
    [
        (None, lambda rates: rates * [1.0, 1.0, -1.0], "left-handed"),
        (None, lambda rates: rates[[1, 0, 2]], "swap two"),
        (None, lambda rates: np.degrees(rates), "degrees per second"),
        (
            None,
            lambda rates: np.random.default_rng(int(abs(rates[0]) * 1e9)).normal(size=3),
            "clock",
        ),
        (exp_so3(np.array([0.0, 0.0, 1.5])) @ CAM_FROM_IMU, right, "off by 86 degrees"),
    ],
)
def test_a_gyroscope_that_contradicts_the_images_is_refused_with_the_reason(
    given: np.ndarray | None, rates: Rates, words: str
):
    gyroscope = Gyroscope(given)
    observe(gyroscope, rates=rates)
    assert gyroscope.fault is not None
    assert words in gyroscope.fault
    assert gyroscope.measure_turn(8 * SECOND, 9 * SECOND) is None


def test_obeying_the_message_about_given_axes_leads_to_a_gyroscope_in_use():
    wrong = Gyroscope(np.eye(3))
    observe(wrong)
    assert wrong.fault is not None
    quat = [float(value) for value in wrong.fault.rpartition(" ")[2].split(",")]
    obeyed = Gyroscope(Rigid3.from_quat_wxyz(np.array(quat), np.zeros(3)).rotation)
    observe(obeyed)
    assert obeyed.fault is None
    assert obeyed.cam_from_imu is not None


def test_samples_that_are_no_numbers_are_left_out_and_an_earlier_time_starts_anew():
    gyroscope = Gyroscope()
    observe(gyroscope)
    gyroscope.add(12 * SECOND, np.array([np.nan, 0.0, 0.0]))
    assert gyroscope.measure_turn(11 * SECOND, 12 * SECOND - STEP_NS) is not None
    gyroscope.add(0, np.zeros(3))
    assert gyroscope.measure_turn(10 * SECOND, 11 * SECOND) is None


def test_a_dark_turn_is_bridged_and_forgotten_after_three_seconds(tiny_recording: Path):
    localizer, camera = Localizer(built_room(tiny_recording)), tiny_world.CAMERA
    dark_turn = np.array([0.0, 0.9, 0.3])  # rad/s
    delay_ns, states = 20 * SECOND, dict[bool, list[str]]()
    for has_gyroscope in (True, False):
        gyroscope = Gyroscope()
        observe(gyroscope)
        tracker = Tracker(localizer, gyroscope=gyroscope if has_gyroscope else None)
        for t_ns, grey, _ in room_stream()[:8]:
            tracker.process(grey, camera, t_ns + delay_ns)
        last_ns, _, last = room_stream()[7]
        start_ns, rng, states[has_gyroscope] = last_ns + delay_ns, np.random.default_rng(1), []
        for t_ns in range(start_ns, start_ns + 5 * SECOND, STEP_NS):
            gyroscope.add(t_ns, CAM_FROM_IMU.T @ dark_turn + BIAS)
        for tenths in range(3, 36, 4):
            dark = rng.integers(0, 6, (camera.height, camera.width)).astype(np.uint8)
            answer = tracker.process(dark, camera, start_ns + tenths * SECOND // 10)
            states[has_gyroscope].append(answer.state)
            if has_gyroscope and answer.state == "predicted":
                assert answer.smoothed is not None
                truth = Rigid3(last.rotation @ exp_so3(0.1 * tenths * dark_turn), np.zeros(3))
                assert rotation_error(truth, answer.smoothed) < np.radians(8.0)
    assert states[True] == ["predicted"] * 7 + ["lost"] * 2
    assert states[False].count("predicted") <= 2
