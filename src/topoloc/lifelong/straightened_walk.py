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
from topoloc.lifelong.scale_of_motion import ways_of
from topoloc.localization.result import Localization

_ROUNDS, _SIGMAS = 4, 3.0


@dataclass(frozen=True)
class BendConfig:
    """How a walk is drawn to the map's answers."""

    reach: Annotated[float, Above(0)] = 1.0
    """What a walk is bent by is alike over so many D_thresh of the way."""
    stray: Annotated[float, Above(0)] = 0.1
    """The walk is taken for so many D_thresh off (a sigma); an answer that strays so far from what
    those around it say counts for half."""
    stray_deg: Annotated[float, Above(0)] = 0.5
    """The same of its rotation."""


@dataclass(frozen=True, eq=False)
class _Bends:
    """By how far (metres, world) and by which rotation vector (radians, world) the walk is off at
    some metres of its way."""

    ways: Float[np.ndarray, " k"]
    shifts: Float[np.ndarray, "k 3"]
    turns: Float[np.ndarray, "k 3"]

    def at(
        self, way: float, reach_m: float
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """In between, linearly; beyond the ends it fades."""
        beyond = max(self.ways[0] - way, way - self.ways[-1], 0.0) / reach_m
        fading = float(np.exp(-0.5 * beyond**2))
        shift, turn = (
            np.array([np.interp(way, self.ways, column) for column in rows.T])
            for rows in (self.shifts, self.turns)
        )
        return fading * shift, fading * turn


def straightened(
    world_from_cams: Sequence[Rigid3 | None],
    answers: Mapping[int, Localization],
    d_thresh: float,
    config: BendConfig,
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
        if index in poses and _may_be_bent(poses[index], answer)
    ]
    if not answered:
        return list(world_from_cams)
    ways = dict(
        zip(poses, ways_of(np.array([pose.translation for pose in poses.values()])), strict=True)
    )
    at = np.array([ways[index] for index in answered])
    bends = _bends(
        [poses[index] for index in answered],
        [answers[index] for index in answered],
        at,
        d_thresh,
        config,
    )
    moved = {
        index: _moved(pose, *bends.at(ways[index], config.reach * d_thresh))
        for index, pose in poses.items()
    }
    return [moved.get(index) for index in range(len(world_from_cams))]


def _moved(pose: Rigid3, shift: Float[np.ndarray, "3"], turn: Float[np.ndarray, "3"]) -> Rigid3:
    return Rigid3(exp_so3(turn) @ pose.rotation, pose.translation + shift)


def _may_be_bent(pose: Rigid3, answer: Localization) -> bool:
    """Is the walk no further off than the answer may be? Else one of the two is wrong, and no bend
    says which."""
    shift, turn = _off(pose, answer)
    is_near = np.linalg.norm(shift) <= _SIGMAS * answer.position_sigma_m
    return bool(is_near and np.degrees(np.linalg.norm(turn)) <= _SIGMAS * answer.rotation_sigma_deg)


def _off(
    pose: Rigid3, answer: Localization
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    return answer.world_from_cam.translation - pose.translation, log_so3(
        answer.world_from_cam.rotation @ pose.rotation.T
    )


def _bends(
    poses: Sequence[Rigid3],
    answers: Sequence[Localization],
    ways: Float[np.ndarray, " k"],
    d_thresh: float,
    config: BendConfig,
) -> _Bends:
    """What the answers around each say of the walk there."""
    off = [_off(pose, answer) for pose, answer in zip(poses, answers, strict=True)]
    sigmas_m = np.array([answer.position_sigma_m for answer in answers])
    sigmas = np.radians([answer.rotation_sigma_deg for answer in answers])
    near = np.exp(-0.5 * (np.subtract.outer(ways, ways) / (config.reach * d_thresh)) ** 2)
    shifts = _common(near, np.array([shift for shift, _ in off]), sigmas_m, config.stray * d_thresh)
    return _Bends(
        ways,
        shifts,
        _common(near, np.array([turn for _, turn in off]), sigmas, math.radians(config.stray_deg)),
    )


def _common(
    near: Float[np.ndarray, "k k"],
    rows: Float[np.ndarray, "k 3"],
    sigmas: Float[np.ndarray, " k"],
    stray: float,
) -> Float[np.ndarray, "k 3"]:
    """The mean of the rows near each, and of no bend at all with `stray` for its sigma; Cauchy's
    weights for those that stray from it."""
    weights = near / np.maximum(sigmas, 1e-9) ** 2
    common, robust = rows, weights
    for _ in range(_ROUNDS):
        common = robust @ rows / (robust.sum(axis=1, keepdims=True) + 1.0 / stray**2)
        apart = np.linalg.norm(rows[None] - common[:, None], axis=2) / stray
        robust = weights / (1.0 + apart**2)
    return common
