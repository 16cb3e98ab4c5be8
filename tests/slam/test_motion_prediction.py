from __future__ import annotations

import numpy as np
import pytest

from topoloc.geometry.rigid import Rigid3
from topoloc.slam.motion_prediction import (
    MotionHistory,
    Prediction,
    select_expected_pose,
)

WAY_SHARE = 0.1  # of a prediction after a gap
TENTH = 100_000_000


def ahead(metres: float) -> Rigid3:
    """Return cam_from_world of a camera `metres` along x."""
    return Rigid3(np.eye(3), np.array([-metres, 0.0, 0.0]))


def walked(places: list[float]) -> MotionHistory:
    history = MotionHistory()
    before = None
    for number, place in enumerate(places):
        pose = ahead(place)
        history.add_pose(number * TENTH, pose, None if before is None else pose @ before.inverse())
        before = pose
    return history


def predicted(history: MotionHistory, frames: float) -> Prediction:
    found = history.predict(round(9 * TENTH + frames * TENTH))
    assert found is not None
    return found


def test_a_steady_walk_goes_on():
    history = walked([0.1 * k for k in range(10)])
    for frames in (1, 5):
        assert -predicted(history, frames).cam_from_world.translation[0] == pytest.approx(
            0.9 + 0.1 * frames
        )
    assert not predicted(history, 1).is_gap
    assert predicted(history, 5).is_gap
    assert predicted(history, 5).sigma == pytest.approx(WAY_SHARE * 0.5, rel=0.01)


def test_an_unsteady_walk_is_trusted_less_and_less_as_time_goes():
    steps = 0.1 + 0.02 * np.array([0, 1, -1, 1, 1, -1, 0, -1, 1, -1])
    history = walked(list(np.cumsum(steps)))
    three, six = predicted(history, 3).sigma, predicted(history, 6).sigma
    assert three > WAY_SHARE * 0.3
    assert six / three == pytest.approx((6 * 7) / (3 * 4), rel=0.05)


def test_sigma_covers_acceleration():
    """For walks with random acceleration, compare the error of a prediction over four frames
    with its sigma."""
    rng = np.random.default_rng(0)
    distances = []
    for _ in range(200):
        speeds = 0.1 + np.cumsum(rng.normal(0.0, 0.01, 14))
        places = np.cumsum(speeds)
        prediction = predicted(walked(list(places[:10])), 4)
        distances.append(prediction.distance(ahead(float(places[13]))))
    assert np.mean(np.array(distances) < prediction.max_sigmas) > 0.99
    assert np.median(distances) > 0.1, "nor is it boundless"


def test_nothing_is_predicted_before_any_motion():
    history = MotionHistory()
    assert history.predict(0) is None
    history.add_pose(0, ahead(0.0))
    first = history.predict(TENTH)
    assert first is not None
    assert first.sigma == np.inf
    assert first.distance(ahead(3.0)) == 0.0
    history.reset()
    assert history.predict(TENTH) is None


def test_the_motion_singles_out_one_of_two_or_none():
    gap = predicted(walked([0.1 * k for k in range(10)]), 5)
    near, far, half = ahead(1.42), ahead(2.42), ahead(1.9)
    assert select_expected_pose(gap, [far, near]) is near
    assert select_expected_pose(gap, [half, ahead(0.9)]) is None, "half a metre to either side"
    assert select_expected_pose(gap, [ahead(1.42), ahead(1.45)]) is None
    assert select_expected_pose(gap, [far]) is far, "alone, it has no rival"
    assert select_expected_pose(None, [near, far]) is None


def test_of_an_unknown_motion_the_least_is_expected_if_others_are_twice_as_far():
    begun = walked([0.0, 0.3]).predict(2 * TENTH)
    assert begun is not None
    assert np.isinf(begun.sigma)
    near, back = ahead(0.55), ahead(-0.45)
    assert select_expected_pose(begun, [back, near]) is near
    assert select_expected_pose(begun, [ahead(0.1), ahead(1.1)]) is None
    lost = walked([0.0]).predict(TENTH, is_gap=True)
    assert lost is not None
    assert select_expected_pose(lost, [ahead(0.0), ahead(1.0)]) is None, "frames were lost"
