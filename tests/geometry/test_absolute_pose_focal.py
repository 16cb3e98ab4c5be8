"""Test pose and focal length of an uncalibrated camera, from exact and from noisy matches."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.errors import CalibrationError
from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.geometry.absolute_pose_focal import estimate_pose_and_focal
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.camera import UncalibratedCamera
from topoloc.geometry.joint_camera.camera_hypotheses import (
    CameraBelief,
    CameraHypothesis,
    WeighedCamera,
)
from topoloc.geometry.rigid import Rigid3, exp_so3

pytestmark = pytest.mark.usefixtures("solvers")

CAM_FROM_WORLD = Rigid3(exp_so3(np.array([0.2, -0.3, 0.1])), np.array([0.3, -0.2, 1.0]))
UNKNOWN = UncalibratedCamera.unknown(640, 480)
CONFIG = AbsolutePoseConfig(max_reprojection_error_px=8.0)


def _scene(
    focal: float,
    rng: np.random.Generator,
    num: int = 200,
    depth: tuple[float, float] = (2.0, 6.0),
    noise_px: float = 0.0,
):
    camera = UNKNOWN.with_focal(focal)
    pixels = rng.uniform([0, 0], [639, 479], (num, 2))
    z = rng.uniform(*depth, num)
    points_cam = np.column_stack([camera.normalized_from_img(pixels) * z[:, None], z])
    points_world = CAM_FROM_WORLD.inverse().apply(points_cam)
    return (
        pixels + rng.normal(0.0, noise_px, pixels.shape) if noise_px else pixels,
        points_world,
        np.zeros((num, 3, 3)),
    )


@pytest.mark.parametrize("focal", [300.0, 525.0, 900.0, 1700.0])
def test_exact_matches_give_pose_and_focal_length_among_outliers(focal: float):
    rng = np.random.default_rng(0)
    pixels, points, covariances = _scene(focal, rng)
    pixels[:80] = rng.uniform([0, 0], [639, 479], (80, 2))
    found = estimate_pose_and_focal(pixels, points, UNKNOWN, CONFIG, point_covariances=covariances)
    assert found is not None
    pose, camera = found
    assert camera.fx == pytest.approx(focal, rel=0.01)
    assert translation_error(pose.cam_from_world.inverse(), CAM_FROM_WORLD.inverse()) < 0.03
    assert rotation_error(pose.cam_from_world, CAM_FROM_WORLD) < np.deg2rad(0.3)


@pytest.mark.parametrize(("num", "num_right"), [(40, 12), (60, 12), (100, 30)])
def test_the_right_focal_length_is_found_with_few_right_matches(num: int, num_right: int):
    num_found = 0
    for seed in range(20):
        rng, focal = np.random.default_rng(seed), (340.0, 680.0, 1020.0)[seed % 3]
        pixels, points, covariances = _scene(focal, rng, num, noise_px=1.0)
        wrong, right = np.split(rng.permutation(num), [num - num_right])
        pixels[wrong] = rng.uniform([0, 0], [639, 479], (len(wrong), 2))
        found = estimate_pose_and_focal(
            pixels, points, UNKNOWN, CONFIG, point_covariances=covariances
        )
        assert found is not None
        num_found += (
            found[1].fx == pytest.approx(focal, rel=0.1) and np.mean(found[0].inliers[right]) >= 0.8
        )
    assert num_found >= 18


def test_random_matches_agree_only_by_chance():
    rng = np.random.default_rng(0)
    for num in (15, 40, 100):
        pixels, points, covariances = _scene(600.0, rng, num=num)
        pixels = rng.uniform([0, 0], [639, 479], pixels.shape)
        found = estimate_pose_and_focal(
            pixels, points, UNKNOWN, CONFIG, point_covariances=covariances
        )
        assert found is None or np.count_nonzero(found[0].inliers) <= 14


def test_the_same_matches_give_the_same_bytes_and_useless_ones_change_nothing():
    pixels, points, covariances = _scene(800.0, np.random.default_rng(3), num=60, noise_px=1.0)
    pixels[:30] = pixels[30:]
    first, again = (
        estimate_pose_and_focal(pixels, points, UNKNOWN, CONFIG, point_covariances=covariances)
        for _ in range(2)
    )
    broken = (
        np.vstack([pixels, [np.nan, 1.0]]),
        np.vstack([points, [1.0, 2.0, 3.0]]),
        np.concatenate([covariances, covariances[:1]]),
    )
    with_broken = estimate_pose_and_focal(
        broken[0], broken[1], UNKNOWN, CONFIG, point_covariances=broken[2]
    )
    assert first is not None
    for other in (again, with_broken):
        assert other is not None
        assert first[1] == other[1]
        assert np.array_equal(first[0].cam_from_world.matrix(), other[0].cam_from_world.matrix())
        assert np.array_equal(first[0].covariance, other[0].covariance)
        assert np.array_equal(first[0].inliers, other[0].inliers[:60])


def test_near_and_far_inliers_are_found():
    """Near points also agree with a wrong focal length. A few rounds keep only them, without
    the far points."""
    street = UncalibratedCamera.unknown(1241, 376)
    for seed in range(12):
        rng, camera = np.random.default_rng(seed), street.with_focal(720.0)
        near = rng.uniform([0, 100, 5.0], [1240, 300, 6.5], (48, 3))
        far = rng.uniform([434, 120, 40.0], [806, 250, 48.0], (112, 3))
        pixels, z = np.split(np.vstack([near, far]), [2], axis=1)
        points = CAM_FROM_WORLD.inverse().apply(
            np.column_stack([camera.normalized_from_img(pixels), np.ones(160)]) * z
        )
        pixels += rng.normal(0.0, 1.0, pixels.shape)
        found = estimate_pose_and_focal(
            pixels, points, street, CONFIG, point_covariances=np.zeros((160, 3, 3))
        )
        assert found is not None
        assert found[1].fx == pytest.approx(720.0, rel=0.015)
        assert np.count_nonzero(found[0].inliers) >= 155


def test_the_covariance_includes_the_uncertainty_of_the_focal_length():
    distances, plain = [], []
    for seed in range(40):
        pixels, points, covariances = _scene(
            600.0, np.random.default_rng(seed), depth=(4.0, 4.6), noise_px=1.0
        )
        found = estimate_pose_and_focal(
            pixels, points, UNKNOWN, CONFIG, point_covariances=covariances
        )
        assert found is not None
        xi = (CAM_FROM_WORLD @ found[0].cam_from_world.inverse()).log()
        distances.append(float(xi @ np.linalg.solve(found[0].covariance, xi)))
        plain.append(float(np.sqrt(found[0].covariance[2, 2])))
    assert (
        0.5 < np.median(distances) < 9.0
    )  # chi-square of six degrees has median 5.3, and the principal point is central here
    assert np.median(plain) > 0.03, "distance and focal length trade places in a flat scene"


def test_a_start_is_refined_and_a_stated_focal_length_is_left_if_the_residuals_contradict_it():
    pixels, points, covariances = _scene(600.0, np.random.default_rng(1), noise_px=0.5)
    start = (CAM_FROM_WORLD, UNKNOWN.with_focal(560.0))
    found = estimate_pose_and_focal(
        pixels, points, UNKNOWN, CONFIG, point_covariances=covariances, start=start
    )
    assert found is not None
    assert found[1].fx == pytest.approx(600.0, rel=0.01)
    for guess in (580.0, 300.0):  # that of a whole image, of which this one is half
        narrow = UncalibratedCamera.from_focal_guess(640, 480, guess)
        found = estimate_pose_and_focal(
            pixels, points, narrow, CONFIG, point_covariances=covariances
        )
        assert found is not None
        assert found[1].fx == pytest.approx(600.0, rel=0.01)


def test_three_matches_give_nothing():
    pixels, points, covariances = _scene(600.0, np.random.default_rng(2), num=3)
    assert (
        estimate_pose_and_focal(pixels, points, UNKNOWN, CONFIG, point_covariances=covariances)
        is None
    )


def test_a_rough_camera_keeps_its_field_of_view_when_its_picture_is_resized():
    half = UNKNOWN.rescaled(320, 240)
    assert (half.min_focal, half.max_focal) == pytest.approx(
        (UNKNOWN.min_focal / 2, UNKNOWN.max_focal / 2)
    )


@pytest.mark.parametrize(
    "focals", [(0.0, 100.0), (200.0, 100.0), (float("nan"), 100.0), (10.0, float("inf"))]
)
def test_a_rough_camera_needs_a_range(focals: tuple[float, float]):
    with pytest.raises(CalibrationError, match="a range of focal lengths"):
        UncalibratedCamera(640, 480, *focals)


@pytest.mark.parametrize("left", [0, 64, 160])
def test_the_principal_point_is_estimated_if_a_side_was_cut_off(left: int):
    rng = np.random.default_rng(4)
    pixels, points, covariances = _scene(600.0, rng, num=300, noise_px=1.0)
    kept = pixels[:, 0] >= left
    cropped = UncalibratedCamera.unknown(640 - left, 480)
    found = estimate_pose_and_focal(
        pixels[kept] - [left, 0], points[kept], cropped, CONFIG, point_covariances=covariances[kept]
    )
    assert found is not None
    pose, camera = found
    if left:
        assert camera.cx == pytest.approx(319.5 - left, abs=8.0)
    else:
        assert camera.cx == pytest.approx(319.5, abs=1.0), "a whole image keeps its centre"
    assert rotation_error(pose.cam_from_world, CAM_FROM_WORLD) < np.deg2rad(0.8)
    assert pose.camera is not None
    assert pose.camera.probability_within(0.25, np.deg2rad(2.0)) > 0.9


def test_the_principal_point_of_a_whole_image_is_estimated_too():
    pixels, points, covariances = _scene(600.0, np.random.default_rng(4), num=300, noise_px=0.5)
    off = np.array([7.0, -3.0])
    found = estimate_pose_and_focal(
        pixels + off, points, UNKNOWN, CONFIG, point_covariances=covariances
    )
    assert found is not None
    pose, camera = found
    assert abs(camera.cx - (319.5 + off[0])) < 3.5, "nearer than the middle of the image"
    assert abs(camera.cy - (239.5 + off[1])) < 2.5
    assert rotation_error(pose.cam_from_world, CAM_FROM_WORLD) < np.deg2rad(0.4)


@pytest.mark.parametrize("k1", [-0.25, 0.1])
def test_radial_distortion_is_estimated_with_the_pose(k1: float):
    pixels, points, covariances = _scene(400.0, np.random.default_rng(5), num=300, noise_px=0.5)
    rays = UNKNOWN.with_focal(400.0).normalized_from_img(pixels)
    bent = rays * (1.0 + k1 * np.sum(rays**2, axis=1, keepdims=True)) * 400.0 + [319.5, 239.5]
    found = estimate_pose_and_focal(bent, points, UNKNOWN, CONFIG, point_covariances=covariances)
    assert found is not None
    assert found[1].distortion()[0] == pytest.approx(k1, abs=0.03)
    assert rotation_error(found[0].cam_from_world, CAM_FROM_WORLD) < np.deg2rad(0.8)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_fisheye_lens_does_not_look_off_centre(side: float):
    """A cubic term does not fit the lens up to its edge, and most points lie to one side."""
    rng, focal = np.random.default_rng(7), 250.0
    pixels, points, covariances = _scene(focal / 2.0, rng, num=900, noise_px=0.5)
    rays = UNKNOWN.with_focal(focal / 2.0).normalized_from_img(pixels)
    radii = np.linalg.norm(rays, axis=1, keepdims=True)
    bent = rays / radii * np.arctan(radii) * focal + [319.5, 239.5]
    kept = (radii[:, 0] < 1.3) & (side * rays[:, 0] > -0.15)
    found = estimate_pose_and_focal(
        bent[kept], points[kept], UNKNOWN, CONFIG, point_covariances=covariances[kept]
    )
    assert found is not None
    pose, camera = found
    assert camera.model == "RADIAL"
    assert rotation_error(pose.cam_from_world, CAM_FROM_WORLD) < np.deg2rad(1.0)


@pytest.mark.parametrize("start_px", [590.0, 610.0])
def test_a_start_outside_the_stated_range_moves_both_ways(start_px: float):
    """A crop keeps the focal length that EXIF data state for the whole image. With seven points, no
    other camera parameters are estimated."""
    pixels, points, covariances = _scene(600.0, np.random.default_rng(8), num=7)
    stated = UncalibratedCamera.from_focal_guess(640, 480, 300.0)
    start = (CAM_FROM_WORLD, stated.with_focal(start_px))
    found = estimate_pose_and_focal(
        pixels, points, stated, CONFIG, point_covariances=covariances, start=start
    )
    assert found is not None
    assert found[1].fx == pytest.approx(600.0, rel=0.01)


def test_the_probability_within_a_tolerance_counts_all_directions():
    rng = np.random.default_rng(9)
    for _ in range(20):
        root, mean = rng.normal(size=(3, 3)), rng.normal(size=3)
        errors = mean + rng.normal(size=(40_000, 3)) @ root.T
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = root @ root.T
        camera = WeighedCamera(CameraHypothesis(), 1.0, np.r_[mean, 0, 0, 0], covariance)
        share = float(np.mean(np.linalg.norm(errors, axis=1) < 2.0))
        belief = CameraBelief(camera.hypothesis, [camera])
        assert belief.probability_within(2.0, 1.0) == pytest.approx(share, abs=0.1)


def test_a_panorama_contradicts_all_camera_models():
    pixels, points, covariances = _scene(400.0, np.random.default_rng(6), num=400, noise_px=0.5)
    x, y = UNKNOWN.with_focal(400.0).normalized_from_img(pixels).T
    bent = np.column_stack([np.arctan(x), y / np.hypot(1.0, x)]) * 400.0 + [319.5, 239.5]
    found = estimate_pose_and_focal(bent, points, UNKNOWN, CONFIG, point_covariances=covariances)
    assert found is not None
    belief = found[0].camera
    assert belief is not None
    assert belief.is_contradicted
    metres = translation_error(found[0].cam_from_world.inverse(), CAM_FROM_WORLD.inverse())
    is_right = metres < 0.25 and rotation_error(found[0].cam_from_world, CAM_FROM_WORLD) < 0.035
    assert is_right or belief.probability_within(0.25, np.deg2rad(2.0)) < 0.5
