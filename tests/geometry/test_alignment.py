import numpy as np
import pytest
from geometry_strategies import random_rigid, rigids
from hypothesis import given, strategies as st

from topoloc.errors import TrajectoryError
from topoloc.geometry.alignment import (
    align_points,
    align_poses,
    align_scaled_poses,
    align_similarity,
    align_trajectories,
    rotation_error,
    translation_error,
)
from topoloc.geometry.rigid import Rigid3

seeds = st.integers(0, 2**31)


@given(rigids, seeds, st.integers(3, 30))
def test_points_give_back_the_transform(a_from_b, seed, n):
    points_b = np.random.default_rng(seed).normal(size=(n, 3))
    np.testing.assert_allclose(
        align_points(a_from_b.apply(points_b), points_b).matrix(), a_from_b.matrix(), atol=1e-6
    )


def test_planar_and_noisy_points_never_give_a_reflection():
    rng = np.random.default_rng(0)
    for _ in range(50):
        points_a, points_b = rng.normal(size=(2, 4, 3)) * [1.0, 1.0, 0.01]
        assert np.linalg.det(align_points(points_a, points_b).rotation) == pytest.approx(1.0)


def test_alignment_is_the_least_squares_one():
    rng = np.random.default_rng(1)
    points_b = rng.normal(size=(20, 3))
    points_a = random_rigid(rng).apply(points_b) + 0.1 * rng.normal(size=(20, 3))
    best = align_points(points_a, points_b)
    cost = np.sum((points_a - best.apply(points_b)) ** 2)
    for _ in range(100):
        other = Rigid3.exp(rng.normal(size=6) * 1e-3) @ best
        assert np.sum((points_a - other.apply(points_b)) ** 2) > cost


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((5, 3)),
        np.outer(np.arange(6.0), [1.0, 2.0, 3.0]),
        np.eye(3)[:2],
        np.full((4, 3), np.nan),
        np.zeros((0, 3)),
    ],
    ids=["standing", "straight", "two", "nan", "none"],
)
def test_points_that_fix_no_rotation_are_refused(points):
    with pytest.raises(TrajectoryError):
        align_points(points, points)


@given(rigids, seeds, st.integers(1, 10))
def test_poses_align_straight_and_standing_trajectories(world_a_from_world_b, seed, n):
    rng = np.random.default_rng(seed)
    turn = random_rigid(rng).rotation
    straight = [Rigid3(turn, np.array([0.1 * i, 0.0, 0.0])) for i in range(n)]
    standing = [Rigid3(random_rigid(rng).rotation, np.ones(3)) for _ in range(n)]
    for world_b_from_cams in (straight, standing):
        world_a_from_cams = [world_a_from_world_b @ pose for pose in world_b_from_cams]
        aligned = align_poses(world_a_from_cams, world_b_from_cams)
        np.testing.assert_allclose(aligned.matrix(), world_a_from_world_b.matrix(), atol=1e-6)


def test_long_trajectories_are_aligned_by_their_positions():
    rng = np.random.default_rng(3)
    world_a_from_world_b = random_rigid(rng)
    world_b_from_cams = [random_rigid(rng, spread=100.0) for _ in range(50)]
    # Orientations all wrong by the same 3 degrees, positions right.
    tilt = Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.05, 0.0, 0.0]))
    world_a_from_cams = [
        Rigid3(tilt.rotation @ moved.rotation, moved.translation)
        for moved in (world_a_from_world_b @ b for b in world_b_from_cams)
    ]
    by_positions = align_trajectories(world_a_from_cams, world_b_from_cams)
    by_poses = align_poses(world_a_from_cams, world_b_from_cams)
    np.testing.assert_allclose(by_positions.matrix(), world_a_from_world_b.matrix(), atol=1e-9)
    assert rotation_error(by_poses, world_a_from_world_b) < 1e-4


@given(rigids, st.floats(1e-3, 1e3))
def test_a_similarity_is_found_again(a_from_b, scale):
    points_b = np.random.default_rng(0).normal(size=(20, 3))
    found_scale, found = align_similarity(a_from_b.apply(scale * points_b), points_b)
    assert found_scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(found.rotation, a_from_b.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, a_from_b.translation, atol=1e-6 * max(1.0, scale))


def test_a_straight_path_is_scaled_and_rotated_by_its_orientations():
    rng = np.random.default_rng(5)
    a_from_b = random_rigid(rng)
    straight = [Rigid3(random_rigid(rng).rotation, np.array([0.1 * k, 0.0, 0.0])) for k in range(6)]
    metric = [a_from_b @ Rigid3(pose.rotation, 3.0 * pose.translation) for pose in straight]
    scale, found = align_scaled_poses(metric, straight)
    assert scale == pytest.approx(3.0)
    np.testing.assert_allclose(found.matrix(), a_from_b.matrix(), atol=1e-6)
    with pytest.raises(TrajectoryError, match="fix no scale"):
        align_scaled_poses(metric, [straight[0]] * 6)


def test_trajectories_of_different_lengths_are_refused():
    pose = Rigid3.identity()
    for align in (align_trajectories, align_poses):
        with pytest.raises(TrajectoryError, match="2 and 1 poses"):
            align([pose, pose], [pose])
    with pytest.raises(TrajectoryError, match="no common pose"):
        align_poses([], [])


@given(rigids, st.floats(1e-9, 3.0))
def test_errors_measure_the_known_difference(world_from_cam, angle):
    other = (
        world_from_cam
        @ Rigid3.exp(np.array([0.3, 0.0, 0.4, 0.0, 0.0, 0.0]))
        @ Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.0, angle, 0.0]))
    )
    assert translation_error(world_from_cam, other) == pytest.approx(0.5)
    assert rotation_error(world_from_cam, other) == pytest.approx(angle, rel=1e-5, abs=1e-14)
    assert rotation_error(other, world_from_cam) == pytest.approx(angle, rel=1e-5, abs=1e-14)
