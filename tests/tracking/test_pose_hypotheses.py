"""Test the belief over several poses of a stream: its prediction, its best pose, and when another
pose replaces that."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.tracking.motion import MotionConfig
from topoloc.tracking.pose_hypotheses import Candidate, PoseHypotheses

SIGMA = np.diag(np.full(6, 1e-4))
SECOND = 1_000_000_000
STEP_NS = SECOND // 10


def at(x: float, z: float = 0.0) -> Rigid3:
    return Rigid3(np.eye(3), np.array([x, 0.0, z]))


def one_of(*poses: Rigid3, sum_: float = 0.98) -> list[Candidate]:
    """Return equally probable candidates."""
    return [
        Candidate(pose, SIGMA, sum_ / len(poses), node_id) for node_id, pose in enumerate(poses)
    ]


def seen(
    hypotheses: PoseHypotheses, t_ns: int, *poses: Rigid3, odom_from_cam: Rigid3 | None = None
) -> None:
    """Process an image with these possible poses."""
    hypotheses.predict(t_ns, odom_from_cam)
    hypotheses.update_weights(t_ns, one_of(*poses), odom_from_cam)


def walked_a_second() -> PoseHypotheses:
    """Return the hypotheses of a camera that moved along x at 1 m/s for a second."""
    hypotheses = PoseHypotheses(MotionConfig())
    for tenth in range(11):
        seen(hypotheses, tenth * STEP_NS, at(tenth / 10))
    return hypotheses


def best_x(hypotheses: PoseHypotheses) -> float:
    assert hypotheses.best is not None
    return float(hypotheses.best.world_from_cam.translation[0])


def test_nothing_is_predicted_before_the_first_pose_nor_long_after_the_last():
    hypotheses = PoseHypotheses(MotionConfig())
    assert hypotheses.predict(SECOND) is None
    assert hypotheses.is_unambiguous
    hypotheses = walked_a_second()
    soon = hypotheses.predict(SECOND * 3 // 2)
    assert soon is not None
    assert hypotheses.is_track_continued
    assert translation_error(soon.world_from_cam, at(1.5)) < 0.05
    assert hypotheses.predict(SECOND * 21 // 10) is None
    assert not hypotheses.is_track_continued


@pytest.mark.parametrize(("new_evidence_ratio", "is_unambiguous"), [(1.0, True), (0.05, False)])
def test_an_uncertain_pose_is_reported_once_another_image_confirms_it(
    new_evidence_ratio: float, is_unambiguous: bool
):
    hypotheses = PoseHypotheses(MotionConfig())
    hypotheses.update_weights(0, one_of(at(0.0), sum_=0.8))
    assert not hypotheses.is_unambiguous
    hypotheses.predict(STEP_NS)
    hypotheses.update_weights(
        STEP_NS, one_of(at(0.1), sum_=0.8), new_evidence_ratio=new_evidence_ratio
    )
    assert hypotheses.is_unambiguous == is_unambiguous


def test_images_without_a_pose_lower_a_weak_belief():
    doubtful, established = PoseHypotheses(MotionConfig()), walked_a_second()
    doubtful.update_weights(0, one_of(at(0.0), sum_=0.95))
    assert doubtful.is_unambiguous
    for hypotheses in (doubtful, established):
        for _ in range(3):
            hypotheses.update_weights(SECOND, [])
    assert not doubtful.is_unambiguous
    assert established.is_unambiguous


def test_odometry_carries_further():
    hypotheses = PoseHypotheses(MotionConfig())
    seen(hypotheses, 0, at(5.0), odom_from_cam=at(100.0))
    late = hypotheses.predict(10 * SECOND, at(103.0))
    assert late is not None
    assert translation_error(late.world_from_cam, at(8.0)) < 1e-9
    assert hypotheses.predict(10 * SECOND) is None, "odometry that stops is none"


def test_a_jump_is_accepted_when_the_next_poses_agree():
    hypotheses, decided, followed = walked_a_second(), [], []
    for k in range(1, 4):
        seen(hypotheses, SECOND + k * STEP_NS, at(1.0 + 0.1 * k, z=6.0))
        decided.append(hypotheses.is_unambiguous)
        followed.append(hypotheses.is_track_continued)
    assert decided == [True, False, True], "in between it may be either"
    assert followed == [True, False, True]
    assert hypotheses.best is not None
    assert translation_error(hypotheses.best.world_from_cam, at(1.3, z=6.0)) < 0.02
    assert abs(hypotheses.best.velocity[0] - 1.0) < 0.3, (
        "what the rival has learnt of the velocity is kept"
    )


def test_random_poses_are_never_accepted():
    hypotheses, rng = walked_a_second(), np.random.default_rng(0)
    for k in range(1, 9):
        seen(hypotheses, SECOND + k * STEP_NS, Rigid3(np.eye(3), rng.uniform(-40, 40, 3)))
        assert best_x(hypotheses) == pytest.approx(1.0 + 0.1 * k, abs=0.05)


def test_one_wild_pose_is_forgotten():
    hypotheses = walked_a_second()
    seen(hypotheses, SECOND + STEP_NS, at(7.0))
    assert len(hypotheses.alternatives()) == 2
    for k in (2, 3):
        seen(hypotheses, SECOND + k * STEP_NS, at(1.0 + 0.1 * k))
    assert len(hypotheses.alternatives()) == 1


def test_the_motion_decides_between_alternatives_however_improbable_the_right_one():
    hypotheses = walked_a_second()
    shares = {-1.0: 0.5, 0.0: 0.15, 1.0: 0.3}
    for k in range(1, 5):
        x = 1.0 + 0.1 * k
        hypotheses.predict(SECOND + k * STEP_NS)
        hypotheses.update_weights(
            SECOND + k * STEP_NS,
            [Candidate(at(x + off), SIGMA, share, 0) for off, share in shares.items()],
        )
        assert hypotheses.is_unambiguous
        assert hypotheses.candidate_idx == 1
        assert best_x(hypotheses) == pytest.approx(x, abs=0.02)


def test_results_without_the_true_pose_keep_the_belief():
    hypotheses = walked_a_second()
    seen(hypotheses, SECOND + STEP_NS, at(5.1), at(6.1), at(7.1))
    assert hypotheses.is_unambiguous
    assert hypotheses.candidate_idx is None
    assert best_x(hypotheses) == pytest.approx(1.1, abs=0.02)


def test_equal_panels_stay_ambiguous_until_a_unique_place():
    hypotheses = PoseHypotheses(MotionConfig())
    for k in range(8):
        seen(
            hypotheses,
            k * STEP_NS,
            *(at(0.1 * k + panel) for panel in range(4)),
            odom_from_cam=at(0.1 * k),
        )
        assert not hypotheses.is_unambiguous
        alternatives = hypotheses.alternatives()
        assert len(alternatives) == 4
        assert sorted(
            round(float(one.world_from_cam.translation[0] - 0.1 * k), 2) for one in alternatives
        ) == [0.0, 1.0, 2.0, 3.0]
        assert 0.9 < sum(one.probability for one in alternatives) <= 1.0
    seen(hypotheses, 8 * STEP_NS, at(2.8), odom_from_cam=at(0.8))
    assert hypotheses.is_unambiguous
    assert best_x(hypotheses) == pytest.approx(2.8, abs=0.01)


def test_the_motion_selects_the_only_alternative_that_moves_like_the_camera():
    hypotheses, rng = PoseHypotheses(MotionConfig()), np.random.default_rng(2)
    decided = []
    for k in range(6):
        wrong = [at(x, z=20.0) for x in rng.uniform(-30, 30, 3)]
        seen(hypotheses, k * STEP_NS, *wrong, at(0.1 * k), odom_from_cam=at(0.1 * k))
        decided.append(hypotheses.is_unambiguous)
    assert not any(decided[:2])
    assert decided[-1]
    assert best_x(hypotheses) == pytest.approx(0.5, abs=0.02)


def test_followed_points_move_all_hypotheses():
    hypotheses = PoseHypotheses(MotionConfig())
    seen(hypotheses, 0, at(0.0), at(5.0))
    hypotheses.predict(STEP_NS)
    assert hypotheses.best is not None
    x = best_x(hypotheses)
    hypotheses.apply_motion(at(x + 0.3), SIGMA, None)
    assert sorted(
        float(one.world_from_cam.translation[0]) for one in hypotheses.alternatives()
    ) == pytest.approx([0.3, 5.3], abs=1e-3)
    seen(hypotheses, 2 * STEP_NS, at(0.6), at(5.9))
    assert best_x(hypotheses) == pytest.approx(0.6, abs=0.02), (
        "the other one would have to go twice as fast"
    )


def test_the_number_is_bounded():
    hypotheses = PoseHypotheses(MotionConfig())
    seen(hypotheses, 0, *(at(float(x)) for x in range(40)))
    assert len(hypotheses.alternatives()) == 24
    seen(hypotheses, STEP_NS, *(at(float(x)) for x in range(40)))
    assert len(hypotheses.alternatives()) <= 24
