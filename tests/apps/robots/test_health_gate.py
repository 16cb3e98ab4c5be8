"""Test the health gate: which evidence changes the transform from map to odom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from topoloc.apps.robots.map_to_odom import HealthGate, MeasuredPose
from topoloc.geometry.rigid import Rigid3

COVARIANCE = np.diag([1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5])
MAP_FROM_ODOM = Rigid3.exp(np.array([1.0, -2.0, 0.0, 0.0, 0.0, 0.4]))
AWAY = Rigid3.exp(np.array([0.0, 1.5, 0.0, 0.0, 0.0, 0.1]))


def _evidence(
    t_s: float, wrong: Rigid3 | None = None, is_localized: bool = True, drift: float = 0.0
) -> MeasuredPose:
    """Return evidence at a time. The robot drives 0.5 m/s, and its odometry is off by
    `drift` metres."""
    way = 0.5 * t_s
    odom_from_cam = Rigid3.exp(np.array([way + drift, 0.0, 0.3, 0.0, 0.0, 0.0]))
    truth = MAP_FROM_ODOM @ Rigid3.exp(np.array([way, 0.0, 0.3, 0.0, 0.0, 0.0]))
    pose = truth if wrong is None else wrong @ truth
    travelled = np.array([abs(way), 0.0])
    return MeasuredPose(round(t_s * 1e9), pose, COVARIANCE, odom_from_cam, travelled, is_localized)


def _verdicts(gate: HealthGate, evidence: Sequence[MeasuredPose]) -> str:
    return "".join(gate.judge(one)[0] for one in evidence)


@pytest.fixture
def gate() -> HealthGate:
    """Return a gate that localized the robot within the first half second."""
    gate = HealthGate()
    assert _verdicts(gate, [_evidence(0.2 * k) for k in range(3)]) == "ddj"
    return gate


def test_the_first_pose_needs_several_images_that_agree():
    gate = HealthGate(num_confirming=4)
    assert _verdicts(gate, [_evidence(0.1), _evidence(0.2, AWAY), _evidence(0.3)]) == "ddd"
    assert gate.agreed is None
    assert _verdicts(gate, [_evidence(0.1 * k) for k in range(4, 8)]) == "ddjf"


def test_tracked_points_confirm_no_new_place():
    """Tracked points share the errors of the wrongly localized image."""
    gate = HealthGate()
    tracked = [_evidence(0.1 * k, is_localized=False) for k in range(20)]
    assert set(_verdicts(gate, [_evidence(0.0), *tracked])) == {"d"}


def test_poses_that_agree_follow_the_drift_of_odometry(gate: HealthGate):
    drifted = [_evidence(0.5 + 0.1 * k, drift=0.002 * k) for k in range(50)]
    assert set(_verdicts(gate, drifted)) == {"f"}
    assert gate.agreed is not None
    place = gate.agreed.map_from_odom.inverse() @ MAP_FROM_ODOM
    assert place.translation == pytest.approx([0.002 * 49, 0.0, 0.0], abs=1e-9)


def test_wrong_places_do_not_move_it(gate: HealthGate):
    """Feed wrong poses at random places, then several at one wrong place for less than a second."""
    rng = np.random.default_rng(0)
    everywhere = [_evidence(0.5 + 0.1 * k, Rigid3.exp(rng.normal(0.0, 1.0, 6))) for k in range(50)]
    assert set(_verdicts(gate, everywhere)) == {"d"}
    assert gate.is_contradicted
    for round_ in range(5):
        start = 6.0 + 2.0 * round_
        one_place = [_evidence(start + 0.1 * k, AWAY) for k in range(10)]
        assert set(_verdicts(gate, one_place)) == {"d"}
        assert _verdicts(gate, [_evidence(start + 1.0)]) == "f"
    assert not gate.is_contradicted


def test_a_jump_is_accepted_after_a_second_of_agreeing_images(gate: HealthGate):
    verdicts = _verdicts(gate, [_evidence(1.0 + 0.1 * k, AWAY) for k in range(13)])
    assert verdicts == "d" * 10 + "jff"
    assert gate.agreed is not None
    expected = AWAY @ MAP_FROM_ODOM
    assert np.allclose(gate.agreed.map_from_odom.matrix(), expected.matrix(), atol=1e-9)


def test_a_robot_that_stands_waits_longer(gate: HealthGate):
    """A robot at rest sees equal images with equal errors."""
    first = _evidence(1.0, AWAY)
    standing = [replace(first, t_ns=first.t_ns + 200_000_000 * k) for k in range(12)]
    verdicts = _verdicts(gate, standing)
    assert verdicts == "d" * 10 + "jf"


def test_images_that_odometry_contradicts_confirm_no_jump(gate: HealthGate):
    """The pose moves at 1 m/s, and wheel odometry measures half of it."""
    sliding = [
        _evidence(1.0 + 0.2 * k, Rigid3(np.eye(3), np.array([0.1 * k + 1.0, 1.0, 0.0])))
        for k in range(20)
    ]
    assert set(_verdicts(gate, sliding)) == {"d"}


def test_after_a_long_path_in_the_dark_the_drift_is_no_jump(gate: HealthGate):
    """After 20 metres with a drift of five per cent, one metre is one sigma."""
    assert _verdicts(gate, [_evidence(40.0, drift=1.0)]) == "f"
    assert _verdicts(HealthGate(), [_evidence(40.0, drift=1.0)]) == "d"


def test_a_pose_of_the_user_confirms_the_next_image(gate: HealthGate):
    prior = _evidence(1.0, AWAY)
    rough = np.diag([0.25, 0.25, 0.01, 0.01, 0.01, 0.07])
    moved = Rigid3.exp(np.array([0.3, -0.2, 0.0, 0.0, 0.0, 0.1])) @ prior.map_from_cam
    given = MeasuredPose(
        prior.t_ns, moved, rough, prior.odom_from_cam, prior.travelled, is_localized=False
    )
    gate.expect(given)
    assert gate.agreed is not None
    assert gate.agreed.t_ns == round(0.4e9)  # it is no evidence itself
    assert _verdicts(gate, [_evidence(1.1, AWAY)]) == "j"


def test_a_wrong_pose_of_the_user_moves_nothing(gate: HealthGate):
    gate.expect(_evidence(1.0, AWAY))
    assert _verdicts(gate, [_evidence(1.1), _evidence(1.2)]) == "ff"
