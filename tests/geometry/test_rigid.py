import numpy as np
import pytest
from geometry_strategies import rigids, rotation_vectors, tangents, vectors
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from topoloc.errors import TrajectoryError
from topoloc.geometry.rigid import (
    Rigid3,
    exp_so3,
    log_so3,
    matrix_from_quat_wxyz,
    quat_wxyz_from_matrix,
    skew,
)


def assert_same(a: Rigid3, b: Rigid3, atol: float = 1e-9) -> None:
    np.testing.assert_allclose(a.matrix(), b.matrix(), atol=atol)


@given(rigids, rigids, rigids)
def test_composition_is_associative(a, b, c):
    assert_same((a @ b) @ c, a @ (b @ c))


@given(rigids)
def test_inverse_and_identity(a):
    assert_same(a @ a.inverse(), Rigid3.identity())
    assert_same(a.inverse() @ a, Rigid3.identity())
    assert_same(a @ Rigid3.identity(), a, atol=0.0)


@given(rigids, rigids, vectors)
def test_composition_applies_the_right_one_first(a, b, point):
    np.testing.assert_allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-9)
    np.testing.assert_allclose((a.matrix() @ np.append(point, 1.0))[:3], a.apply(point), atol=1e-9)


@given(rigids, st.integers(0, 5))
def test_apply_takes_any_number_of_points(a, n):
    points = np.arange(3.0 * n).reshape(n, 3)
    assert a.apply(points).shape == (n, 3)
    for point, moved in zip(points, a.apply(points), strict=True):
        np.testing.assert_allclose(moved, a.apply(point), atol=1e-12)


@given(tangents)
def test_log_undoes_exp(xi):
    np.testing.assert_allclose(Rigid3.exp(xi).log(), xi, atol=1e-7)


@given(rigids)
def test_exp_undoes_log(a):
    assert_same(Rigid3.exp(a.log()), a)


@given(rigids, tangents)
def test_adjoint_moves_a_perturbation_to_the_left(a, xi):
    assert_same(a @ Rigid3.exp(xi), Rigid3.exp(a.adjoint() @ xi) @ a, atol=1e-7)


@given(rigids)
def test_adjoint_of_the_inverse_is_the_inverse_adjoint(a):
    np.testing.assert_allclose(a.inverse().adjoint() @ a.adjoint(), np.eye(6), atol=1e-9)


@given(rotation_vectors)
def test_rotation_exponential_agrees_with_scipy(omega):
    expected = Rotation.from_rotvec(omega)
    np.testing.assert_allclose(exp_so3(omega), expected.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(log_so3(expected.as_matrix()), omega, atol=1e-7)


def test_half_turn_has_angle_pi():
    for axis in np.eye(3):
        half_turn = 2.0 * np.outer(axis, axis) - np.eye(3)
        assert np.linalg.norm(log_so3(half_turn)) == pytest.approx(np.pi)
        np.testing.assert_allclose(exp_so3(log_so3(half_turn)), half_turn, atol=1e-15)


@given(rigids)
def test_quaternion_round_trip(a):
    quat_wxyz = quat_wxyz_from_matrix(a.rotation)
    assert quat_wxyz[0] >= 0.0
    assert np.linalg.norm(quat_wxyz) == pytest.approx(1.0)
    np.testing.assert_allclose(matrix_from_quat_wxyz(quat_wxyz), a.rotation, atol=1e-12)
    np.testing.assert_allclose(matrix_from_quat_wxyz(-3.0 * quat_wxyz), a.rotation, atol=1e-12)
    assert_same(Rigid3.from_quat_wxyz(a.quat_wxyz(), a.translation), a, atol=1e-12)


def test_quaternion_order_is_scalar_first():
    np.testing.assert_allclose(
        quat_wxyz_from_matrix(exp_so3(np.array([0.0, 0.0, np.pi / 2]))),
        [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)],
    )


