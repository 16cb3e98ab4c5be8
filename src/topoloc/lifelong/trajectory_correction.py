"""A walk drawn to what the map answers: where the map knows the place, the poses of new nodes must
be those that it would answer itself.

However a single camera's key frames and the map's answers are adjusted together, thousands of
followed points hold a walk that is bent (by a calibration that is not quite the camera's own, or by
points that slide) against a hundred answers. What is left between walk and answers is alike for a
while along the way, and what the answers have in common with the rest of the map is no error: nodes
side by side that disagree are worse than ones that are wrong together. So the walk takes over what
the answers around each of them say, the stray ones among them left out. Beyond the first and the
last answer it keeps its own shape.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from topoloc.bounds import Above
from topoloc.geometry.rigid import Rigid3, exp_so3, log_so3
from topoloc.lifelong.scale_estimation import compute_path_lengths
from topoloc.localization.result import Localization

_NUM_ITERATIONS, _MAX_SIGMAS = 4, 3.0


@dataclass(frozen=True)
class CorrectionConfig:
    """How a walk is drawn to the map's answers."""

    reach: Annotated[float, Above(0)] = 1.0
    """What a walk is bent by is alike over so many D_thresh of the way."""
    stray: Annotated[float, Above(0)] = 0.1
    """The walk is taken for so many D_thresh off (a sigma); an answer that strays so far from what
    those around it say counts for half."""
    stray_deg: Annotated[float, Above(0)] = 0.5
    """The same of its rotation."""


@dataclass(frozen=True, eq=False)
class _Corrections:
    """By how far (metres, world) and by which rotation vector (radians, world) the walk is off at
    some metres of its way."""

    path_lengths: Float[np.ndarray, " k"]
    shifts: Float[np.ndarray, "k 3"]
    rotation_vectors: Float[np.ndarray, "k 3"]

    def at(
        self, path_length: float, reach_m: float
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """In between, linearly; beyond the ends it fades."""
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
    """The poses drawn to the answers; None stays None.

    Args:
        answers: what the map says of some frames, and is believed, by frame.
        d_thresh: of the map (metres).
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
    """Is the walk no further off than the answer may be? Else one of the two is wrong, and no bend
    says which."""
    shift, rotation_vector = _pose_error(pose, answer)
    is_near = np.linalg.norm(shift) <= _MAX_SIGMAS * answer.position_sigma_m
    return bool(
        is_near
        and np.degrees(np.linalg.norm(rotation_vector)) <= _MAX_SIGMAS * answer.rotation_sigma_deg
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
    """What the answers around each say of the walk there."""
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
    """The mean of the rows near each, and of no bend at all with `stray` for its sigma; Cauchy's
    weights for those that stray from it."""
    weights = near / np.maximum(sigmas, 1e-9) ** 2
    common, robust = rows, weights
    for _ in range(_NUM_ITERATIONS):
        common = robust @ rows / (robust.sum(axis=1, keepdims=True) + 1.0 / stray**2)
        apart = np.linalg.norm(rows[None] - common[:, None], axis=2) / stray
        robust = weights / (1.0 + apart**2)
    return common
