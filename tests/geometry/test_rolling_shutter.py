"""Test poses of a camera that turns while its rows are read."""

from __future__ import annotations

import numpy as np
import pytest
from topoloc.geometry.rolling_shutter import TurningCamera, find_rotation

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

CAMERA = Camera.pinhole(640, 480, 500.0, 500.0, 319.5, 239.5)
CAM_FROM_WORLD = Rigid3.exp(np.array([0.2, -0.1, 0.3, 0.1, -0.2, 0.05]))
SIGMA_PX = 0.7


def _found(turn_deg: list[float], start: Rigid3 = CAM_FROM_WORLD) -> TurningCamera | None:
    """Return the result for 300 points whose rows were read while the camera turned."""
    rng = np.random.default_rng(3)
    pixels = rng.uniform([0.0, 0.0], [640.0, 480.0], (300, 2))
    points_cam = np.column_stack([CAMERA.normalized_from_img(pixels), np.ones(300)])
    points_cam *= rng.uniform(1.5, 6.0, (300, 1))
    shares = (pixels[:, 1] + 0.5) / 480 - 0.5
    turn = shares[:, None] * np.deg2rad(turn_deg)
    read = CAMERA.img_from_cam(points_cam + np.cross(turn, points_cam))
    read += rng.normal(0.0, SIGMA_PX, (300, 2))
    points_world = CAM_FROM_WORLD.inverse().apply(points_cam)
    covariances = np.tile(1e-8 * np.eye(3), (300, 1, 1))
    return find_rotation(read, points_world, covariances, SIGMA_PX, CAMERA, start)


@pytest.mark.parametrize("turn_deg", [[0.0, 1.0, 0.0], [1.5, -0.5, 0.0], [0.0, 0.3, 2.0]])
def test_a_rotation_is_found_with_the_pose_of_the_middle_row(turn_deg: list[float]):
    off = Rigid3.exp(np.array([0.02, -0.01, 0.0, 0.004, 0.0, 0.006]))
    found = _found(turn_deg, off @ CAM_FROM_WORLD)
    assert found is not None
    np.testing.assert_allclose(np.rad2deg(found.rotation), turn_deg, atol=0.15)
    error = (found.cam_from_world @ CAM_FROM_WORLD.inverse()).log()
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.rad2deg(np.linalg.norm(error[3:])) < 0.1


def test_a_camera_at_rest_is_left_alone():
    assert _found([0.0, 0.0, 0.0]) is None


def test_pixels_are_moved_to_their_positions_at_rest():
    found = TurningCamera(CAM_FROM_WORLD, np.deg2rad([0.0, 2.0, 0.0]), np.eye(6), 480)
    first, middle = found.undo(np.array([[319.5, 0.0], [319.5, 239.5]]), CAMERA)
    np.testing.assert_allclose(middle, [319.5, 239.5])
    assert first[0] - 319.5 == pytest.approx(500.0 * np.deg2rad(1.0), rel=0.01)


def test_pixels_without_a_ray_stay():
    found = TurningCamera(CAM_FROM_WORLD, np.deg2rad([0.0, 2.0, 0.0]), np.eye(6), 480)
    lens = Camera("SIMPLE_RADIAL", 640, 480, (300.0, 319.5, 239.5, -0.6))
    corner, inner = np.array([[0.0, 0.0], [300.0, 200.0]])
    moved = found.undo(np.array([corner, inner]), lens)
    np.testing.assert_array_equal(moved[0], corner)
    assert 0.0 < np.linalg.norm(moved[1] - inner) < 5.0
