"""Correct a trajectory towards the map's localizations.

A bundle adjustment balances a hundred localizations against thousands of tracked points. So a bent
trajectory stays bent, for example after a slightly wrong calibration or with sliding points. The
remaining difference changes slowly along the trajectory. New nodes must agree with the map's nodes
beside them, even if both share an error. So the trajectory takes over the smoothed difference of
the localizations around each position. Outliers are down-weighted. The correction decays before the
first localization and after the last.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from topoloc.bounds import Above
from topoloc.geometry.alignment import compute_path_lengths
from topoloc.geometry.rigid import Rigid3, exp_so3, log_so3
from topoloc.localization.result import Localization

_NUM_ITERATIONS, _MAX_SIGMAS = 4, 3.0


@dataclass(frozen=True)
class CorrectionConfig:
    """Configure the correction of a trajectory towards the localizations."""

    reach: Annotated[float, Above(0)] = 1.0
    """Length scale over which the correction is smoothed, in D_thresh."""
    stray: Annotated[float, Above(0)] = 0.1
    """Prior sigma of the correction, in D_thresh. A localization this far from the local mean has
    half the weight."""
    stray_deg: Annotated[float, Above(0)] = 0.5
    """The same for the rotation, in degrees."""


@dataclass(frozen=True, eq=False)
class _Corrections:
    """Hold shifts (metres, world) and rotation vectors (radians, world) at path lengths
    (metres)."""

    path_lengths: Float[np.ndarray, " k"]
    shifts: Float[np.ndarray, "k 3"]
    rotation_vectors: Float[np.ndarray, "k 3"]

    def at(
        self, path_length: float, reach_m: float
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Interpolate the correction linearly. It decays beyond both ends."""
        beyond = (
            max(self.path_lengths[0] - path_length, path_length - self.path_lengths[-1], 0.0)
            / reach_m
        )
        decay = float(np.exp(-0.5 * beyond**2))
        shift, rotation_vector = (
            np.array([np.interp(path_length, self.path_lengths, column) for column in rows.T])
            for rows in (self.shifts, self.rotation_vectors)
        )
        return decay * shift, decay * rotation_vector


def correct_trajectory(
    world_from_cams: Sequence[Rigid3 | None],
    answers: Mapping[int, Localization],
    d_thresh: float,
    config: CorrectionConfig,
) -> list[Rigid3 | None]:
    """Return the corrected poses. None stays None.

    Args:
        world_from_cams: the poses by frame.
        answers: the trusted localizations, by frame.
        d_thresh: D_thresh of the map, in metres.
        config: the settings.
    """
    poses = {index: pose for index, pose in enumerate(world_from_cams) if pose is not None}
    answered = [
        index
        for index, answer in answers.items()
        if index in poses and _is_correctable(poses[index], answer)
    ]
    if not answered:
        return list(world_from_cams)
    path_lengths = dict(
        zip(
            poses,
            compute_path_lengths(np.array([pose.translation for pose in poses.values()])),
            strict=True,
        )
    )
    at = np.array([path_lengths[index] for index in answered])
    corrections = _estimate_corrections(
        [poses[index] for index in answered],
        [answers[index] for index in answered],
        at,
        d_thresh,
        config,
    )
    moved = {
        index: _apply_correction(
            pose, *corrections.at(path_lengths[index], config.reach * d_thresh)
        )
        for index, pose in poses.items()
    }
    return [moved.get(index) for index in range(len(world_from_cams))]


def _apply_correction(
    pose: Rigid3, shift: Float[np.ndarray, "3"], rotation_vector: Float[np.ndarray, "3"]
) -> Rigid3:
    return Rigid3(exp_so3(rotation_vector) @ pose.rotation, pose.translation + shift)


def _is_correctable(pose: Rigid3, answer: Localization) -> bool:
    """Return whether the pose is within three sigmas of the localization. Otherwise one of the two
    is wrong, and a correction cannot decide which."""
    return pose.is_same(
        answer.world_from_cam,
        _MAX_SIGMAS * answer.position_sigma_m,
        math.radians(_MAX_SIGMAS * answer.rotation_sigma_deg),
    )


def _pose_error(
    pose: Rigid3, answer: Localization
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    return answer.world_from_cam.translation - pose.translation, log_so3(
        answer.world_from_cam.rotation @ pose.rotation.T
    )


def _estimate_corrections(
    poses: Sequence[Rigid3],
    answers: Sequence[Localization],
    path_lengths: Float[np.ndarray, " k"],
    d_thresh: float,
    config: CorrectionConfig,
) -> _Corrections:
    """Estimate the correction at each localization from the localizations around it."""
    errors = [_pose_error(pose, answer) for pose, answer in zip(poses, answers, strict=True)]
    sigmas_m = np.array([answer.position_sigma_m for answer in answers])
    sigmas = np.radians([answer.rotation_sigma_deg for answer in answers])
    near = np.exp(
        -0.5 * (np.subtract.outer(path_lengths, path_lengths) / (config.reach * d_thresh)) ** 2
    )
    shifts = _robust_mean(
        near, np.array([shift for shift, _ in errors]), sigmas_m, config.stray * d_thresh
    )
    return _Corrections(
        path_lengths,
        shifts,
        _robust_mean(
            near,
            np.array([rotation_vector for _, rotation_vector in errors]),
            sigmas,
            math.radians(config.stray_deg),
        ),
    )


def _robust_mean(
    near: Float[np.ndarray, "k k"],
    rows: Float[np.ndarray, "k 3"],
    sigmas: Float[np.ndarray, " k"],
    stray: float,
) -> Float[np.ndarray, "k 3"]:
    """Return the local mean around each row, with zero correction of sigma `stray` as the prior and
    Cauchy weights for outliers."""
    weights = near / np.maximum(sigmas, 1e-9) ** 2
    common, robust = rows, weights
    for _ in range(_NUM_ITERATIONS):
        common = robust @ rows / (robust.sum(axis=1, keepdims=True) + 1.0 / stray**2)
        apart = np.linalg.norm(rows[None] - common[:, None], axis=2) / stray
        robust = weights / (1.0 + apart**2)
    return common
