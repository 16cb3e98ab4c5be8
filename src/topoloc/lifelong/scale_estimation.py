"""Estimate the metric scale of monocular motion from localizations of some of its images, and the
noise scales of a session's motion and of the map's localizations from each other.

The scale drifts along the trajectory. Its logarithm is modelled as a random walk. Least squares
over knots along the trajectory fit it to the distances between localizations and give its
uncertainty. The inlier localizations are selected first: the largest set that one similarity
transform explains.

Assumed sigmas are wrong by a different factor in each recording. SLAM of a rendered loop drifts by
about a thousandth of the distance. A hand-held camera with a nominal calibration drifts by some
hundredths. The localizations' sigmas describe the worst parts of a map. The scatter between
consecutive localizations and its growth with distance separate the two (variance components,
Harville, JASA 72, 1977). A Kalman filter predicts the motion from localization to localization and
corrects it by each. The factors with the highest likelihood are selected. Student's t distribution
limits the effect of wrong localizations.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.geometry.alignment import compute_path_lengths
from topoloc.geometry.rigid import Rigid3, positions_of
from topoloc.geometry.transform_consensus import select_hypothesis
from topoloc.lifelong.node_localization import sample_evenly
from topoloc.localization.result import Localization

_DEGREES_OF_FREEDOM = 4.0  # of Student's t distribution: fewer give an outlier less weight
_NUM_DIMENSIONS = 6


@dataclass(frozen=True)
class NoiseScale:
    """Hold the factors by which the sigmas of the motion and of the localizations differ from the
    assumed ones."""

    motion: float = 1.0
    answers: float = 1.0


@dataclass(frozen=True, eq=False)
class LocalizedStep:
    """Hold a localized image and the motion to it from the previous localized image.

    The first step's `cam_from_before` and `motion_covariance` (6, 6) have no meaning. Covariances
    belong to left perturbations (translation, rotation, in metres and radians) of `cam_from_before`
    and of the localization `cam_from_world`.
    """

    cam_from_before: Rigid3
    motion_covariance: Float[np.ndarray, "6 6"]
    cam_from_world: Rigid3
    covariance: Float[np.ndarray, "6 6"]


def fit_noise_scale(
    steps: Sequence[LocalizedStep], motion_scales: Sequence[float], answer_scales: Sequence[float]
) -> NoiseScale:
    """Return the pair of factors with the highest likelihood, or 1 and 1 if there are fewer than
    two steps."""
    if len(steps) < 2:
        return NoiseScale()
    adjoints = [step.cam_from_before.adjoint() for step in steps]
    return min(
        (NoiseScale(*pair) for pair in product(motion_scales, answer_scales)),
        key=lambda scale: _negative_log_likelihood(steps, adjoints, scale),
    )


def _negative_log_likelihood(
    steps: Sequence[LocalizedStep], adjoints: Sequence[Float[np.ndarray, "6 6"]], scale: NoiseScale
) -> float:
    """Compute -2 times the log-likelihood of the localizations after the first, without
    constants."""
    pose, covariance = steps[0].cam_from_world, scale.answers**2 * steps[0].covariance
    cost, total = 0.0, _DEGREES_OF_FREEDOM + _NUM_DIMENSIONS
    for step, adjoint in zip(steps[1:], adjoints[1:], strict=True):
        pose = step.cam_from_before @ pose
        covariance = adjoint @ covariance @ adjoint.T + scale.motion**2 * step.motion_covariance
        of_answer = scale.answers**2 * step.covariance
        off = (step.cam_from_world @ pose.inverse()).log()
        both = covariance + of_answer
        square = float(off @ np.linalg.solve(both, off))
        outlier = math.log1p(square / _DEGREES_OF_FREEDOM)
        cost += float(np.linalg.slogdet(both)[1]) + total * outlier
        # an outlier corrects the pose less
        inflation = max((_DEGREES_OF_FREEDOM + square) / total, 1.0)
        gain = np.linalg.solve(covariance + inflation * of_answer, covariance).T
        pose = Rigid3.exp(gain @ off) @ pose
        covariance = covariance - gain @ covariance
        covariance = (covariance + covariance.T) / 2.0
    return cost


# Factor applied to the sigmas of localizations, because neighbours share errors of the map.
WIDENED = 3.0


@dataclass(frozen=True, eq=False)
class _LocalizedFrames:
    """Hold the poses of localized frames, in the map and in the motion, with the distances
    travelled and the localizations' position sigmas (metres)."""

    rows: Int[np.ndarray, " k"]
    odom: Float[np.ndarray, "k 3"]
    odom_rotations: Float[np.ndarray, "k 3 3"]
    world: Float[np.ndarray, "k 3"]
    world_rotations: Float[np.ndarray, "k 3 3"]
    path_lengths: Float[np.ndarray, " k"]
    sigmas: Float[np.ndarray, " k"]

    def select(self, rows: Int[np.ndarray, " m"]) -> _LocalizedFrames:
        """Return these rows of all columns."""
        return _LocalizedFrames(*(column[rows] for column in vars(self).values()))


