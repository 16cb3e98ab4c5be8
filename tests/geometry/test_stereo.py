import numpy as np
import pytest
from geometry_strategies import CAMERAS
from hypothesis import given, strategies as st

from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import (
    StereoRig,
    depth_from_disparity,
    depth_sigmas,
    depth_sigmas_of_disparity,
    points_from_depth,
    ray_covariances,
)
from topoloc.geometry.rigid import Rigid3

LEFT = Camera.pinhole(640, 480, 500.0, 505.0, 320.0, 240.0)
RIG = StereoRig.rectified(LEFT, 0.12)
# Rectified, but its principal points differ, as some calibrations have it: disparity at infinity is
# 5 px.
SHIFTED = StereoRig(LEFT, Camera.pinhole(640, 480, 500.0, 505.0, 315.0, 240.0), RIG.right_from_left)


@pytest.mark.parametrize("rig", [RIG, SHIFTED])
@given(x=st.floats(-5.0, 5.0), y=st.floats(-5.0, 5.0), z=st.floats(0.2, 200.0))
def test_points_come_back_from_their_two_images(rig, x, y, z):
    point_cam = np.array([[x, y, z]])
    left, right = (
        rig.left.img_from_cam(point_cam),
        rig.right.img_from_cam(rig.right_from_left.apply(point_cam)),
    )
    assert left[0, 1] == pytest.approx(right[0, 1])
    disparity_px = left[:, 0] - right[:, 0]
    np.testing.assert_allclose(depth_from_disparity(disparity_px, rig), [z], rtol=1e-6)
    depth = depth_from_disparity(disparity_px, rig)
    points_cam = points_from_depth(left, depth, rig.left)
    np.testing.assert_allclose(points_cam, point_cam, rtol=1e-6, atol=1e-6)


def test_no_depth_without_disparity():
    assert np.isnan(depth_from_disparity(np.array([0.0, -1.0, np.nan]), RIG)).all()
    assert np.isnan(depth_from_disparity(np.array([4.0]), SHIFTED)).all()
    assert np.isnan(
        points_from_depth(np.full((3, 2), 100.0), np.array([0.0, -1.0, np.nan]), LEFT)
    ).all()


def test_stereo_covariance_agrees_with_samples():
    rng = np.random.default_rng(5)
    point_cam = np.array([[1.0, -0.7, 4.0]])
    pixel, disparity_px = RIG.left.img_from_cam(point_cam), LEFT.fx * RIG.baseline / point_cam[:, 2]
    n = 100_000
    depth = depth_from_disparity(disparity_px + 0.3 * rng.normal(size=n), RIG)
    samples = points_from_depth(pixel + 0.8 * rng.normal(size=(n, 2)), depth, RIG.left)
    sigma_z = depth_sigmas_of_disparity(point_cam[:, 2], np.array([0.3]), RIG)
    expected = ray_covariances(point_cam, sigma_z, RIG.left, np.array([0.8]))[0]
    np.testing.assert_allclose(np.cov(samples.T), expected, rtol=0.05, atol=0.03 * expected.max())


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
def test_depth_covariance_agrees_with_samples(model):
    rng = np.random.default_rng(6)
    camera = CAMERAS[model]
    pixel = np.array([[0.85 * camera.width, 0.2 * camera.height]])
    point_cam = points_from_depth(pixel, np.array([3.0]), camera)
    n = 100_000
    depths = 3.0 + rng.normal(size=n) * (0.0012 + 0.0019 * 2.6**2)
    samples = points_from_depth(pixel + 2.0 * rng.normal(size=(n, 2)), depths, camera)
    expected = ray_covariances(point_cam, depth_sigmas(point_cam[:, 2]), camera, np.array([2.0]))[0]
    np.testing.assert_allclose(np.cov(samples.T), expected, rtol=0.05, atol=0.03 * expected.max())


def test_stereo_uncertainty_in_depth_grows_with_its_square():
    near, far = depth_sigmas_of_disparity(np.array([2.0, 4.0]), np.full(2, 0.3), RIG)
    assert far / near == pytest.approx(4.0)


def test_no_points_have_no_covariance():
    assert ray_covariances(np.zeros((0, 3)), np.zeros(0), CAMERAS["OPENCV"], np.zeros(0)).shape == (
        0,
        3,
        3,
    )


def test_rectified_rig_is_recognised():
    assert RIG.is_rectified
    assert SHIFTED.is_rectified
    assert not StereoRig(LEFT, LEFT, Rigid3(np.eye(3), np.array([-0.12, 0.01, 0.0]))).is_rectified
    assert not StereoRig(CAMERAS["OPENCV"], CAMERAS["OPENCV"], RIG.right_from_left).is_rectified
