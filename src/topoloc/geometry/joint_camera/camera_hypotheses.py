"""Hold hypotheses about a camera: priors of eleven parameters (`joint_fit.py`), and their
probabilities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from msgspec import Struct

from topoloc.errors import CalibrationError
from topoloc.json_data import Positive, decode_json

Lens = Literal["none", "radial", "other"]
Axes = Literal["", "x", "y", "xy"]
Vector = Float[np.ndarray, " 11"]
Matrix = Float[np.ndarray, "11 11"]


def unchanged_camera() -> Vector:
    """Return the parameters of the camera that others are compared with."""
    return np.zeros(11)


class _Priors(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the numbers of `priors.json`: prior odds of a focal length outside its stated range, of
    a principal point off the centre, and of each lens; standard deviations of the principal point
    (image sides) and of the distortion; growth of the variance with rho of the map."""

    corpus: str
    command: str
    date: str
    unstated_focal: Positive
    off_centre: dict[Axes, Positive]
    lens: dict[Lens, Positive]
    centred_sigma: Positive
    off_centre_sigma: Positive
    no_lens_sigma: Positive
    lens_sigma: Positive
    lens_quintic_sigma: Positive
    turning: Positive
    turning_sigma: Positive
    map_variance: Positive


@cache
def _priors() -> _Priors:
    path = Path(__file__).parent / "priors.json"
    return decode_json(path.read_bytes(), _Priors, CalibrationError, str(path))


def map_variance(correlated_error_share: float) -> float:
    """Return the factor of a camera estimate's variance in a map with this rho: its points have
    errors in common, which one image does not show."""
    return 1.0 + _priors().map_variance * min(correlated_error_share, 1.0)


@dataclass(frozen=True)
class CameraHypothesis:
    """Hold what is assumed of a camera: whether its focal length is in the stated range, the axes
    in which its principal point is off the image centre, and the kind of distortion."""

    is_focal_stated: bool = True
    off_centre: Axes = ""
    lens: Lens = "none"
    is_turning: bool = False

    @property
    def log_prior(self) -> float:
        """Return the logarithm of the prior probability, but for a constant."""
        odds = _priors().lens[self.lens]
        odds *= _priors().off_centre[self.off_centre]
        odds *= _priors().turning if self.is_turning else 1.0
        return math.log(odds if self.is_focal_stated else odds * _priors().unstated_focal)

    @property
    def basis(self) -> Float[np.ndarray, "11 k"]:
        """Return the directions in which the parameters are estimated: always the principal point,
        because that of a whole image is off its centre by up to a per cent, too."""
        eye = np.eye(11)
        radial = np.column_stack([eye[:, 3:7].sum(axis=1), eye[:, 7]])
        turning = eye[:, 8:] if self.is_turning else eye[:, :0]
        lens = {"none": eye[:, :0], "radial": radial, "other": eye[:, 3:8]}[self.lens]
        return np.hstack([eye[:, :3], lens, turning])


