"""Compare disparities of the rendered room with its exact depth."""

from __future__ import annotations

import numpy as np

import tiny_world
from room_frames import depth_frame, stereo_frame
from topoloc.points.metric_points import measure_disparities, measured_view
from topoloc.points.point_tracking import find_corners

BF = tiny_world.CAMERA.fx * tiny_world.BASELINE


def true_depths(corners: np.ndarray) -> np.ndarray:
    _, depth = tiny_world.render(tiny_world.room(), tiny_world.path_pose(2.0))
    return depth[tuple(corners.astype(int).T[::-1])]


def test_stereo_disparities_are_right_with_a_guess_and_without():
    measured = measured_view(stereo_frame(2.0))
    corners = find_corners(measured.view.grey, np.zeros((0, 2)))
    true = BF / true_depths(corners)
    for guesses in (np.full(len(corners), np.nan), true + 1.5):
        disparities, sigmas = measure_disparities(measured, corners, guesses)
        known = np.isfinite(disparities) & np.isfinite(true)
        assert known.mean() > 0.5
        assert np.median(np.abs(disparities - true)[known]) < 0.1
        assert (sigmas[known] >= 0.15).all()


def test_a_guess_that_is_far_off_finds_nothing_right():
    measured = measured_view(stereo_frame(2.0))
    corners = find_corners(measured.view.grey, np.zeros((0, 2)))
    far_off = BF / true_depths(corners) + 25.0
    disparities, _ = measure_disparities(measured, corners, far_off)
    assert np.isfinite(disparities).mean() < 0.1


def test_depth_answers_as_a_stereo_pair_would():
    measured = measured_view(depth_frame(2.0))
    corners = find_corners(measured.view.grey, np.zeros((0, 2)))
    disparities, sigmas = measure_disparities(measured, corners, np.full(len(corners), np.nan))
    known = np.isfinite(disparities)
    assert known.mean() > 0.5
    np.testing.assert_allclose(
        (measured.stereo.bf / disparities)[known], true_depths(corners)[known], rtol=0.03
    )
    assert (sigmas[known] > 0.0).all()
