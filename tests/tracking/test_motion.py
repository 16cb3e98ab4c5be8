"""Test the motion model with cameras of known motion."""

from __future__ import annotations

import numpy as np

from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.tracking.motion import (
    MotionConfig,
    MotionState,
    predict_motion,
    start_motion,
    update_motion,
)

CONFIG = MotionConfig()
STEP_NS = 50_000_000
VELOCITY = np.array([0.4, 0.0, 1.0, 0.0, 0.5, 0.0])
SIGMA = np.diag(np.repeat([0.003**2, 0.002**2], 3))


def pose_at(seconds: float) -> Rigid3:
    """Return the pose of a camera on an arc, far from the origin of the world."""
    return Rigid3(exp_so3(np.array([0.3, -1.0, 0.2])), np.array([40.0, -7.0, 2.0])) @ Rigid3.exp(
        seconds * VELOCITY
    )


def followed(num: int, noise: bool = False) -> MotionState:
    """Return the state after `num` measured poses."""
    rng = np.random.default_rng(0)
    state = start_motion(0, pose_at(0.0), SIGMA)
    for number in range(1, num):
        predicted = predict_motion(state, number * STEP_NS, CONFIG)
        error = rng.multivariate_normal(np.zeros(6), SIGMA) if noise else np.zeros(6)
        state = update_motion(predicted, pose_at(number * STEP_NS / 1e9) @ Rigid3.exp(error), SIGMA)
    return state


def test_a_steady_motion_is_predicted():
    state = followed(20)
    np.testing.assert_allclose(state.velocity, VELOCITY, atol=0.02)
    predicted = predict_motion(state, state.t_ns + 4 * STEP_NS, CONFIG)
    truth = pose_at(predicted.t_ns / 1e9)
    assert translation_error(predicted.world_from_cam, truth) < 0.005
    assert rotation_error(predicted.world_from_cam, truth) < 0.005


def test_a_wrong_velocity_is_forgotten_with_exact_poses_and_uneven_times():
    exact = np.diag(np.full(6, 1e-12))
    state = start_motion(0, pose_at(0.0), exact)
    state = MotionState(
        0,
        state.world_from_cam,
        VELOCITY + np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        np.diag(np.repeat([1e-12, 1.0], 6)),
    )
    t_ns = 0
    for number in range(40):
        t_ns += (5 if number % 2 else 10) * STEP_NS
        state = update_motion(predict_motion(state, t_ns, CONFIG), pose_at(t_ns / 1e9), exact)
    np.testing.assert_allclose(state.velocity, VELOCITY, atol=1e-3)


def test_an_unmeasured_camera_becomes_less_certain_and_stays_after_a_second():
    state = followed(20)
    sigmas = [
        np.sqrt(np.trace(predict_motion(state, state.t_ns + k * STEP_NS, CONFIG).pose_covariance))
        for k in range(1, 60)
    ]
    assert np.all(np.diff(sigmas) > 0)
    one, three = (
        predict_motion(state, state.t_ns + seconds * 1_000_000_000, CONFIG).world_from_cam
        for seconds in (1, 3)
    )
    assert translation_error(one, three) < 1e-9


def _square(predicted: MotionState, world_from_cam: Rigid3) -> float:
    return predicted.world_from_cam.squared_distance(
        world_from_cam, predicted.pose_covariance + SIGMA
    )


def test_surprise_distinguishes_noise_from_a_jump_at_any_origin():
    state = predict_motion(followed(20, noise=True), 20 * STEP_NS, CONFIG)
    truth = pose_at(1.0)
    assert _square(state, truth) < 33.0
    aside = truth @ Rigid3(np.eye(3), np.array([0.3, 0.0, 0.0]))
    turned = truth @ Rigid3(exp_so3(np.array([0.0, 0.2, 0.0])), np.zeros(3))
    assert min(_square(state, aside), _square(state, turned)) > 66.0


def test_a_camera_seen_once_may_be_on_a_car():
    state = predict_motion(start_motion(0, pose_at(0.0), SIGMA), STEP_NS * 2, CONFIG)
    assert _square(state, pose_at(0.0) @ Rigid3(np.eye(3), np.array([0.0, 0.0, 2.0]))) < 33.0


def test_noise_is_averaged():
    rng = np.random.default_rng(1)
    config = MotionConfig(sigma_acceleration=0.2, sigma_angular_acceleration=0.2)
    state = start_motion(0, pose_at(0.0), SIGMA)
    raw, filtered = [], []
    for number in range(1, 80):
        truth = pose_at(number * STEP_NS / 1e9)
        measured = truth @ Rigid3.exp(rng.multivariate_normal(np.zeros(6), SIGMA))
        state = update_motion(predict_motion(state, number * STEP_NS, config), measured, SIGMA)
        raw.append(translation_error(measured, truth))
        filtered.append(translation_error(state.world_from_cam, truth))
    # a tracking index of 0.17 leaves 0.44 of the variance (Kalata, 1984)
    assert np.mean(filtered[20:]) < 0.7 * np.mean(raw[20:])


def test_odometry_replaces_the_velocity():
    share = 0.05  # relative error of the odometry
    state = start_motion(0, pose_at(0.0), SIGMA)
    motion = pose_at(0.0).inverse() @ pose_at(2.0)
    predicted = predict_motion(state, 2_000_000_000, CONFIG, motion)
    assert translation_error(predicted.world_from_cam, pose_at(2.0)) < 1e-9
    np.testing.assert_allclose(predicted.velocity, VELOCITY, atol=1e-9)
    sigma = np.sqrt(predicted.pose_covariance[2, 2])
    assert (
        share * np.linalg.norm(motion.translation)
        < sigma
        < 3 * share * np.linalg.norm(motion.translation)
    )
