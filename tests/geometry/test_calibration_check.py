"""Test the calibration estimate from one image, with points at known pixels."""

import numpy as np
import pytest

from topoloc.geometry.absolute_pose import estimate_absolute_pose
from topoloc.geometry.calibration_check import corrected_camera, estimate_image_calibration
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3

TRUE = Camera("OPENCV", 640, 480, (400.0, 404.0, 322.0, 236.0, -0.05, 0.01, 0.001, -0.001))
CAM_FROM_WORLD = Rigid3(exp_so3(np.array([0.1, -0.4, 0.2])), np.array([0.3, -0.2, 0.5]))


def room(
    rng: np.random.Generator, num_points: int = 300
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels with half a pixel of noise, points of 2 to 8 m depth, and their covariances."""
    pixels = rng.uniform([20.0, 20.0], [620.0, 460.0], (num_points, 2))
    rays = np.column_stack([TRUE.normalized_from_img(pixels), np.ones(num_points)])
    points = CAM_FROM_WORLD.inverse().apply(rays * rng.uniform(2.0, 8.0, (num_points, 1)))
    noisy = points + rng.normal(0.0, 0.005, points.shape)
    return (
        pixels + rng.normal(0.0, 0.5, pixels.shape),
        noisy,
        np.tile(0.005**2 * np.eye(3), (num_points, 1, 1)),
    )


def changed(scale: float, dx_px: float, dy_px: float) -> Camera:
    fx, fy, cx, cy, *distortion = TRUE.params
    return Camera(
        TRUE.model,
        TRUE.width,
        TRUE.height,
        (scale * fx, scale * fy, cx + dx_px, cy + dy_px, *distortion),
    )


@pytest.mark.parametrize(
    ("scale", "dx_px", "dy_px"),
    [(1.0, 0.0, 0.0), (1.06, 0.0, 0.0), (0.95, 0.0, 0.0), (1.0, 30.0, 0.0), (1.03, -20.0, 25.0)],
)
def test_the_camera_is_found_again(scale: float, dx_px: float, dy_px: float):
    pixels, points, covariances = room(np.random.default_rng(0))
    calibrated = changed(scale, dx_px, dy_px)
    pose = estimate_absolute_pose(pixels, points, calibrated, point_covariances=covariances)
    assert pose is not None
    rows = pose.inliers
    found = estimate_image_calibration(
        pixels[rows], points[rows], covariances[rows], calibrated, pose.cam_from_world, 0.5
    )
    assert found is not None
    camera, sigmas = corrected_camera(calibrated, found), np.sqrt(np.diag(found.covariance))
    assert abs(np.log(camera.fx / TRUE.fx)) < max(4.0 * sigmas[0], 0.01)
    assert abs(camera.cx - TRUE.cx) < max(
        4.0 * sigmas[1] * TRUE.fx, 4.0, 0.2 * abs(dx_px)
    )  # inliers are chosen by the wrong centre
    assert abs(camera.cy - TRUE.cy) < max(4.0 * sigmas[2] * TRUE.fx, 4.0, 0.2 * abs(dy_px))
    assert np.linalg.norm((found.cam_from_world @ CAM_FROM_WORLD.inverse()).translation) < 0.05
    assert camera.params[4:] == TRUE.params[4:]


def test_a_frontal_wall_leaves_the_focal_length_uncertain():
    rng = np.random.default_rng(1)
    wall = np.column_stack([rng.uniform(-2.0, 2.0, (200, 2)), np.full(200, 5.0)])
    pinhole, covariances = (
        Camera.pinhole(640, 480, 400.0, 400.0, 320.0, 240.0),
        np.tile(1e-6 * np.eye(3), (200, 1, 1)),
    )
    pixels = pinhole.img_from_cam(wall) + rng.normal(0.0, 0.5, (200, 2))
    found = estimate_image_calibration(pixels, wall, covariances, pinhole, Rigid3.identity(), 0.5)
    assert found is None or np.sqrt(found.covariance[0, 0]) > 0.02


def test_too_few_points_give_no_result():
    pixels, points, covariances = room(np.random.default_rng(2), 10)
    assert (
        estimate_image_calibration(pixels, points, covariances, TRUE, CAM_FROM_WORLD, 0.5) is None
    )
