"""Test what points at known pixels show of a camera: its calibration, and a rotation while its rows
were read."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.geometry.absolute_pose import estimate_absolute_pose
from topoloc.geometry.calibration_check import corrected_camera
from topoloc.geometry.camera import Camera
from topoloc.geometry.joint_camera.camera_hypotheses import CameraBelief, CameraHypothesis
from topoloc.geometry.joint_camera.joint_fit import CameraObservations
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.image_calibration_check import (
    ImageCalibration,
    SeenCamera,
    compare_with_calibration,
)

TRUE = Camera("OPENCV", 640, 480, (400.0, 404.0, 322.0, 236.0, -0.05, 0.01, 0.001, -0.001))
PINHOLE = Camera.pinhole(640, 480, 400.0, 400.0, 320.0, 240.0)
CAM_FROM_WORLD = Rigid3(exp_so3(np.array([0.1, -0.4, 0.2])), np.array([0.3, -0.2, 0.5]))
SIGMA_PX = 0.5
Room = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Pixels, points (metres) and their covariances."""


def room(turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0), num_points: int = 300) -> Room:
    """Return what a camera sees at depths of 2 to 8 m while it turns, with half a pixel of
    noise."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform([20.0, 20.0], [620.0, 460.0], (num_points, 2))
    rays = np.column_stack([TRUE.normalized_from_img(pixels), np.ones(num_points)])
    points_cam = rays * rng.uniform(2.0, 8.0, (num_points, 1))
    points = CAM_FROM_WORLD.inverse().apply(points_cam) + rng.normal(0.0, 0.005, points_cam.shape)
    times = (pixels[:, 1:] + 0.5) / TRUE.height - 0.5
    seen = TRUE.img_from_cam(points_cam + times * np.cross(np.deg2rad(turn_deg), points_cam))
    seen += rng.normal(0.0, SIGMA_PX, pixels.shape)
    return seen, points, np.tile(0.005**2 * np.eye(3), (num_points, 1, 1))


def compared(calibrated: Camera, seen: Room, may_turn: bool = True) -> ImageCalibration:
    """Return what the inliers of the pose by this calibration show."""
    pixels, points, covariances = seen
    pose = estimate_absolute_pose(pixels, points, calibrated, point_covariances=covariances)
    assert pose is not None
    rows = pose.inliers
    inliers = pixels[rows], points[rows], covariances[rows]
    return compare_with_calibration(
        CameraObservations.from_pixels(*inliers, calibrated, SIGMA_PX),
        lambda: CameraObservations.from_pixels(*seen, calibrated, SIGMA_PX, max_error_px=12.0),
        calibrated,
        pose.cam_from_world,
        may_turn=may_turn,
    )


def changed(scale: float = 1.0, dx_px: float = 0.0, dy_px: float = 0.0) -> Camera:
    fx, fy, cx, cy, *distortion = TRUE.params
    params = scale * fx, scale * fy, cx + dx_px, cy + dy_px, *distortion
    return Camera(TRUE.model, TRUE.width, TRUE.height, params)


@pytest.mark.parametrize(
    ("scale", "dx_px", "dy_px", "of"),
    [
        (1.06, 0.0, 0.0, {"focal_length"}),
        (0.95, 0.0, 0.0, {"focal_length"}),
        (1.0, 35.0, 0.0, {"principal_point"}),
        (1.0, 0.0, -35.0, {"principal_point"}),
        (1.08, -40.0, 35.0, {"focal_length", "principal_point"}),
    ],
)
def test_a_wrong_calibration_is_named_and_the_camera_found(
    scale: float, dx_px: float, dy_px: float, of: set[str]
):
    calibrated = changed(scale, dx_px, dy_px)
    found = compared(calibrated, room())
    assert found.doubt is not None
    assert found.other is not None
    assert found.seen is not None
    assert set(found.doubt.of) & of
    camera = corrected_camera(calibrated, found.seen.deviation)
    sigmas = np.sqrt(np.diag(found.seen.covariance))
    assert abs(np.log(camera.fx / TRUE.fx)) < max(4.0 * sigmas[0], 0.01)
    assert abs(camera.cx - TRUE.cx) < max(4.0 * sigmas[1] * TRUE.fx, 4.0)
    assert abs(camera.cy - TRUE.cy) < max(4.0 * sigmas[2] * TRUE.fx, 4.0)
    assert camera.params[4:] == TRUE.params[4:]
    error = (found.other.cam_from_world @ CAM_FROM_WORLD.inverse()).log()
    assert np.linalg.norm(error[:3]) < 0.03
    assert np.rad2deg(np.linalg.norm(error[3:])) < 0.7


def test_a_right_calibration_agrees():
    found = compared(TRUE, room())
    assert found.doubt is None
    assert found.other is None
    assert found.seen is not None
    sigmas = np.sqrt(np.diag(found.seen.covariance))
    assert np.all(np.abs(found.seen.deviation) < 4.0 * sigmas)


def test_things_that_were_moved_are_no_fault_of_the_camera():
    pixels, points, covariances = room()
    moved = (pixels[:, 0] > 400.0) & (pixels[:, 1] > 250.0)
    pixels[moved] += [3.0, -2.0]
    assert compared(TRUE, (pixels, points, covariances)).doubt is None


def test_a_frontal_wall_leaves_the_focal_length_uncertain():
    rng = np.random.default_rng(1)
    wall = np.column_stack([rng.uniform(-2.0, 2.0, (200, 2)), np.full(200, 5.0)])
    pixels = PINHOLE.img_from_cam(wall) + rng.normal(0.0, SIGMA_PX, (200, 2))
    observed = CameraObservations.from_pixels(
        pixels, wall, np.tile(1e-6 * np.eye(3), (200, 1, 1)), PINHOLE, SIGMA_PX
    )
    found = compare_with_calibration(
        observed, lambda: observed, PINHOLE, Rigid3.identity(), may_turn=True
    )
    assert found.doubt is None
    assert found.seen is not None
    assert np.sqrt(found.seen.covariance[0, 0]) > 0.02


@pytest.mark.parametrize("turn_deg", [(0.0, 1.0, 0.0), (1.5, -0.5, 0.0), (0.0, 0.3, 2.0)])
def test_a_rotation_is_found_with_the_pose_of_the_middle_row(
    turn_deg: tuple[float, float, float],
):
    seen = room(turn_deg)
    found = compared(TRUE, seen)
    assert found.doubt is None
    assert found.other is not None
    np.testing.assert_allclose(np.rad2deg(found.other.rotation), turn_deg, atol=0.15)
    error = (found.other.cam_from_world @ CAM_FROM_WORLD.inverse()).log()
    assert np.linalg.norm(error[:3]) < 0.02
    assert np.rad2deg(np.linalg.norm(error[3:])) < 0.1
    assert not np.any(getattr(compared(TRUE, seen, may_turn=False).other, "rotation", 0.0))


def turned(camera: Camera) -> SeenCamera:
    belief = CameraBelief(CameraHypothesis(is_turning=True), [])
    return SeenCamera(camera, CAM_FROM_WORLD, belief, np.deg2rad([0.0, 2.0, 0.0]))


def test_pixels_are_moved_to_their_positions_at_rest():
    pixels = np.array([[320.0, 0.0], [320.0, 239.5]], np.float32)
    first, middle = turned(PINHOLE).undo_rotation(pixels)
    np.testing.assert_allclose(middle, [320.0, 239.5])
    assert first[0] - 320.0 == pytest.approx(400.0 * np.deg2rad(1.0), rel=0.01)


def test_pixels_without_a_ray_stay():
    lens = Camera("SIMPLE_RADIAL", 640, 480, (300.0, 319.5, 239.5, -0.6))
    corner, inner = np.array([[0.0, 0.0], [300.0, 200.0]], np.float32)
    moved = turned(lens).undo_rotation(np.stack([corner, inner]))
    np.testing.assert_array_equal(moved[0], corner)
    assert 0.0 < np.linalg.norm(moved[1] - inner) < 5.0