@given(vectors, vectors)
def test_skew_is_the_cross_product(v, w):
    np.testing.assert_allclose(skew(v) @ w, np.cross(v, w), atol=1e-9)


@given(rigids, tangents.filter(lambda xi: np.linalg.norm(xi[3:]) < 3.1))
def test_the_squared_distance_is_that_of_the_right_perturbation(a, xi):
    covariance = np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])
    expected = float(xi @ np.linalg.solve(covariance, xi))
    other = a @ Rigid3.exp(xi)
    assert a.squared_distance(other, covariance) == pytest.approx(expected, rel=1e-5, abs=1e-5)
    for factor, is_same in ((0.9, False), (1.1, expected > 0.0)):
        limit = {"covariance": covariance, "max_square": factor * expected}
        assert a.is_same(other, **limit) is is_same or expected < 1e-3


def test_poses_within_both_tolerances_are_the_same():
    pose = Rigid3.exp(np.array([3.0, -1.0, 2.0, 0.5, -0.3, 1.0]))
    for metres, radians, is_same in ((0.4, 0.08, True), (0.6, 0.08, False), (0.4, 0.12, False)):
        other = pose @ Rigid3(exp_so3(np.array([0.0, radians, 0.0])), np.array([metres, 0.0, 0.0]))
        assert pose.is_same(other, 0.5, 0.1) is is_same
        assert other.is_same(pose, 0.5, 0.1) is is_same
    assert not pose.is_same(pose)


def test_poses_are_the_same_if_the_covariance_allows_it_beyond_the_tolerance():
    here, there = Rigid3.identity(), Rigid3(np.eye(3), np.array([1.5, 0.0, 0.0]))
    along, across = np.diag([0.5, *[1e-8] * 5]), np.diag([1e-8, 0.5, *[1e-8] * 4])
    assert here.is_same(there, 0.5, 0.1, along, 12.6)
    assert not here.is_same(there, 0.5, 0.1, across, 12.6)
    assert here.is_same(there, 2.0, 0.1, across, 12.6)


@given(rigids, rigids, st.floats(0.0, 1.0))
def test_interpolation_meets_both_ends_and_turns_evenly(a, b, fraction):
    assert_same(a.interpolate(b, 0.0), a)
    assert_same(a.interpolate(b, 1.0), b, atol=1e-7)
    whole = (a.inverse() @ b).angle()
    assert (a.inverse() @ a.interpolate(b, fraction)).angle() == pytest.approx(
        fraction * whole, abs=1e-7
    )


def test_from_matrix_makes_rounded_rotations_exact():
    a = Rigid3.exp(np.array([1.0, 2.0, 3.0, 0.3, -0.2, 0.9]))
    rounded = Rigid3.from_matrix(np.round(a.matrix()[:3], 4))
    np.testing.assert_allclose(rounded.rotation @ rounded.rotation.T, np.eye(3), atol=1e-15)
    assert_same(rounded, a, atol=1e-4)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(5), "shape"),
        (np.full((4, 4), np.nan), "NaN"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "no rotation"),
        (np.diag([1.0, 1.0, 1.1, 1.0]), "no rotation"),
        (np.zeros((3, 4)), "no rotation"),
    ],
)
def test_an_invalid_pose_is_refused(matrix, message):
    with pytest.raises(TrajectoryError, match=message):
        Rigid3.from_matrix(matrix)


@pytest.mark.parametrize(
    "quat_wxyz", [np.zeros(4), np.array([1.0, np.nan, 0.0, 0.0]), np.full(4, np.inf)]
)
def test_an_invalid_quaternion_is_refused(quat_wxyz):
    with pytest.raises(TrajectoryError, match="not a rotation"):
        Rigid3.from_quat_wxyz(quat_wxyz, np.zeros(3))


def test_an_invalid_translation_is_refused():
    with pytest.raises(TrajectoryError, match="not a translation"):
        Rigid3.from_quat_wxyz(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, np.nan, 0.0]))
