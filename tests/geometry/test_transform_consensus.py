"""Test the consensus of many estimates of one transform, and when there is none."""

import numpy as np
import pytest
from geometry_strategies import random_rigid, rigids, tangents
from hypothesis import given, settings, strategies as st

from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.transform_consensus import (
    _residuals,
    find_consensus,
    find_least_median,
    select_hypothesis,
)

seeds = st.integers(0, 2**31)


def random_covariances(rng: np.random.Generator, num: int) -> np.ndarray:
    """Return covariances of different shapes and up to three times different widths: 1 to 2 cm,
    half a degree."""
    factors = (
        np.diag([0.01] * 3 + [0.005] * 3)
        @ rng.normal(size=(num, 6, 6))
        * rng.uniform(0.5, 1.5, size=(num, 1, 1))
        / np.sqrt(6)
    )
    return factors @ factors.transpose(0, 2, 1) + np.diag([0.005**2] * 3 + [0.002**2] * 3)


def estimates_of(
    a_from_b: Rigid3, covariances: np.ndarray, rng: np.random.Generator
) -> list[Rigid3]:
    return [
        Rigid3.exp(rng.multivariate_normal(np.zeros(6), covariance)) @ a_from_b
        for covariance in covariances
    ]


def in_sigma(found: Rigid3, true: Rigid3, covariance: np.ndarray) -> float:
    residual = (true @ found.inverse()).log()
    return float(np.sqrt(residual @ np.linalg.solve(covariance, residual)))


@given(rigids, tangents.filter(lambda xi: np.linalg.norm(xi[3:]) < 3.1))
def test_residuals_are_logarithms(hypothesis, xi):
    np.testing.assert_allclose(
        _residuals(hypothesis, [Rigid3.exp(xi) @ hypothesis])[0], xi, atol=1e-5
    )


@settings(max_examples=25)
@given(seeds, st.integers(5, 12), st.integers(0, 24))
def test_the_truth_is_found_among_twice_as_many_outliers(seed, num_right, num_wrong):
    rng = np.random.default_rng(seed)
    num_wrong = min(num_wrong, 2 * num_right)
    a_from_b, covariances = random_rigid(rng, 10.0), random_covariances(rng, num_right + num_wrong)
    estimates = estimates_of(a_from_b, covariances[:num_right], rng) + [
        random_rigid(rng, 10.0) for _ in range(num_wrong)
    ]
    order = rng.permutation(len(estimates))
    found = find_consensus([estimates[k] for k in order], covariances[order])
    assert found is not None
    assert not found.is_inlier[order >= num_right].any()
    assert (
        np.count_nonzero(found.is_inlier) >= num_right - 1
    )  # one may be beyond its own covariance
    assert in_sigma(found.a_from_b, a_from_b, found.covariance) < 6.0


def test_the_covariance_matches_the_error_of_the_consensus():
    rng = np.random.default_rng(3)
    squares = []
    for _ in range(100):
        a_from_b, covariances = random_rigid(rng, 5.0), random_covariances(rng, 8)
        found = find_consensus(estimates_of(a_from_b, covariances, rng), covariances)
        assert found is not None
        squares.append(in_sigma(found.a_from_b, a_from_b, found.covariance) ** 2)
    assert np.mean(squares) == pytest.approx(6.0, rel=0.25)


@settings(max_examples=25)
@given(seeds)
def test_estimates_of_different_transforms_are_no_consensus(seed):
    rng = np.random.default_rng(seed)
    assert (
        find_consensus([random_rigid(rng, 10.0) for _ in range(30)], random_covariances(rng, 30))
        is None
    )


@pytest.mark.parametrize(
    ("num_rivals", "is_believed"), [(0, True), (2, True), (3, False), (6, False)]
)
def test_an_equally_likely_alternative_prevents_a_consensus(num_rivals, is_believed):
    """Six estimates agree here. The others agree on a panel one metre beside it."""
    rng = np.random.default_rng(0)
    a_from_b, covariances = random_rigid(rng), random_covariances(rng, 6 + num_rivals)
    beside = Rigid3.exp(np.array([1.0, 0, 0, 0, 0, 0])) @ a_from_b
    estimates = estimates_of(a_from_b, covariances[:6], rng) + estimates_of(
        beside, covariances[6:], rng
    )
    assert (find_consensus(estimates, covariances) is not None) == is_believed


def test_many_estimates_from_one_picture_are_one():
    rng = np.random.default_rng(1)
    a_from_b, covariances = random_rigid(rng), random_covariances(rng, 8)
    estimates = estimates_of(a_from_b, covariances, rng)
    one_picture = np.column_stack([np.zeros(8, np.int64), np.arange(8)])
    assert find_consensus(estimates, covariances, one_picture) is None
    # three images of a with three of b, crosswise: nine estimates count as three
    crosswise = np.array([[i, j] for i in range(3) for j in range(3)])
    covariances = random_covariances(rng, 9)
    found = find_consensus(estimates_of(a_from_b, covariances, rng), covariances, crosswise)
    assert found is not None
    assert found.num_independent == 3
    assert (
        np.linalg.slogdet(found.covariance)[1]
        > np.linalg.slogdet(np.linalg.inv(np.linalg.inv(covariances).sum(axis=0)))[1]
    )


@settings(max_examples=25)
@given(seeds)
def test_the_order_of_the_estimates_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    a_from_b, covariances = random_rigid(rng), random_covariances(rng, 9)
    estimates = estimates_of(a_from_b, covariances[:6], rng) + [random_rigid(rng) for _ in range(3)]
    order = rng.permutation(9)
    first, second = (
        find_consensus([estimates[k] for k in rows], covariances[rows])
        for rows in (np.arange(9), order)
    )
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.is_inlier[order], second.is_inlier)
    np.testing.assert_allclose(first.a_from_b.matrix(), second.a_from_b.matrix(), atol=1e-9)


def test_of_very_many_a_sample_of_hypotheses_is_enough():
    rng = np.random.default_rng(2)
    a_from_b, covariances = random_rigid(rng), random_covariances(rng, 500)
    estimates = estimates_of(a_from_b, covariances[:100], rng) + [
        random_rigid(rng, 10.0) for _ in range(400)
    ]
    found = find_consensus(estimates, covariances)
    assert found is not None
    assert np.count_nonzero(found.is_inlier) == 100


def test_fewer_estimates_than_required_give_no_consensus():
    assert find_consensus([], np.zeros((0, 6, 6))) is None
    assert find_consensus([Rigid3.identity()] * 2, np.tile(np.eye(6), (2, 1, 1))) is None


def test_the_hypothesis_with_most_agreeing_estimates_is_selected():
    agree = np.array([[1, 0, 0, 1], [1, 1, 1, 0], [0, 1, 1, 1]], np.bool_)
    assert select_hypothesis(agree) == (1, 3)  # the first of equals
    of_one_image = np.array([[0, 0], [0, 1], [0, 2], [1, 3]])
    assert select_hypothesis(agree, of_one_image) == (2, 2)


def test_the_least_median_ignores_less_than_half_of_the_errors():
    shifts = [0.0, 0.1, 0.1, 0.1, 50.0, 60.0, 0.1]
    hypotheses = [Rigid3(np.eye(3), np.array([shift, 0.0, 0.0])) for shift in shifts]
    best, median = find_least_median(
        hypotheses, lambda one: np.abs(one.translation[0] - np.array(shifts))
    )
    assert best is hypotheses[1]
    assert median == pytest.approx(0.0)