@dataclass(frozen=True)
class MotionTolerance:
    """Hold the tolerance between two localizations: a constant part (m, degrees), and the drift per
    metre travelled between them (m, degrees)."""

    slack: float
    slack_deg: float
    drift: float
    drift_deg: float


def find_motion_consensus(
    odom: Mapping[int, Rigid3],
    localized: Mapping[int, Localization],
    tolerance: MotionTolerance,
    *,
    is_metric: bool,
) -> list[int]:
    """Return the frames of the largest set of localizations that one transform of the motion
    (`odom`, poses by frame) explains. It is rigid if the motion has metric scale (`is_metric`),
    otherwise a similarity transform."""
    answers = _collect_localized_frames(odom, localized)
    hypotheses = (
        [(row, 1.0) for row in range(len(answers.rows))]
        if is_metric
        else list(_similarity_hypotheses(answers))
    )
    if not hypotheses:
        return []
    agree = np.stack([_find_inliers(answers, *one, tolerance) for one in hypotheses])
    best, _ = select_hypothesis(agree)
    return [index for index, is_in in zip(localized, agree[best], strict=True) if is_in]


def _similarity_hypotheses(answers: _LocalizedFrames) -> Iterator[tuple[int, float]]:
    """Generate a localization and the scale of its distance from another one, for pairs that are
    clearly apart."""
    # Number of localizations, evenly spaced, of which all pairs are tried as a similarity
    # transform.
    max_rows = 40
    for i, j in permutations(sample_evenly(range(len(answers.rows)), max_rows), 2):
        apart, own_apart = (
            float(np.linalg.norm(places[i] - places[j])) for places in (answers.world, answers.odom)
        )
        sigma = WIDENED * float(np.hypot(answers.sigmas[i], answers.sigmas[j]))
        if own_apart > 0.0 and apart > sigma:
            yield i, apart / own_apart


def _find_inliers(
    answers: _LocalizedFrames, row: int, scale: float, tolerance: MotionTolerance
) -> Bool[np.ndarray, " k"]:
    """Return the inliers of the transform with this scale that localization `row` defines."""
    turn = answers.world_rotations[row] @ answers.odom_rotations[row].T
    ways = scale * (answers.odom - answers.odom[row]) @ turn.T
    off = np.linalg.norm(answers.world - answers.world[row] - ways, axis=1)
    traces = np.einsum("kij,kij->k", answers.world_rotations, turn @ answers.odom_rotations)
    turned = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    length = scale * np.abs(answers.path_lengths - answers.path_lengths[row])
    return (off <= tolerance.slack + tolerance.drift * length) & (
        turned <= tolerance.slack_deg + tolerance.drift_deg * length
    )


