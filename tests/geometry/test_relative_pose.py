"""Test the motion of a single camera between two images: rotation and direction despite wrong
matches, or nothing."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.geometry.camera import Camera
from topoloc.geometry.relative_pose import estimate_relative_pose
from topoloc.geometry.rigid import Rigid3, exp_so3

pytestmark = pytest.mark.usefixtures("solvers")

FIRST = Camera.pinhole(640, 400, 380.0, 380.0, 319.5, 199.5)
SECOND = Camera("OPENCV", 640, 480, (420.0, 421.0, 318.0, 241.0, -0.05, 0.01, 0.0, 0.0))


def seen(second_from_first: Rigid3, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels of 300 points, 2 to 8 m away, in both cameras, with 0.3 pixels of noise. A
    third is wrong in the second image."""
    rng = np.random.default_rng(seed)
    depths = rng.uniform(2.0, 8.0, 300)
    points = np.column_stack([rng.uniform(-0.6, 0.6, (300, 2)) * depths[:, None], depths])
    first, second = FIRST.img_from_cam(points), SECOND.img_from_cam(second_from_first.apply(points))
    wrong = rng.random(300) < 0.33
    second[wrong] = rng.uniform(0.0, 400.0, (np.count_nonzero(wrong), 2))
    return first + rng.normal(0.0, 0.3, first.shape), second + rng.normal(0.0, 0.3, second.shape)


@pytest.mark.parametrize("way", [(0.5, 0.0, 0.0), (0.1, -0.1, 0.6), (-0.3, 0.2, -0.2)])
def test_turn_and_direction_are_found(way: tuple[float, float, float]):
    truth = Rigid3(exp_so3(np.array([0.05, -0.12, 0.04])), np.array(way))
    found = estimate_relative_pose(seen(truth)[0], FIRST, seen(truth)[1], SECOND)
    assert found is not None
    assert np.linalg.norm(found.second_from_first.translation) == pytest.approx(1.0)
    direction = truth.translation / np.linalg.norm(truth.translation)
    assert np.degrees(np.arccos(found.second_from_first.translation @ direction)) < 3.0
    assert (
        np.degrees((found.second_from_first @ Rigid3(truth.rotation, direction).inverse()).angle())
        < 0.5
    )
    assert 150 < np.count_nonzero(found.inliers) < 240


def test_a_camera_that_only_turns_has_no_direction():
    turned = Rigid3(exp_so3(np.array([0.02, 0.1, 0.0])), np.zeros(3))
    assert estimate_relative_pose(seen(turned)[0], FIRST, seen(turned)[1], SECOND) is None


@pytest.mark.parametrize("num_points", [0, 5, 7])
def test_too_few_points_give_no_result(num_points: int):
    first, second = seen(Rigid3(np.eye(3), np.array([0.5, 0.0, 0.0])))
    assert estimate_relative_pose(first[:num_points], FIRST, second[:num_points], SECOND) is None
