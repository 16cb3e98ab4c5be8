import warnings
from dataclasses import dataclass

import numpy as np
import pytest
from geometry_strategies import CAMERAS, random_rigid
from hypothesis import given, settings, strategies as st

from topoloc.geometry.absolute_pose import (
    AbsolutePose,
    AbsolutePoseConfig,
    estimate_absolute_pose,
)
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.camera import Camera
from topoloc.geometry.pose_matches import PoseMatches
from topoloc.geometry.rig import depth_sigmas, ray_covariances
from topoloc.geometry.rigid import Rigid3, inverse_covariance, position_covariance

pytestmark = pytest.mark.usefixtures("solvers")

PINHOLE = CAMERAS["PINHOLE"]
METHODS = ("poselib", "opencv")


@dataclass
class Scene:
    points_img: np.ndarray
    points_world: np.ndarray
    covariances: np.ndarray
    cam_from_world: Rigid3
    num_outliers: int


def make_scene(
    rng: np.random.Generator,
    camera: Camera,
    n: int = 100,
    outliers: float = 0.0,
    sigma_px: float = 0.0,
    depth_noise: float = 0.0,
) -> Scene:
    """Return points seen by a camera at a random pose. `depth_noise` d moves them along the ray of
    a mapping camera by d z^2 (1 sigma)."""
    cam_from_world = random_rigid(rng)
    pixels = rng.uniform([0, 0], [camera.width - 1, camera.height - 1], (n, 2))
    points_cam = np.column_stack([camera.normalized_from_img(pixels), np.ones(n)]) * rng.uniform(
        2.0, 12.0, (n, 1)
    )
    points_world = cam_from_world.inverse().apply(points_cam)
    # Mapped from two metres beside and behind, so that the error along that ray is seen here from
    # the side.
    rays = points_world - cam_from_world.inverse().apply(np.array([2.0, 0.3, -2.0]))
    distances = np.linalg.norm(rays, axis=1, keepdims=True)
    rays = rays / distances
    sigmas = depth_noise * distances**2
    points_world = points_world + rays * sigmas * rng.normal(size=(n, 1))
    covariances = sigmas[:, :, None] ** 2 * rays[:, :, None] * rays[:, None, :] + 1e-8 * np.eye(3)
    pixels = pixels + sigma_px * rng.normal(size=(n, 2))
    num_outliers = int(outliers * n)
    pixels[:num_outliers] = rng.uniform(
        [0, 0], [camera.width - 1, camera.height - 1], (num_outliers, 2)
    )
    return Scene(pixels, points_world, covariances, cam_from_world, num_outliers)


def _errors_px(pose: AbsolutePose, scene: Scene, camera: Camera) -> np.ndarray:
    return np.linalg.norm(
        camera.img_from_cam(pose.cam_from_world.apply(scene.points_world)) - scene.points_img,
        axis=1,
    )


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("model", sorted(CAMERAS))
def test_exact_matches_give_the_exact_pose(method, model):
    scene = make_scene(np.random.default_rng(0), CAMERAS[model], n=50)
    pose = estimate_absolute_pose(
        scene.points_img, scene.points_world, CAMERAS[model], AbsolutePoseConfig(method=method)
    )
    assert pose is not None
    assert translation_error(pose.cam_from_world, scene.cam_from_world) < 1e-6
    assert rotation_error(pose.cam_from_world, scene.cam_from_world) < 1e-7
    assert pose.inliers.all()
    assert _errors_px(pose, scene, CAMERAS[model]).max() < 1e-3


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(6, 60))
def test_any_exact_scene_is_solved(seed, n):
    scene = make_scene(np.random.default_rng(seed), PINHOLE, n=n)
    pose = estimate_absolute_pose(scene.points_img, scene.points_world, PINHOLE)
    assert pose is not None
    assert pose.inliers.all()
    assert translation_error(pose.cam_from_world, scene.cam_from_world) < 1e-4


@pytest.mark.parametrize(("method", "outliers"), [("poselib", 0.8), ("opencv", 0.5)])
def test_outliers_are_distinguished_from_inliers(method, outliers):
    scene = make_scene(
        np.random.default_rng(1), CAMERAS["OPENCV"], n=400, outliers=outliers, sigma_px=0.5
    )
    pose = estimate_absolute_pose(
        scene.points_img, scene.points_world, CAMERAS["OPENCV"], AbsolutePoseConfig(method=method)
    )
    assert pose is not None
    assert pose.inliers[scene.num_outliers :].mean() > 0.97
    assert pose.inliers[: scene.num_outliers].mean() < 0.02
    assert translation_error(pose.cam_from_world, scene.cam_from_world) < 0.03
    assert np.array_equal(pose.inliers, _errors_px(pose, scene, CAMERAS["OPENCV"]) <= 4.0)


