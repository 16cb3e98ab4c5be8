"""Check that dense descriptors agree with a map point at its pixel, and not at other pixels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from topoloc.features.dense import SingleLevelDescriptors, TwoLevelDescriptors

STRIDE = 4.0


def _scene(rows: int = 24, columns: int = 32, size: int = 16) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(size, rows, columns)).astype(np.float32)


def _of_points(planes: np.ndarray, points_img: np.ndarray) -> np.ndarray:
    """Return the unit descriptors of the grid cells that contain these pixels."""
    columns, rows = np.floor((points_img.T + 0.5) / STRIDE).astype(int)
    descriptors = planes[:, rows, columns].T
    return np.ascontiguousarray(descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))


def _points(num: int) -> np.ndarray:
    return np.random.default_rng(4).uniform([20.0, 20.0], [107.0, 75.0], (num, 2))


def test_points_agree_at_their_pixels_for_any_length_of_the_descriptors():
    planes, points = _scene(), _points(200)
    brighter = SingleLevelDescriptors(7.0 * planes, STRIDE)
    assert brighter.check_agreement(points, _of_points(planes, points)).all()


@pytest.mark.parametrize(("steps", "share"), [(1, 1.0), (2, 0.0), (4, 0.0)])
def test_one_grid_step_is_tolerated_and_no_more(steps: int, share: float):
    planes, points = _scene(), _points(200)
    descriptors = _of_points(planes, points + np.array([steps * STRIDE, 0.0]))
    assert (
        SingleLevelDescriptors(planes, STRIDE).check_agreement(points, descriptors).mean() == share
    )


def test_points_of_elsewhere_agree_by_chance_alone():
    points = _points(2000)
    other = np.random.default_rng(5).normal(size=(len(points), 16)).astype(np.float32)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    share = SingleLevelDescriptors(_scene(), STRIDE).check_agreement(points, other).mean()
    assert share == pytest.approx(9 / 81, abs=0.03)  # one step around each of 81


def test_points_at_the_border_and_none_at_all():
    planes = _scene()
    corners = np.array([[0.0, 0.0], [127.4, 95.4], [-0.5, 95.4]])
    assert (
        SingleLevelDescriptors(planes, STRIDE)
        .check_agreement(corners, _of_points(planes, np.maximum(corners, 0.0)))
        .all()
    )
    assert (
        len(
            SingleLevelDescriptors(planes, STRIDE).check_agreement(
                np.zeros((0, 2)), np.zeros((0, 16), np.float32)
            )
        )
        == 0
    )


def test_two_levels_are_the_sum_of_the_coarse_one_enlarged_and_the_fine_one_weighted():
    rng = np.random.default_rng(6)
    coarse, fine, weights = (
        rng.normal(size=size).astype(np.float32) for size in ((6, 8, 16), (12, 16, 4), (4, 16))
    )
    enlarged = np.stack(
        [cv2.resize(coarse[..., k], (16, 12), interpolation=cv2.INTER_LINEAR) for k in range(16)],
        axis=-1,
    )
    whole = SingleLevelDescriptors(
        np.ascontiguousarray((enlarged + fine @ weights).transpose(2, 0, 1)), STRIDE
    )
    levels = TwoLevelDescriptors(coarse, fine, weights, STRIDE)
    assert levels.size == whole.size == 16
    points = rng.uniform(-0.5, [63.4, 47.4], (500, 2)).astype(np.float32)
    points[:4] = [(-0.5, -0.5), (63.4, 47.4), (0.0, 47.4), (63.4, 0.0)]
    np.testing.assert_allclose(levels.sample(points), whole.sample(points), atol=2e-6)
    np.testing.assert_allclose(levels.grid, whole.grid, atol=2e-6)
    descriptors = whole.sample(rng.permutation(points))
    np.testing.assert_array_equal(
        levels.check_agreement(points, descriptors), whole.check_agreement(points, descriptors)
    )
