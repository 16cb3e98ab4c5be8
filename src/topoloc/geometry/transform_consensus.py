"""One transform out of many estimates of it, most of which may be wrong: what is seen from here of
what was seen there.

Each estimate is a hypothesis; that which most independent others agree with, within their
covariances, is refined by all that do (weighted least squares on SE(3)). It is refused where too
few agree, and where others that say something else are nearly as many.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.bounds import Above, AtLeast, Between
from topoloc.geometry.rigid import Rigid3

_NUM_ITERATIONS = 10
_MIN_STEP = 1e-9


@dataclass(frozen=True)
class ConsensusConfig:
    """When estimates agree, and when enough of them do."""

    max_sigmas: Annotated[float, Above(0)] = 4.8
    """Estimates that differ by no more than this (all six residuals together, in sigma) agree; one
    right pair in a thousand does not."""
    rival_sigmas: Annotated[float, Above(0)] = 8.0
    """Those that differ from the consensus by more than this say something else."""
    min_independent: Annotated[int, AtLeast(1)] = 3
    """Independent estimates that must agree."""
    rival_share: Annotated[float, Between(0, 1)] = 0.5
    """Nothing is believed where so large a share of their number agrees on something else."""
    max_hypotheses: Annotated[int, AtLeast(1)] = 300
    """Of more estimates than this, so many, drawn with a fixed seed, are tried as hypotheses."""


@dataclass(frozen=True)
class DriftConfig:
    """How wrong the way may be along which an estimate is carried."""

    drift: Annotated[float, AtLeast(0)] = 0.02
    """Share of the way by which its end may be off (one sigma) ..."""
    drift_deg: Annotated[float, AtLeast(0)] = 0.3
    """... and degrees a metre."""

    def covariance(self, motion: Rigid3) -> Float[np.ndarray, "6 6"]:
        """Of a motion, m and rad."""
        distance = float(np.linalg.norm(motion.translation))
        return diagonal_covariance(self.drift * distance, self.drift_deg * distance)


def diagonal_covariance(metres: float, degrees: float) -> Float[np.ndarray, "6 6"]:
    """Of these standard deviations along and about each axis, m and rad."""
    return np.diag(np.square([metres] * 3 + [np.deg2rad(degrees)] * 3))


def propagate_estimate(
    c_from_a: Rigid3,
    a_from_b: Rigid3,
    covariance: Float[np.ndarray, "6 6"],
    b_from_d: Rigid3,
    config: DriftConfig,
) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
    """An estimate of a_from_b, said at other places: c_from_d, and the covariance of its left
    perturbation. The longer the ways between, the less certain."""
    to_c, to_d = c_from_a.adjoint(), (c_from_a @ a_from_b).adjoint()
    at_c = to_c @ covariance @ to_c.T + config.covariance(c_from_a)
    return c_from_a @ a_from_b @ b_from_d, at_c + to_d @ config.covariance(b_from_d) @ to_d.T


@dataclass(frozen=True, eq=False)
class TransformConsensus:
    """What the estimates where `is_inlier` is True say together.

    `covariance` is that of the left perturbation (m, rad); it does not shrink by estimates that
    share a picture, and grows where those that agree scatter by more than they should.
    `num_independent` counts them with each picture taken once.
    """

    a_from_b: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    is_inlier: Bool[np.ndarray, " n"]
    num_independent: int


def find_consensus(
    a_from_bs: Sequence[Rigid3],
    covariances: Float[np.ndarray, "n 6 6"],
    config: ConsensusConfig,
    image_ids: Int[np.ndarray, "n 2"] | None = None,
) -> TransformConsensus | None:
    """The transform that the estimates support; None where none is supported well enough, or
    another one nearly as well.

    Args:
        covariances: of the left perturbations, ``exp(xi) @ a_from_b``, m and rad, symmetric and
            positive definite. They must be honest: what is far too certain agrees with nothing,
            what is uncertain with everything. Leave out what says nothing.
        pictures: which picture of a and which of b each estimate was made from: estimates that
            share one are not independent. By default all are.
    """
    num = len(a_from_bs)
    if num < config.min_independent:
        return None
    if image_ids is None:
        image_ids = np.column_stack([np.arange(num), np.arange(num)])
    distances = _pairwise_distances(a_from_bs, covariances, config)
    best, agreeing = _select_best_hypothesis(distances <= config.max_sigmas, image_ids)
    if agreeing < config.min_independent:
        return None
    is_inlier = distances[best] <= config.max_sigmas
    a_from_b, covariance = _refine_transform(a_from_bs, covariances, is_inlier)
    sigmas = _distances(a_from_b, covariance, a_from_bs, covariances)
    is_inlier, others = sigmas <= config.max_sigmas, sigmas > config.rival_sigmas
    num_independent = _count_independent(is_inlier, image_ids)
    _, rivals = _select_best_hypothesis((distances <= config.max_sigmas) & others, image_ids)
    if num_independent < config.min_independent or rivals >= max(
        config.rival_share * num_independent, 2
    ):
        return None
    a_from_b, covariance = _refine_transform(a_from_bs, covariances, is_inlier)
    return TransformConsensus(
        a_from_b,
        covariance * np.count_nonzero(is_inlier) / num_independent,
        is_inlier,
        num_independent,
    )


def _pairwise_distances(
    a_from_bs: Sequence[Rigid3], covariances: Float[np.ndarray, "n 6 6"], config: ConsensusConfig
) -> Float[np.ndarray, "h n"]:
    """Of each hypothesis, a row: how far all estimates are from it, in sigma of both."""
    num = len(a_from_bs)
    tried = np.arange(num)
    if num > config.max_hypotheses:
        tried = np.sort(np.random.default_rng(0).choice(num, config.max_hypotheses, replace=False))
    return np.stack(
        [_distances(a_from_bs[k], covariances[k], a_from_bs, covariances) for k in tried.tolist()]
    )


def _distances(
    hypothesis: Rigid3,
    covariance: Float[np.ndarray, "6 6"],
    a_from_bs: Sequence[Rigid3],
    covariances: Float[np.ndarray, "n 6 6"],
) -> Float[np.ndarray, " n"]:
    residuals = _residuals(hypothesis, a_from_bs)
    return np.sqrt(
        np.einsum(
            "ni,ni->n",
            residuals,
            np.linalg.solve(covariances + covariance, residuals[..., None])[..., 0],
        )
    )


def _residuals(hypothesis: Rigid3, a_from_bs: Sequence[Rigid3]) -> Float[np.ndarray, "n 6"]:
    """Logarithms of ``a_from_b @ hypothesis^-1``, all at once; of turns near pi the axis is not
    exact, which nothing asks for."""
    inverse = hypothesis.inverse()
    rotations = np.stack([estimate.rotation for estimate in a_from_bs])
    translations = (
        np.stack([estimate.translation for estimate in a_from_bs]) + rotations @ inverse.translation
    )
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
    return np.column_stack(
        [translations - 0.5 * once + curvature[:, None] * np.cross(omega, once), omega]
    )


def _select_best_hypothesis(
    agree: Bool[np.ndarray, "h n"], image_ids: Int[np.ndarray, "n 2"]
) -> tuple[int, int]:
    """The hypothesis that most independent estimates agree with, of equals that with most
    estimates, and how many the former are."""
    counts = agree.sum(axis=1)
    best, support = 0, 0
    for k in np.argsort(-counts, kind="stable").tolist():
        if counts[k] <= support:
            break
        num = _count_independent(agree[k], image_ids)
        if num > support:
            best, support = k, num
    return best, support


def _count_independent(chosen: Bool[np.ndarray, " n"], image_ids: Int[np.ndarray, "n 2"]) -> int:
    """How many of the chosen estimates can be had with no picture taken twice: those go first whose
    pictures have the fewest others."""
    pairs = image_ids[chosen]
    partners = sum(
        (
            counts[inverse]
            for _, inverse, counts in (
                np.unique(side, return_inverse=True, return_counts=True) for side in pairs.T
            )
        ),
        np.zeros(len(pairs), np.int64),
    )
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
    """Weighted least squares over those that agree, from the most certain of them on; its
    covariance, scaled up to what they scatter by."""
    rows = np.flatnonzero(is_inlier).tolist()
    chosen, informations = [a_from_bs[k] for k in rows], np.linalg.inv(covariances[rows])
    mean = chosen[int(np.argmax(np.linalg.slogdet(informations).logabsdet))]
    covariance = np.linalg.inv(informations.sum(axis=0))
    for _ in range(_NUM_ITERATIONS):
        residuals = _residuals(mean, chosen)
        step = covariance @ np.einsum("nij,nj->i", informations, residuals)
        mean = Rigid3.exp(step) @ mean
        if np.abs(step).max() < _MIN_STEP:
            break
    residuals = _residuals(mean, chosen)
    square = float(np.einsum("ni,nij,nj->", residuals, informations, residuals))
    return mean, covariance * max(1.0, square / (6.0 * max(len(chosen) - 1, 1)))
