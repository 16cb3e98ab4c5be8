"""Choose the pose on which the cameras of a rig agree, and fuse their estimates of it.

Each camera gives poses of the rig that exclude each other, with probabilities: one, or the
alternatives of an ambiguous image. A camera that does not recognise the place says nothing about
where the rig is. The posterior of a pose is the product over the cameras (Bayes' rule with
independent images and a uniform prior).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.transform_consensus import diagonal_covariance


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Hold one possible pose of the rig by one camera.

    `covariance` is that of the right perturbation (m, rad), `noise_share` the share of it that is
    independent of other cameras. `tile` is the tile in whose world the pose is.
    """

    camera: str
    world_from_rig: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    noise_share: float
    probability: float
    tile: str | None

    def agrees(self, other: PoseEstimate) -> bool:
        """Return whether both are one pose of the rig, as far as mountings are exact."""
        # Mountings of other calibrations are off by less. The squared distance is that of
        # chi^2 with 6 degrees of freedom which one pair in 100,000 exceeds.
        mounting, max_square = diagonal_covariance(0.01, 0.25), 33.0
        return self.tile == other.tile and self.world_from_rig.is_same(
            other.world_from_rig,
            covariance=self.covariance + other.covariance + mounting,
            max_square=max_square,
        )


@dataclass(frozen=True, eq=False)
class RigHypothesis:
    """Hold the estimates of cameras that agree, the best first, and the probability of their pose.
    `seconded` are refused cameras whose images suggest it, too."""

    estimates: tuple[PoseEstimate, ...]
    probability: float
    seconded: frozenset[str] = frozenset()

    @property
    def cameras(self) -> frozenset[str]:
        """Return the names of all cameras for this pose."""
        return self.seconded.union(one.camera for one in self.estimates)

    def outvotes(self, other: RigHypothesis) -> bool:
        """Return whether more cameras are for this pose alone than for another one alone."""
        return len(self._without(other)) > len(other._without(self))

    def _without(self, other: RigHypothesis) -> frozenset[str]:
        """Return the cameras for this pose that exclude the other one."""
        pose = other.estimates[0]
        excluding = frozenset(one.camera for one in self.estimates if not one.agrees(pose))
        return excluding | (self.seconded - other.seconded)


def weigh_poses(
    estimates: Sequence[PoseEstimate], tried: Sequence[PoseEstimate] = ()
) -> list[RigHypothesis]:
    """Return the distinct poses of the rig by their probability, highest first.

    `tried` are poses that the images of refused cameras suggest. They do not make any pose of the
    rig likely, but divide the probability between poses that contradict each other.
    """
    mounted_wrongly = 0.1  # least probability that a camera's sure pose is not the rig's
    by_chance = 0.01  # probability that a wrong pose of another camera is at the same place
    of_camera = dict[str, list[PoseEstimate]]()
    for one in estimates:
        of_camera.setdefault(one.camera, []).append(one)
    none = {name: max(0.0, 1.0 - sum(e.probability for e in of)) for name, of in of_camera.items()}
    scored = list[tuple[float, tuple[PoseEstimate, ...]]]()
    for seed in estimates:
        agreeing, score = list[PoseEstimate](), 1.0
        for name, own in of_camera.items():
            best = max(
                (one for one in own if one is seed or (one.agrees(seed) and name != seed.camera)),
                key=lambda one: one.probability,
                default=None,
            )
            score *= max(none[name], mounted_wrongly) if best is None else best.probability
            agreeing += [] if best is None else [best]
        agreeing.sort(key=lambda one: float(np.trace(one.covariance[:3, :3])))
        scored.append((score, tuple(agreeing)))
    scored.sort(key=lambda pair: (-len(pair[1]), -pair[0]))
    distinct = list[tuple[float, RigHypothesis]]()
    for score, agreeing in scored:
        if not any(set(agreeing) & set(others.estimates) for _, others in distinct):
            distinct.append((score, _second(agreeing, tried)))
    total = sum(score for score, _ in distinct)
    known = total / (total + float(np.prod(list(none.values()))))
    odds = [score * by_chance ** -len(one.cameras) for score, one in distinct]
    weighed = [
        replace(one, probability=known * of / sum(odds))
        for of, (_, one) in zip(odds, distinct, strict=True)
    ]
    return sorted(weighed, key=lambda one: -one.probability)


def _second(agreeing: tuple[PoseEstimate, ...], tried: Sequence[PoseEstimate]) -> RigHypothesis:
    cameras = {one.camera for one in agreeing}
    seconded = {
        one.camera for one in tried if one.camera not in cameras and one.agrees(agreeing[0])
    }
    return RigHypothesis(agreeing, 0.0, frozenset(seconded))


def fuse_poses(estimates: Sequence[PoseEstimate]) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
    """Return the weighted mean of agreeing poses and the covariance of its right perturbation.

    The noise of each image is independent. The errors of the map are taken as common to all, since
    cameras of one body see the same stretch of it, but for what the scatter of the poses shows to
    be independent. If they scatter by more than their covariances, these are too small.
    """
    reference = estimates[0].world_from_rig
    to_reference = [reference.inverse() @ one.world_from_rig for one in estimates]
    differences = [one.log() for one in to_reference]
    weights = [np.linalg.inv(one.covariance) for one in estimates]
    total = np.linalg.inv(np.sum(weights, axis=0))
    gains = [total @ weight for weight in weights]
    mean = np.sum([g @ d for g, d in zip(gains, differences, strict=True)], axis=0)
    scatter = _scatter([d - mean for d in differences], estimates)
    shares = [scatter * one.noise_share for one in estimates]
    covariance, root = np.zeros((6, 6)), np.zeros((6, 6))
    for gain, share, one in zip(gains, shares, estimates, strict=True):
        covariance += share * gain @ one.covariance @ gain.T
        root += math.sqrt(max(0.0, 1.0 - share)) * gain @ np.linalg.cholesky(one.covariance)
    covariance += root @ root.T
    return reference @ Rigid3.exp(mean), 0.5 * (covariance + covariance.T)


def _scatter(
    residuals: Sequence[Float[np.ndarray, "6"]], estimates: Sequence[PoseEstimate]
) -> float:
    """Return the ratio of the scatter to that of the noise, 1 unless it is significantly larger."""
    degrees = 6 * (len(residuals) - 1)
    if degrees == 0:
        return 1.0
    square = sum(
        float(d @ np.linalg.solve(one.noise_share * one.covariance, d))
        for d, one in zip(residuals, estimates, strict=True)
    )
    # Wilson and Hilferty's approximation of the 95 % quantile of chi^2
    limit = degrees * (1.0 - 2.0 / (9.0 * degrees) + 1.645 * math.sqrt(2.0 / (9.0 * degrees))) ** 3
    return square / degrees if square > limit else 1.0