_DEVIATIONS = (
    CameraHypothesis(),
    CameraHypothesis(is_focal_stated=False),
    CameraHypothesis(off_centre="x"),
    CameraHypothesis(off_centre="y"),
    CameraHypothesis(off_centre="xy"),
    CameraHypothesis(is_focal_stated=False, off_centre="xy"),
    CameraHypothesis(lens="radial"),
    CameraHypothesis(lens="other"),
    CameraHypothesis(is_turning=True),
)
_AT_REST_SIGMA = 1e-5  # rad


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """Hold the priors of the parameters and the hypotheses that they distinguish. `sides` are width
    and height, in focal lengths.

    `stated` and `usual` are mean and standard deviation of the logarithm of the focal length, by
    its stated range and without it. They are equal if no range is stated.
    """

    sides: tuple[float, float]
    stated: tuple[float, float]
    usual: tuple[float, float]
    hypotheses: tuple[CameraHypothesis, ...]

    @staticmethod
    def of_unknown(
        sides: tuple[float, float], stated: tuple[float, float], usual: tuple[float, float]
    ) -> CameraPrior:
        """Return the prior of a camera without calibration: all combinations but a rotation."""
        is_stated, odds = (True,) if stated == usual else (True, False), _priors()
        every = product(is_stated, odds.off_centre, odds.lens)
        return CameraPrior(sides, stated, usual, tuple(CameraHypothesis(*each) for each in every))

    @staticmethod
    @lru_cache(maxsize=64)
    def of_calibration(sides: tuple[float, float], may_turn: bool) -> CameraPrior:
        """Return the prior of a calibrated camera: one part of the calibration may be wrong, or the
        camera may have turned while its rows were read."""
        stated, usual = (0.0, 0.01), (0.0, 0.3)
        return CameraPrior(sides, stated, usual, _DEVIATIONS if may_turn else _DEVIATIONS[:-1])

    def moments(self, hypothesis: CameraHypothesis) -> tuple[Vector, Matrix]:
        """Return mean and covariance of the parameters under a hypothesis."""
        focal = self.stated if hypothesis.is_focal_stated else self.usual
        mean, priors = unchanged_camera(), _priors()
        offsets = [
            side * priors.off_centre_sigma
            if axis in hypothesis.off_centre
            else max(self.sides) * priors.centred_sigma
            for axis, side in zip("xy", self.sides, strict=True)
        ]
        mean[0] = focal[0]
        is_lens = hypothesis.lens != "none"
        quintic = priors.lens_quintic_sigma if is_lens else priors.no_lens_sigma
        turning = priors.turning_sigma if hypothesis.is_turning else _AT_REST_SIGMA
        sigmas = [focal[1], *offsets, *[priors.no_lens_sigma] * 4, quintic, *[turning] * 3]
        covariance = np.diag(np.square(sigmas))
        if is_lens:
            covariance[3:7, 3:7] += priors.lens_sigma**2
        if hypothesis.lens == "other":
            covariance[3:7, 3:7] += priors.lens_sigma**2 * np.eye(4)
        return mean, covariance

    @cached_property
    def _table(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        means, covariances = map(np.array, zip(*map(self.moments, self.hypotheses), strict=True))
        return means, covariances, np.array([each.log_prior for each in self.hypotheses])

    def weigh(self, seen: CameraLikelihood) -> dict[CameraHypothesis, tuple[float, Vector, Matrix]]:
        """Return the probability of each hypothesis, and the parameters' mean and covariance under
        it."""
        means, covariances, log_priors = self._table
        evidence, estimates, posteriors = seen.posteriors(means, covariances)
        logs = evidence + log_priors
        shares = np.exp(logs - logs.max())
        found = zip((shares / shares.sum()).tolist(), estimates, posteriors, strict=True)
        return dict(zip(self.hypotheses, found, strict=True))


@dataclass(frozen=True, eq=False)
class CameraLikelihood:
    """Hold what images show of the camera parameters: `information`, and `pull`, the information
    times the estimate by the images alone."""

    information: Matrix
    pull: Vector

    def posteriors(
        self, means: Float[np.ndarray, "k 11"], covariances: Float[np.ndarray, "k 11 11"]
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k 11"], Float[np.ndarray, "k 11 11"]]:
        """Return the logarithm of the evidence of each of k priors, and the parameters' mean and
        covariance under it."""
        by_priors = np.linalg.inv(covariances)
        posteriors = np.linalg.inv(self.information + by_priors)
        weighed = (by_priors @ means[:, :, None])[:, :, 0]
        pull = self.pull + weighed
        estimates = (posteriors @ pull[:, :, None])[:, :, 0]
        evidence = np.sum(pull * estimates, axis=1) - np.sum(means * weighed, axis=1)
        evidence -= np.linalg.slogdet(np.eye(11) + covariances @ self.information)[1]
        return 0.5 * evidence, estimates, posteriors


@dataclass(frozen=True, eq=False)
class WeighedCamera:
    """Hold a hypothesis with its probability, and the error of the reported pose if it is right:
    mean and covariance of the left perturbation (metres, radians)."""

    hypothesis: CameraHypothesis
    probability: float
    shift: Float[np.ndarray, " 6"]
    covariance: Float[np.ndarray, "6 6"]


@dataclass(frozen=True, eq=False)
class CameraBelief:
    """Hold the hypotheses about a camera, and the one by which the pose is reported."""

    reported: CameraHypothesis
    weighed: Sequence[WeighedCamera]

    @property
    def is_contradicted(self) -> bool:
        """Return whether the residuals contradict the reported camera."""
        return self._chosen.probability < 0.5

    @property
    def _chosen(self) -> WeighedCamera:
        return next(camera for camera in self.weighed if camera.hypothesis == self.reported)

    @cached_property
    def covariance(self) -> Float[np.ndarray, "6 6"]:
        """Return the covariance that the camera adds to the pose: under the reported hypothesis, or
        under all of them if the residuals contradict it."""
        counted = self.weighed if self.is_contradicted else [self._chosen]
        total = sum(camera.probability for camera in counted)
        parts = [
            camera.probability * (camera.covariance + np.outer(camera.shift, camera.shift))
            for camera in counted
        ]
        return np.sum(parts, axis=0) / total

    def probability_within(self, metres: float, radians: float) -> float:
        """Return the probability that the camera moves the pose by less than both tolerances."""
        return sum(
            camera.probability
            * _probability_below(metres, camera.shift[:3], camera.covariance[:3, :3])
            * _probability_below(radians, camera.shift[3:], camera.covariance[3:, 3:])
            for camera in self.weighed
        )


def _probability_below(
    limit: float, mean: Float[np.ndarray, " 3"], covariance: Float[np.ndarray, "3 3"]
) -> float:
    """Return the probability that a normal vector is shorter than a limit.

    Its squared length is about a shifted chi-square variable with the same three cumulants (Imhof,
    Biometrika 1961), whose cube root is about normal (Wilson and Hilferty, PNAS 1931).
    """
    squared = covariance @ covariance
    expected = np.trace(covariance) + mean @ mean
    variance = 2.0 * np.vdot(covariance, covariance) + 4.0 * mean @ covariance @ mean
    if variance < 1e-18:
        return float(expected < limit**2)
    third = 8.0 * np.vdot(squared, covariance) + 24.0 * mean @ squared @ mean
    spread = float(third**2 / (36.0 * variance**3))  # 2 / 9 of a degree of freedom
    ratio = 1.0 + 3.0 * float(limit**2 - expected) * math.sqrt(spread / variance)
    if ratio <= 0.0:
        return 0.0
    return 0.5 * (1.0 + math.erf((ratio ** (1.0 / 3.0) - 1.0 + spread) / math.sqrt(2.0 * spread)))
