"""Check poses of images whose width and height were scaled apart. Others keep square pixels."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.geometry.absolute_pose_focal import estimate_pose_and_focal
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.geometry.squeezed_image import estimate_pose_and_camera, is_scaled_apart

pytestmark = pytest.mark.usefixtures("solvers")

CAM_FROM_WORLD = Rigid3(exp_so3(np.array([0.2, -0.3, 0.1])), np.array([0.3, -0.2, 1.0]))
CONFIG = AbsolutePoseConfig(max_reprojection_error_px=4.0)


def seen(
    ratio: float, seed: int = 0, noise_px: float = 0.7
) -> tuple[np.ndarray, np.ndarray, np.ndarray, UncalibratedCamera]:
    """Return pixels of points 2 to 6 m away, a fifth of them wrong, in an image of 640 x 480 pixels
    whose rows were scaled by a ratio."""
    rng, height = np.random.default_rng(seed), round(480 * ratio)
    camera = Camera.pinhole(640, height, 500.0, 500.0 * ratio, 319.5, (height - 1) / 2)
    pixels = rng.uniform([0, 0], [639, height - 1], (200, 2))
    rays = np.column_stack([camera.normalized_from_img(pixels), np.ones(200)])
    points = CAM_FROM_WORLD.inverse().apply(rays * rng.uniform(2.0, 6.0, (200, 1)))
    pixels += rng.normal(0.0, noise_px, pixels.shape)
    pixels[:40] = rng.uniform([0, 0], [639, height - 1], (40, 2))
    return (
        pixels,
        points,
        np.tile(1e-6 * np.eye(3), (200, 1, 1)),
        UncalibratedCamera.unknown(640, height),
    )


@pytest.mark.parametrize("ratio", [0.8, 0.87, 1.12, 1.2, 1.28])
def test_the_ratio_of_the_focal_lengths_is_found(ratio: float):
    for seed in range(3):
        pixels, points, covariances, camera = seen(ratio, seed)
        found = estimate_pose_and_camera(
            pixels, points, camera, CONFIG, point_covariances=covariances
        )
        assert found is not None
        pose, seen_as = found
        assert seen_as.fy / seen_as.fx == pytest.approx(ratio, rel=0.02)
        assert (seen_as.width, seen_as.height) == (camera.width, camera.height)
        error = pose.cam_from_world @ CAM_FROM_WORLD.inverse()
        assert translation_error(error, Rigid3.identity()) < 0.15
        assert np.rad2deg(rotation_error(error, Rigid3.identity())) < 2.0
        shift = error.log()
        assert shift @ np.linalg.solve(pose.covariance, shift) < 40.0
        again = estimate_pose_and_camera(
            pixels,
            points,
            camera,
            CONFIG,
            point_covariances=covariances,
            start=(pose.cam_from_world, seen_as),
        )
        assert again is not None
        assert again[1].fy / again[1].fx == pytest.approx(seen_as.fy / seen_as.fx, rel=1e-3)


def test_a_whole_image_has_square_pixels():
    for seed in range(5):
        pixels, points, covariances, camera = seen(1.0, seed)
        found = estimate_pose_and_camera(
            pixels, points, camera, CONFIG, point_covariances=covariances
        )
        plain = estimate_pose_and_focal(
            pixels, points, camera, CONFIG, point_covariances=covariances
        )
        assert found is not None
        assert plain is not None
        assert found[1].fy == found[1].fx == pytest.approx(plain[1].fx)
        matrices = [one[0].cam_from_world.matrix() for one in (found, plain)]
        np.testing.assert_allclose(*matrices, atol=1e-9)


def test_nothing_is_found_among_wrong_matches():
    rng = np.random.default_rng(0)
    pixels, points, covariances, camera = seen(1.2)
    found = estimate_pose_and_camera(
        rng.permutation(pixels), points, camera, CONFIG, point_covariances=covariances
    )
    assert found is None or np.count_nonzero(found[0].inliers) < 30


@pytest.mark.parametrize("ratio", [0.8, 0.9, 1.0, 1.12, 1.25])
def test_first_matches_tell_that_rows_were_scaled_after_the_calibration(ratio: float):
    for seed in range(3):
        pixels, points, _, image = seen(ratio, seed)
        centre = (image.width - 1) / 2, (image.height - 1) / 2
        calibrated = Camera.pinhole(image.width, image.height, 500.0, 500.0, *centre)
        assert is_scaled_apart(pixels, points, calibrated, CONFIG) == (ratio != 1.0), seed