@pytest.mark.parametrize("model", CAMERAS)
def test_inliers_are_near_the_projections_of_their_points(model):
    rng, camera, limit = np.random.default_rng(4), CAMERAS[model], 4.0
    scene = make_scene(rng, camera, n=2000)
    size = np.array([camera.width, camera.height])
    pixels = np.clip(scene.points_img + rng.uniform(-6.0, 6.0, (2000, 2)), 0.0, size - 1.0)
    exact = np.zeros((0, 3, 3))
    matches = PoseMatches.from_pixels(pixels, scene.points_world, exact, camera, 0.7)
    inliers = matches.select_inliers(matches.kernel_args(scene.cam_from_world), limit)
    projected = camera.img_from_cam(scene.cam_from_world.apply(scene.points_world))
    errors_px = np.linalg.norm(projected - pixels, axis=1)
    assert inliers[errors_px < 0.9 * limit].all()
    assert not inliers[errors_px > 1.1 * limit].any()
    assert 500 < np.count_nonzero(inliers) < 1000


def test_priorities_lead_to_a_pose_among_very_many_outliers():
    scene = make_scene(np.random.default_rng(2), PINHOLE, n=600, outliers=0.95, sigma_px=0.5)
    config = AbsolutePoseConfig(max_iterations=300)
    priorities = np.linspace(0.0, 1.0, 600)  # the inliers come last here
    pose = estimate_absolute_pose(
        scene.points_img, scene.points_world, PINHOLE, config, priorities=priorities
    )
    assert pose is not None
    assert translation_error(pose.cam_from_world, scene.cam_from_world) < 0.1
    assert pose.inliers[scene.num_outliers :].mean() > 0.9


@pytest.mark.parametrize("method", METHODS)
def test_same_input_gives_the_same_bytes(method):
    scene = make_scene(
        np.random.default_rng(3), PINHOLE, n=200, outliers=0.5, sigma_px=1.0, depth_noise=0.003
    )
    results = [
        estimate_absolute_pose(
            scene.points_img,
            scene.points_world,
            PINHOLE,
            AbsolutePoseConfig(method=method),
            point_covariances=scene.covariances,
        )
        for _ in range(3)
    ]
    assert all(result is not None for result in results)
    assert (
        len(
            {
                result.cam_from_world.matrix().tobytes() + result.covariance.tobytes()
                for result in results
                if result
            }
        )
        == 1
    )


def nans(n: int) -> np.ndarray:
    return np.full((n, 3), np.nan)


