"""Estimate one transform from many estimates, most of which may be wrong.

Each estimate is a hypothesis. The one with the most independent estimates that agree within their
covariances is refined with all of these (weighted least squares on SE(3)). It is rejected if too
few estimates agree, or if nearly as many agree on another transform.

`select_hypothesis` alone serves estimates whose agreement is no matter of one covariance each, such
as those of a motion that drifts. `find_least_median` serves measurements without covariances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.geometry.rigid import Rigid3

# Estimates agree if they differ by no more than this, all six residuals together, in sigma. One
# correct pair in a thousand does not.
_MAX_SIGMAS = 4.8


def diagonal_covariance(metres: float, degrees: float) -> Float[np.ndarray, "6 6"]:
    """Return the covariance with these standard deviations along and about each axis, in m and
    rad."""
    return np.diag(np.square([metres] * 3 + [np.deg2rad(degrees)] * 3))


def propagate_estimate(
    c_from_a: Rigid3,
    a_from_b: Rigid3,
    covariance: Float[np.ndarray, "6 6"],
    b_from_d: Rigid3,
    drift: float = 0.02,
    drift_deg: float = 0.3,
) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
    """Propagate an estimate of a_from_b along two motions. Return c_from_d and the covariance of
    its left perturbation, which grows with the length of the motions.

    Args:
        drift: standard deviation of the motions' translation, as a fraction of the distance.
        drift_deg: standard deviation of their rotation, degrees per metre.
    """
    lengths = (float(np.linalg.norm(motion.translation)) for motion in (c_from_a, b_from_d))
    of_c, of_d = (diagonal_covariance(drift * way, drift_deg * way) for way in lengths)
    c_from_b, at_c = c_from_a @ a_from_b, c_from_a.transform_covariance(covariance) + of_c
    return c_from_b @ b_from_d, at_c + c_from_b.transform_covariance(of_d)


@dataclass(frozen=True, eq=False)
class TransformConsensus:
    """Hold the transform on which the estimates with `is_inlier` agree.

    `covariance` is that of the left perturbation (m, rad). Estimates that share an image do not
    reduce it. It grows if the agreeing estimates scatter by more than their covariances.
    `num_independent` is the number of agreeing estimates with each image used once.
    """

    a_from_b: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    is_inlier: Bool[np.ndarray, " n"]
    num_independent: int

    def is_consistent(self, a_from_b: Rigid3, covariance: Float[np.ndarray, "6 6"]) -> bool:
        """Return whether an estimate agrees with the transform."""
        return a_from_b.inverse().is_same(
            self.a_from_b.inverse(),
            covariance=covariance + self.covariance,
            max_square=_MAX_SIGMAS**2,
        )

    def between(
        self, c_from_a: Rigid3, b_from_d: Rigid3
    ) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
        """Return c_from_d and the covariance of its left perturbation."""
        covariance = c_from_a.transform_covariance(self.covariance)
        return c_from_a @ self.a_from_b @ b_from_d, 0.5 * (covariance + covariance.T)


def find_consensus(
    a_from_bs: Sequence[Rigid3],
    covariances: Float[np.ndarray, "n 6 6"],
    image_ids: Int[np.ndarray, "n 2"] | None = None,
    *,
    rival_share: float = 0.5,
) -> TransformConsensus | None:
    """Return the transform that the estimates support. Return None if the support is too small, or
    if another transform has nearly as much.

    Args:
        covariances: covariances of the left perturbations, ``exp(xi) @ a_from_b``, m and rad,
            symmetric and positive definite. They must be realistic: overconfident estimates agree
            with none, and very uncertain ones agree with all. Leave out estimates without
            information.
        image_ids: image of a and image of b of each estimate. Estimates that share an image are not
            independent. Default: all are independent.
        rival_share: the consensus is rejected if this fraction of its number of independent
            estimates, and at least two, agrees on another transform.
    """
    min_independent = 3  # minimum number of independent estimates that agree
    rival_sigmas = 8.0  # estimates that differ from the consensus by more than this contradict it
    num = len(a_from_bs)
    if num < min_independent:
        return None
    if image_ids is None:
        image_ids = np.column_stack([np.arange(num), np.arange(num)])
    max_hypotheses, tried = 300, np.arange(num)
    if num > max_hypotheses:  # this many are drawn, with a fixed seed
        tried = np.sort(np.random.default_rng(0).choice(num, max_hypotheses, replace=False))
    distances = np.stack(
        [_distances(a_from_bs[k], covariances[k], a_from_bs, covariances) for k in tried.tolist()]
    )
    best, agreeing = select_hypothesis(distances <= _MAX_SIGMAS, image_ids)
    if agreeing < min_independent:
        return None
    is_inlier = distances[best] <= _MAX_SIGMAS
    a_from_b, covariance = _refine_transform(a_from_bs, covariances, is_inlier)
    sigmas = _distances(a_from_b, covariance, a_from_bs, covariances)
    is_inlier, others = sigmas <= _MAX_SIGMAS, sigmas > rival_sigmas
    num_independent = _count_independent(is_inlier, image_ids)
    _, rivals = select_hypothesis((distances <= _MAX_SIGMAS) & others, image_ids)
    if num_independent < min_independent or rivals >= max(rival_share * num_independent, 2):
        return None
    a_from_b, covariance = _refine_transform(a_from_bs, covariances, is_inlier)
    covariance = covariance * np.count_nonzero(is_inlier) / num_independent
    return TransformConsensus(a_from_b, covariance, is_inlier, num_independent)


def _distances(
    hypothesis: Rigid3,
    covariance: Float[np.ndarray, "6 6"],
    a_from_bs: Sequence[Rigid3],
    covariances: Float[np.ndarray, "n 6 6"],
) -> Float[np.ndarray, " n"]:
    """Return the distances of all estimates from a hypothesis, in sigma of both."""
    residuals = _residuals(hypothesis, a_from_bs)
    whitened = np.linalg.solve(covariances + covariance, residuals[..., None])[..., 0]
    return np.sqrt(np.einsum("ni,ni->n", residuals, whitened))


def _residuals(hypothesis: Rigid3, a_from_bs: Sequence[Rigid3]) -> Float[np.ndarray, "n 6"]:
    """Return the logarithms of ``a_from_b @ hypothesis^-1``, vectorised. For rotations near pi the
    axis is not exact, which is sufficient here."""
    inverse = hypothesis.inverse()
    rotations = np.stack([estimate.rotation for estimate in a_from_bs])
    translations = np.stack([estimate.translation for estimate in a_from_bs])
    translations = translations + rotations @ inverse.translation
    rotations = rotations @ inverse.rotation
    sines = 0.5 * np.stack(
        [rotations[:, k, j] - rotations[:, j, k] for j, k in ((1, 2), (2, 0), (0, 1))], axis=1
    )
    sine = np.linalg.norm(sines, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.einsum("nii->n", rotations) - 1.0))
    omega = sines * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)[:, None]
    half = np.maximum(0.5 * angle, 1e-4)
    curvature = (1.0 - half / np.tan(half)) / (2.0 * half) ** 2
    once = np.cross(omega, translations)
    twice = np.cross(omega, once)
    return np.column_stack([translations - 0.5 * once + curvature[:, None] * twice, omega])


def select_hypothesis(
    agree: Bool[np.ndarray, "h n"], image_ids: Int[np.ndarray, "n 2"] | None = None
) -> tuple[int, int]:
    """Return the hypothesis (row) with the most independent agreeing estimates, and their number.

    Among equals, the one with the most agreeing estimates wins. `image_ids` is as in
    `find_consensus`.
    """
    counts = agree.sum(axis=1)
    if image_ids is None:
        return int(np.argmax(counts)), int(counts.max())
    best, support = 0, 0
    for k in np.argsort(-counts, kind="stable").tolist():
        if counts[k] <= support:
            break
        num = _count_independent(agree[k], image_ids)
        if num > support:
            best, support = k, num
    return best, support


def find_least_median(
    hypotheses: Iterable[Rigid3], errors: Callable[[Rigid3], Float[np.ndarray, " n"]]
) -> tuple[Rigid3, float]:
    """Return the hypothesis with the least median of its errors, and that median.

    Rousseeuw, *Least median of squares regression*, 1984. More than half of the measurements must
    be right.
    """
    medians = ((float(np.median(errors(transform))), transform) for transform in hypotheses)
    median, best = min(medians, key=lambda pair: pair[0])
    return best, median


def _count_independent(chosen: Bool[np.ndarray, " n"], image_ids: Int[np.ndarray, "n 2"]) -> int:
    """Return how many of the chosen estimates can be used with no image used twice. Estimates whose
    images have the fewest other estimates are taken first."""
    pairs = image_ids[chosen]
    partners = np.zeros(len(pairs), np.int64)
    for side in pairs.T:
        _, inverse, counts = np.unique(side, return_inverse=True, return_counts=True)
        partners += counts[inverse]
    taken: tuple[set[int], set[int]] = set(), set()
    num = 0
    for a, b in pairs[np.argsort(partners, kind="stable")].tolist():
        if a not in taken[0] and b not in taken[1]:
            taken[0].add(a)
            taken[1].add(b)
            num += 1
    return num


def _refine_transform(
    a_from_bs: Sequence[Rigid3],
    covariances: Float[np.ndarray, "n 6 6"],
    is_inlier: Bool[np.ndarray, " n"],
) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
    """Return the weighted least squares solution over the inliers, starting from the most certain
    one, and its covariance. The covariance is scaled up to the scatter of the inliers."""
    num_iterations, min_step = 10, 1e-9
    rows = np.flatnonzero(is_inlier).tolist()
    chosen, informations = [a_from_bs[k] for k in rows], np.linalg.inv(covariances[rows])
    mean = chosen[int(np.argmax(np.linalg.slogdet(informations).logabsdet))]
    covariance = np.linalg.inv(informations.sum(axis=0))
    for _ in range(num_iterations):
        residuals = _residuals(mean, chosen)
        step = covariance @ np.einsum("nij,nj->i", informations, residuals)
        mean = Rigid3.exp(step) @ mean
        if np.abs(step).max() < min_step:
            break
    residuals = _residuals(mean, chosen)
    square = float(np.einsum("ni,nij,nj->", residuals, informations, residuals))
    return mean, covariance * max(1.0, square / (6.0 * max(len(chosen) - 1, 1)))
