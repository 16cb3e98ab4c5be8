"""Test the joint adjustment of localized images: averaged noise, a rejected
outlier, and a reset."""

from __future__ import annotations

import numpy as np

from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.tracking.tracker_state import PoseWindow

FIRST = Rigid3(exp_so3(np.array([0.2, -0.4, 0.1])), np.array([3.0, -1.0, 5.0]))
STEP = Rigid3(exp_so3(np.array([0.0, 0.05, 0.0])), np.array([0.1, 0.0, 0.02]))
MEASURED, MOVED = (np.diag(np.repeat([sigma**2, (sigma / 2) ** 2], 3)) for sigma in (0.02, 0.001))


def truths(num: int) -> list[Rigid3]:
    poses = [FIRST]
    for _ in range(num - 1):
        poses.append(STEP @ poses[-1])
    return poses


def test_noise_shrinks_with_the_number_of_pictures():
    rng = np.random.default_rng(0)
    raw, smoothed = [], []
    window = PoseWindow()
    for truth in truths(60):
        measured = Rigid3.exp(rng.multivariate_normal(np.zeros(6), MEASURED)) @ truth
        step = Rigid3.exp(rng.multivariate_normal(np.zeros(6), MOVED)) @ STEP
        smoothed.append(
            translation_error(
                window.add(measured, MEASURED, step, MOVED)[0].inverse(), truth.inverse()
            )
        )
        raw.append(translation_error(measured.inverse(), truth.inverse()))
    assert np.mean(smoothed[10:]) < 0.5 * np.mean(raw[10:])


def test_an_outlier_is_outvoted():
    window, smoothed = PoseWindow(), FIRST
    for number, truth in enumerate(truths(8)):
        wrong = Rigid3(np.eye(3), np.array([0.5, 0.0, 0.0])) if number == 7 else Rigid3.identity()
        smoothed, _ = window.add(wrong @ truth, MEASURED, STEP, MOVED)
    assert translation_error(smoothed.inverse(), truths(8)[-1].inverse()) < 0.02


def test_a_cleared_window_begins_at_the_next_pose():
    window = PoseWindow(size=4)
    for truth in truths(6):
        window.add(truth, MEASURED, STEP, MOVED)
    window.clear()
    elsewhere = Rigid3(np.eye(3), np.array([-20.0, 0.0, 0.0]))
    smoothed, covariance = window.add(elsewhere, MEASURED, STEP, MOVED)
    assert translation_error(smoothed, elsewhere) < 1e-6
    np.testing.assert_array_equal(covariance, MEASURED)


def test_the_covariance_is_that_of_the_errors():
    rng = np.random.default_rng(2)
    squares = []
    for _ in range(40):
        window, smoothed, covariance = PoseWindow(), FIRST, MEASURED
        for truth in truths(8):
            measured = Rigid3.exp(rng.multivariate_normal(np.zeros(6), MEASURED)) @ truth
            step = Rigid3.exp(rng.multivariate_normal(np.zeros(6), MOVED)) @ STEP
            smoothed, covariance = window.add(measured, MEASURED, step, MOVED)
        error = (truths(8)[-1] @ smoothed.inverse()).log()
        squares.append(error @ np.linalg.solve(covariance, error))
    # mean of 40 times 6 squared normals: 6 with a standard error of 0.55
    assert 4.4 < np.mean(squares) < 7.7
