"""Test corners, and points tracked through shifts, scaling and changes of light."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import tiny_world
from topoloc.points.point_tracking import (
    align_with_reference,
    find_corners,
    track_points,
)

NUM_CORNERS = 120
SHIFT = np.array([3.3, -2.6], np.float32)


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    return tiny_world.render(tiny_world.room(), tiny_world.path_pose(4))[0]


def warped(picture: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Return the image shifted by SHIFT and scaled about its middle."""
    middle = (np.array(picture.shape[::-1]) - 1) / 2
    offset = middle - scale * middle + SHIFT
    matrix = np.array([[scale, 0.0, offset[0]], [0.0, scale, offset[1]]])
    return cv2.warpAffine(
        picture, matrix, picture.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


def test_corners_are_spread_and_keep_out_of_taken_cells(picture: np.ndarray):
    corners = find_corners(picture, np.zeros((0, 2)), num_corners=NUM_CORNERS)
    assert len(corners) > 60
    quarters = (corners > np.array(picture.shape[::-1]) / 2).astype(int) @ [1, 2]
    assert np.bincount(quarters, minlength=4).min() > 8
    assert len(find_corners(picture, corners, num_corners=NUM_CORNERS)) == 0
    assert (
        len(find_corners(np.full_like(picture, 90), np.zeros((0, 2)), num_corners=NUM_CORNERS)) == 0
    )


def test_points_are_followed_across_a_shift(picture: np.ndarray):
    corners = find_corners(picture, np.zeros((0, 2)), num_corners=NUM_CORNERS)
    found, is_found = track_points(picture, warped(picture), corners, corners)
    assert is_found.mean() > 0.9
    assert np.median(np.linalg.norm(found - corners - SHIFT, axis=1)[is_found]) < 0.1


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.6, 30.0)])
def test_alignment_removes_drift_in_any_light(picture: np.ndarray, gain: float, offset: float):
    corners = find_corners(picture, np.zeros((0, 2)), num_corners=NUM_CORNERS)
    rng = np.random.default_rng(0)
    start = (corners + SHIFT + rng.uniform(-0.8, 0.8, corners.shape)).astype(np.float32)
    moved = (gain * warped(picture).astype(np.float32) + offset).astype(np.float32)
    ones = np.ones(len(corners), np.float32)
    found = align_with_reference(picture.astype(np.float32), moved, corners, start, ones)
    assert found.is_matched.mean() > 0.7
    assert (
        np.median(np.linalg.norm(found.points_img - corners - SHIFT, axis=1)[found.is_matched])
        < 0.05
    )


def test_known_growth_is_allowed_for(picture: np.ndarray):
    corners = find_corners(picture, np.zeros((0, 2)), num_corners=NUM_CORNERS)
    middle, scale = (np.array(picture.shape[::-1]) - 1) / 2, 1.3
    true = ((corners - middle) * scale + middle + SHIFT).astype(np.float32)
    inside = ((true > 15) & (true < np.array(picture.shape[::-1]) - 15)).all(axis=1)
    corners, true = corners[inside], true[inside]
    grown = warped(picture, scale).astype(np.float32)
    results = {}
    for assumed in (1.0, scale):
        scales = np.full(len(corners), assumed, np.float32)
        found = align_with_reference(picture.astype(np.float32), grown, corners, true, scales)
        results[assumed] = (
            found.is_matched.sum(),
            np.median(np.linalg.norm(found.points_img - true, axis=1)[found.is_matched]),
        )
    assert results[scale][0] >= 0.95 * len(corners)
    assert results[scale][1] < 0.08
    assert results[scale][1] < results[1.0][1]


def test_a_point_that_became_something_else_is_let_go(picture: np.ndarray):
    corners = find_corners(picture, np.zeros((0, 2)), num_corners=NUM_CORNERS)
    other = tiny_world.render(tiny_world.room(seed=5), tiny_world.path_pose(4))[0].astype(
        np.float32
    )
    ones = np.ones(len(corners), np.float32)
    found = align_with_reference(picture.astype(np.float32), other, corners, corners, ones)
    assert found.is_matched.mean() < 0.25


def test_uncertain_points_have_larger_errors(picture: np.ndarray):
    corners = find_corners(picture, np.zeros((0, 2)), num_corners=NUM_CORNERS)
    levels = np.linspace(1, 16, picture.shape[1])  # ever more noise from left to right
    noisy = (
        warped(picture) + levels * np.random.default_rng(3).normal(0, 1, picture.shape)
    ).astype(np.float32)
    found = align_with_reference(
        picture.astype(np.float32),
        noisy,
        corners,
        corners + np.float32(SHIFT),
        np.ones(len(corners), np.float32),
    )
    off, sigmas = (
        np.linalg.norm(found.points_img - corners - SHIFT, axis=1)[found.is_matched],
        found.sigmas_px[found.is_matched],
    )
    assert np.median(off[sigmas > np.median(sigmas)]) > 1.5 * np.median(
        off[sigmas <= np.median(sigmas)]
    )
    assert 0.5 < np.median(off / sigmas) < 2.0
