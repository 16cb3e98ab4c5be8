"""What may follow, and when a refused pose is believed after all."""

from __future__ import annotations

import numpy as np
from topoloc.tracking.motion_gate import GateConfig, MotionGate

from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3

SIGMA = np.diag(np.full(6, 1e-4))
SECOND = 1_000_000_000


def at(x: float, z: float = 0.0) -> Rigid3:
    return Rigid3(np.eye(3), np.array([x, 0.0, z]))


def gate_at_one_second() -> MotionGate:
    """A camera that has been going along x at 1 m/s for a second."""
    gate = MotionGate(GateConfig())
    gate.begin(0, at(0.0), SIGMA, None)
    for tenth in range(1, 11):
        predicted = gate.predict(tenth * SECOND // 10)
        assert predicted is not None
        assert gate.follows(predicted, at(tenth / 10), SIGMA)
        gate.correct(predicted, at(tenth / 10), SIGMA, None)
    return gate


def test_nothing_is_predicted_before_the_first_pose_nor_long_after_the_last():
    gate = MotionGate(GateConfig())
    assert gate.predict(SECOND) is None
    gate = gate_at_one_second()
    soon = gate.predict(SECOND * 3 // 2)
    assert soon is not None
    assert translation_error(soon.world_from_cam, at(1.5)) < 0.05
    assert gate.predict(SECOND * 21 // 10) is None


def test_odometry_carries_further():
    gate = MotionGate(GateConfig())
    gate.begin(0, at(5.0), SIGMA, at(100.0))
    late = gate.predict(10 * SECOND, at(103.0))
    assert late is not None
    assert translation_error(late.world_from_cam, at(8.0)) < 1e-9
    assert gate.predict(10 * SECOND) is None, "odometry that stops is none"


def test_a_jump_is_believed_when_the_next_poses_agree_with_it():
    gate = gate_at_one_second()
    verdicts = []
    for k in range(1, 4):
        t_ns = SECOND + k * SECOND // 10
        pose = at(1.0 + 0.1 * k, z=6.0)
        predicted = gate.predict(t_ns)
        assert predicted is not None
        assert not gate.follows(predicted, pose, SIGMA)
        verdicts.append(gate.is_overruled(t_ns, pose, SIGMA))
    assert verdicts == [False, False, True]
    state = gate.begin(t_ns, pose, SIGMA, None)
    assert abs(state.velocity[0] - 1.0) < 0.3, "what the rival has learnt of the velocity is kept"


def test_wild_poses_that_do_not_agree_are_never_believed():
    gate = gate_at_one_second()
    rng = np.random.default_rng(0)
    for k in range(1, 9):
        assert not gate.is_overruled(SECOND + k * SECOND // 10, Rigid3(np.eye(3), rng.uniform(-40, 40, 3)), SIGMA)
