"""Dense descriptors: they agree with a map point where it is seen, and not where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.features.dense import DenseDescriptors

STRIDE = 4.0


def _scene(rows: int = 24, columns: int = 32, size: int = 16) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(size, rows, columns)).astype(np.float32)


def _of_points(planes: np.ndarray, points_img: np.ndarray) -> np.ndarray:
    """The unit descriptors in whose grid step these pixels lie."""
    columns, rows = np.floor((points_img.T + 0.5) / STRIDE).astype(int)
    descriptors = planes[:, rows, columns].T
    return np.ascontiguousarray(descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))


def _points(num: int) -> np.ndarray:
    return np.random.default_rng(4).uniform([20.0, 20.0], [107.0, 75.0], (num, 2))


def test_points_agree_where_they_are_seen_whatever_the_length_of_the_descriptors():
    planes, points = _scene(), _points(200)
    brighter = DenseDescriptors(7.0 * planes, STRIDE)
    assert brighter.agrees(points, _of_points(planes, points)).all()


@pytest.mark.parametrize(("steps", "share"), [(1, 1.0), (2, 0.0), (4, 0.0)])
def test_one_grid_step_is_forgiven_and_no_more(steps: int, share: float):
    planes, points = _scene(), _points(200)
    descriptors = _of_points(planes, points + np.array([steps * STRIDE, 0.0]))
    assert DenseDescriptors(planes, STRIDE).agrees(points, descriptors).mean() == share


def test_points_of_elsewhere_agree_by_chance_alone():
    points = _points(2000)
    other = np.random.default_rng(5).normal(size=(len(points), 16)).astype(np.float32)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    share = DenseDescriptors(_scene(), STRIDE).agrees(points, other).mean()
    assert share == pytest.approx(9 / 81, abs=0.03)  # one step around each of 81


def test_points_at_the_border_and_none_at_all():
    planes = _scene()
    corners = np.array([[0.0, 0.0], [127.4, 95.4], [-0.5, 95.4]])
    assert DenseDescriptors(planes, STRIDE).agrees(corners, _of_points(planes, np.maximum(corners, 0.0))).all()
    assert len(DenseDescriptors(planes, STRIDE).agrees(np.zeros((0, 2)), np.zeros((0, 16), np.float32))) == 0
