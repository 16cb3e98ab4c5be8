"""Test the messages of /diagnostics and the choice of the clock."""

from __future__ import annotations

import time

import pytest

from topoloc.apps.robots.robot_health import Health, RobotClock


def test_levels_follow_the_evidence():
    health = Health()
    assert health.judge(100.0) == (2, "not localized yet")
    health.evidence_at = 100.0
    assert health.judge(100.5) == (0, "localized")
    health.is_contradicted = True
    assert health.judge(100.5) == (1, "the images contradict the pose")
    health.is_contradicted = False
    assert health.judge(102.0) == (1, "no evidence for 2.0 s; the pose is that of odometry")
    assert health.judge(111.0) == (2, "lost: no evidence for 11.0 s")


def test_a_fault_is_named_as_long_as_it_lasts():
    health = Health()
    health.faults["tf"] = "TF loops"
    assert health.judge(0.0) == (2, "TF loops")
    health.evidence_at = 0.0
    assert health.judge(0.1) == (1, "TF loops")
    health.faults.clear()
    assert health.judge(0.1) == (0, "localized")


def test_slow_answers_are_no_other_clock():
    """The shortest delay decides."""
    clock = RobotClock(max_offset=0.5)
    for delay in (3.0, 2.0, 0.1, 2.0):
        clock.observe(time.time_ns() - round(delay * 1e9))
    assert clock.offset == pytest.approx(0.1, abs=0.05)
    assert not clock.is_foreign
    assert clock.describe_fault() is None
    assert clock.now_ns() == pytest.approx(time.time_ns(), abs=5e7)


@pytest.mark.parametrize(("offset", "side"), [(40.0, "behind"), (-40.0, "ahead of")])
def test_another_clock_is_named_and_followed(offset: float, side: str):
    clock = RobotClock(max_offset=0.5)
    for _ in range(5):
        clock.observe(time.time_ns() - round(offset * 1e9))
    text = clock.describe_fault()
    assert text is not None
    assert f"40.00 s {side} this clock" in text
    assert clock.now_ns() == pytest.approx(time.time_ns() - offset * 1e9, abs=5e7)


def test_simulated_time_that_does_not_come_is_a_fault():
    clock = RobotClock(is_simulated=True)
    assert clock.describe_fault() == (
        "no time on /clock; start the simulation, or leave out use_sim_time"
    )
    clock.set_simulated(5_000_000_000)
    assert clock.describe_fault() is None
    assert clock.now_ns() == 5_000_000_000
