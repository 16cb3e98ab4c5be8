"""Check that errors which near matches share are detected, unlike independent errors."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.geometry.absolute_pose import (
    AbsolutePoseConfig,
    compute_variance_inflation,
    estimate_absolute_pose,
)
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

CAMERA = Camera.pinhole(640, 480, 500.0, 500.0, 319.5, 239.5)
CONFIG = AbsolutePoseConfig(max_reprojection_error_px=12.0)
NO_COVARIANCES = np.zeros((300, 3, 3))


def seen(seed: int, moved: float, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels with one pixel of noise, and points. Half of the objects in view were moved, by
    `moved` metres (1 sigma)."""
    rng = np.random.default_rng(seed)
    exact = rng.uniform([10.0, 10.0], [629.0, 469.0], (count, 2))
    depths = rng.uniform(2.0, 6.0, count)
    points = np.column_stack([CAMERA.normalized_from_img(exact) * depths[:, None], depths])
    things = (exact // 80.0).astype(int) @ [1, 8]
    moves = rng.normal(0.0, moved, (64, 3)) * rng.integers(0, 2, (64, 1))
    stands = points + moves[things]
    return CAMERA.img_from_cam(stands) + rng.normal(0.0, 1.0, (count, 2)), points


def coherence_of(seed: int, moved: float) -> tuple[float, float]:
    """Return the coherence, and the pose's squared error in standard deviations under
    independent errors."""
    points_img, points = seen(seed, moved)
    pose = estimate_absolute_pose(
        points_img, points, CAMERA, CONFIG, point_covariances=NO_COVARIANCES
    )
    assert pose is not None
    xi = pose.cam_from_world.inverse().log()
    rows = pose.inliers
    found = compute_variance_inflation(
        points_img[rows], points[rows], NO_COVARIANCES[rows], CAMERA, pose.cam_from_world, 1.0
    )
    return found, float(xi @ np.linalg.solve(pose.covariance, xi))


def test_independent_errors_do_not_cohere():
    found = [coherence_of(seed, 0.0)[0] for seed in range(20)]
    assert min(found) >= 1.0
    assert np.median(found) < 1.3


def test_moved_objects_are_detected_and_widen_the_covariance():
    still, moved = ([coherence_of(seed, by) for seed in range(20)] for by in (0.0, 0.02))
    assert np.median([found for found, _ in moved]) > 1.7 * np.median([found for found, _ in still])
    off = np.array(moved)
    assert (
        np.mean(off[:, 1] < 12.592) < 0.75
    )  # of independent errors the ellipsoid does not hold the truth
    assert np.mean(off[:, 1] / off[:, 0] ** 2 < 12.592) > 0.9


@pytest.mark.parametrize("count", [0, 1, 4, 5])
def test_few_matches_give_no_result(count: int):
    points_img, points = seen(0, 0.05, max(count, 1))
    arguments = points_img[:count], points[:count], NO_COVARIANCES[:count]
    assert compute_variance_inflation(*arguments, CAMERA, Rigid3.identity(), 1.0) == 1.0
    crowded = np.full((9, 2), 100.0) + np.arange(9)[:, None]
    assert (
        compute_variance_inflation(
            crowded, np.ones((9, 3)), NO_COVARIANCES[:9], CAMERA, Rigid3.identity(), 1.0
        )
        == 1.0
    )