DEGENERATE = {
    "none": (np.zeros((0, 2)), np.zeros((0, 3))),
    "three": (np.array([[0.0, 0.0], [600.0, 0.0], [0.0, 300.0]]), np.eye(3)),
    "one point": (np.full((20, 2), 100.0), np.ones((20, 3))),
    "one point, scattered pixels": (
        np.random.default_rng(0).uniform(0, 300, (20, 2)),
        np.ones((20, 3)),
    ),
    "one pixel, scattered points": (
        np.full((20, 2), 100.0),
        np.random.default_rng(0).normal(size=(20, 3)),
    ),
    "on a line": (
        np.column_stack([np.linspace(0, 600, 20), np.full(20, 90.0)]),
        np.outer(np.arange(20.0), [1.0, 0.5, 2.0]),
    ),
    "points on a line, scattered pixels": (
        np.random.default_rng(0).uniform(0, 300, (20, 2)),
        np.outer(np.arange(20.0), [1.0, 0.5, 2.0]),
    ),
    "nan points": (np.random.default_rng(0).uniform(0, 300, (20, 2)), nans(20)),
    "nan pixels": (nans(20)[:, :2], np.random.default_rng(0).normal(size=(20, 3))),
    "infinite": (np.full((20, 2), np.inf), np.full((20, 3), -np.inf)),
    "four noise": (
        np.random.default_rng(4).uniform(0, 300, (4, 2)),
        np.random.default_rng(5).normal(size=(4, 3)),
    ),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", sorted(DEGENERATE))
@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
def test_degenerate_matches_give_no_pose_and_no_warning(method, name, model):
    points_img, points_world = DEGENERATE[name]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (
            estimate_absolute_pose(
                points_img, points_world, CAMERAS[model], AbsolutePoseConfig(method=method)
            )
            is None
        )


@pytest.mark.parametrize("method", METHODS)
def test_matches_that_are_not_finite_are_outliers(method):
    scene = make_scene(np.random.default_rng(6), PINHOLE, n=40)
    scene.points_world[3], scene.points_img[5], scene.covariances[7] = np.nan, np.inf, np.nan
    pose = estimate_absolute_pose(
        scene.points_img,
        scene.points_world,
        PINHOLE,
        AbsolutePoseConfig(method=method),
        point_covariances=scene.covariances,
    )
    assert pose is not None
    assert np.flatnonzero(~pose.inliers).tolist() == [3, 5, 7]
    assert translation_error(pose.cam_from_world, scene.cam_from_world) < 1e-3


def mean_normalized_error(
    camera: Camera, num_trials: int, config: AbsolutePoseConfig | None = None, **noise: float
) -> float:
    """Return the mean of xi' C^-1 xi with the error xi as left perturbation. It is 6 if the
    covariance C is right."""
    rng = np.random.default_rng(7)
    errors = []
    for _ in range(num_trials):
        scene = make_scene(rng, camera, n=80, **noise)
        pose = estimate_absolute_pose(
            scene.points_img,
            scene.points_world,
            camera,
            config,
            point_covariances=scene.covariances,
        )
        assert pose is not None
        xi = (pose.cam_from_world @ scene.cam_from_world.inverse()).log()
        errors.append(xi @ np.linalg.solve(pose.covariance, xi))
    return float(np.mean(errors))


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("depth_noise", [0.0, 0.002])
def test_covariance_matches_the_error(model, depth_noise):
    assert (
        4.5
        < mean_normalized_error(CAMERAS[model], 100, sigma_px=1.0, depth_noise=depth_noise)
        < 8.0
    )


def test_covariance_grows_with_more_noise_than_assumed():
    config = AbsolutePoseConfig(max_reprojection_error_px=8.0)
    assert 4.5 < mean_normalized_error(PINHOLE, 100, config, sigma_px=2.0) < 8.0


def test_covariance_matches_the_error_among_outliers():
    assert (
        4.5
        < mean_normalized_error(PINHOLE, 100, sigma_px=1.0, depth_noise=0.002, outliers=0.3)
        < 8.0
    )


def test_point_uncertainty_makes_the_pose_better():
    rng = np.random.default_rng(8)
    with_covariances, without = [], []
    for _ in range(100):
        scene = make_scene(rng, PINHOLE, n=60, sigma_px=0.5, depth_noise=0.003)
        for errors, covariances in ((with_covariances, scene.covariances), (without, None)):
            pose = estimate_absolute_pose(
                scene.points_img, scene.points_world, PINHOLE, point_covariances=covariances
            )
            assert pose is not None
            errors.append(
                translation_error(pose.cam_from_world.inverse(), scene.cam_from_world.inverse())
            )
    assert np.median(with_covariances) < 0.9 * np.median(without)


def test_covariance_of_the_inverse_follows_its_perturbations():
    rng = np.random.default_rng(9)
    cam_from_world = random_rigid(rng)
    step = 1e-6
    perturbed = [
        (Rigid3.exp(step * direction) @ cam_from_world).inverse() for direction in np.eye(6)
    ]
    by_xi = np.column_stack(
        [(world_from_cam @ cam_from_world).log() / step for world_from_cam in perturbed]
    )
    by_position = np.column_stack(
        [(p.translation - cam_from_world.inverse().translation) / step for p in perturbed]
    )
    root = rng.normal(size=(6, 6))
    covariance = root @ root.T
    expected = by_xi @ covariance @ by_xi.T
    np.testing.assert_allclose(
        inverse_covariance(cam_from_world, covariance), expected, atol=1e-4 * expected.max()
    )
    of_position = position_covariance(cam_from_world, covariance)
    np.testing.assert_allclose(
        of_position, by_position @ covariance @ by_position.T, rtol=1e-4, atol=1e-4
    )
    np.testing.assert_allclose(
        inverse_covariance(
            cam_from_world.inverse(), inverse_covariance(cam_from_world, covariance)
        ),
        covariance,
    )


def test_depth_sensor_covariances_fit_the_call():
    rng = np.random.default_rng(10)
    scene = make_scene(rng, PINHOLE, n=30)
    points_cam = scene.cam_from_world.apply(scene.points_world)
    rotation = scene.cam_from_world.rotation
    of_points = ray_covariances(
        points_cam, depth_sigmas(points_cam[:, 2]), PINHOLE, np.full(len(points_cam), 0.7)
    )
    covariances = rotation.T @ of_points @ rotation
    pose = estimate_absolute_pose(
        scene.points_img, scene.points_world, PINHOLE, point_covariances=covariances
    )
    exact = estimate_absolute_pose(scene.points_img, scene.points_world, PINHOLE)
    assert pose is not None
    assert exact is not None
    assert np.trace(pose.covariance) > np.trace(exact.covariance)