def scale_to_metres(
    odom: Mapping[int, Rigid3],
    localized: Mapping[int, Localization],
    drift: float = 0.01,
    max_sigma: float = 0.1,
) -> dict[int, Rigid3]:
    """Return the motion with its steps in metres, according to localizations that agree with each
    other. The world of the motion stays at its first frame.

    `drift` is the sigma of the logarithm of the scale after one metre. It grows with the square
    root of the distance. Frames whose scale has a relative sigma above `max_sigma` are left out.
    """
    answers = _collect_localized_frames(odom, localized)
    positions = positions_of(odom.values())
    path_lengths, pairs = compute_path_lengths(positions), _select_pairs(answers)
    if len(pairs) == 0:
        return {}
    logs, sigmas = _estimate_scale_profile(path_lengths, answers, pairs, drift)
    steps = np.exp(0.5 * (logs[1:] + logs[:-1]))[:, None] * np.diff(positions, axis=0)
    metric = positions[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return {
        index: Rigid3(pose.rotation, position)
        for (index, pose), position, sigma in zip(odom.items(), metric, sigmas, strict=True)
        if sigma <= max_sigma
    }


def _estimate_scale_profile(
    path_lengths: Float[np.ndarray, " n"],
    answers: _LocalizedFrames,
    pairs: Int[np.ndarray, "p 2"],
    drift: float,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the logarithm of the scale at each frame and its sigma."""
    max_knots = 200  # maximum number of knots along the trajectory at which the scale is estimated
    a, b = answers.select(pairs[:, 0]), answers.select(pairs[:, 1])
    apart = np.linalg.norm(a.world - b.world, axis=1)
    measured = np.log(apart / np.linalg.norm(a.odom - b.odom, axis=1))
    sigmas = WIDENED * np.hypot(a.sigmas, b.sigmas) / apart
    num = len(path_lengths)
    rows = np.linspace(0, num - 1, min(num, max_knots)).astype(int)
    knots = np.unique(path_lengths[rows])
    metre = float(np.exp(np.median(measured)))
    # The mean weight of each knot in the linear interpolation between the two localizations.
    between = np.linspace(a.path_lengths, b.path_lengths, 9)
    hats = (np.interp(between, knots, hat) for hat in np.eye(len(knots)))
    mean = np.stack([hat.mean(axis=0) for hat in hats], axis=1)
    steps = drift * np.sqrt(np.maximum(np.diff(knots) * metre, 1e-9))
    difference = np.diff(np.eye(len(knots)), axis=0) / steps[:, None]
    matrix = np.concatenate([mean / sigmas[:, None], difference])
    covariance = np.linalg.inv(matrix.T @ matrix + 1e-12 * np.eye(len(knots)))
    logs = covariance @ (matrix[: len(mean)].T @ (measured / sigmas))
    knot_sigmas = np.sqrt(np.diag(covariance))
    return np.interp(path_lengths, knots, logs), np.interp(path_lengths, knots, knot_sigmas)


def _select_pairs(answers: _LocalizedFrames) -> Int[np.ndarray, "p 2"]:
    """Pair each localization with the 1st, 2nd, 4th, ... after it. Keep pairs whose distance is
    clearly larger than its uncertainty."""
    num, pairs = len(answers.rows), []
    for offset in (2**power for power in range(16) if 2**power < num):
        first = np.arange(num - offset)
        second = first + offset
        apart = np.linalg.norm(answers.world[first] - answers.world[second], axis=1)
        own_apart = np.linalg.norm(answers.odom[first] - answers.odom[second], axis=1)
        clear = apart > 3.0 * WIDENED * np.hypot(answers.sigmas[first], answers.sigmas[second])
        pairs.append(np.column_stack([first, second])[clear & (own_apart > 0.0)])
    return np.concatenate(pairs) if pairs else np.zeros((0, 2), np.int64)


def _collect_localized_frames(
    odom: Mapping[int, Rigid3], localized: Mapping[int, Localization]
) -> _LocalizedFrames:
    row_of = {index: row for row, index in enumerate(odom)}
    rows = np.array([row_of[index] for index in localized], np.int64)
    path_lengths = compute_path_lengths(positions_of(odom.values()))
    poses, found = [odom[index] for index in localized], list(localized.values())
    return _LocalizedFrames(
        rows,
        positions_of(poses),
        np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3),
        positions_of(answer.world_from_cam for answer in found),
        np.array([answer.world_from_cam.rotation for answer in found]).reshape(-1, 3, 3),
        path_lengths[rows],
        np.array([answer.position_sigma_m for answer in found]),
    )
