"""The metres of a motion that a single camera made in a unit of its own: by what a map answers to
some of its pictures.

The unit drifts along the way. Its logarithm is taken for a random walk, which the distances between
answers hold: least squares over knots along the way, which say how well it is known, too. Which
answers may be right is first found by one similarity that explains most of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.bounds import Above, Between
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Localization


@dataclass(frozen=True)
class ScaleConfig:
    """How the unit of a motion is found, and where it is not known."""

    drift: Annotated[float, Above(0)] = 0.01
    """Sigma of the unit's logarithm after a metre; it grows with the root of the way."""
    max_sigma: Annotated[float, Above(0)] = 0.1
    """Where the unit is less certain than by this share of itself, frames have no pose."""
    max_error: Annotated[float, Above(0)] = 0.05
    """An answer may be off by this share of the way from another one, for one similarity to explain
    both."""
    widened: Annotated[float, Above(0)] = 3.0
    """The map's answers are trusted as if their sigmas were so many times as large."""
    max_pairs: Annotated[int, Between(2, 1000)] = 40
    """Of so many answers, evenly along the way, all pairs are tried for a similarity."""
    max_knots: Annotated[int, Between(2, 10_000)] = 200
    """Places along the way at which the unit is estimated."""


@dataclass(frozen=True, eq=False)
class _LocalizedFrames:
    """Where the map puts some frames, and where the motion does: positions, rotations, ways gone up
    to there, sigmas of the map's."""

    rows: Int[np.ndarray, " k"]
    odom: Float[np.ndarray, "k 3"]
    odom_rotations: Float[np.ndarray, "k 3 3"]
    world: Float[np.ndarray, "k 3"]
    world_rotations: Float[np.ndarray, "k 3 3"]
    path_lengths: Float[np.ndarray, " k"]
    sigmas: Float[np.ndarray, " k"]

    def select(self, rows: Int[np.ndarray, " m"]) -> _LocalizedFrames:
        return _LocalizedFrames(*(column[rows] for column in vars(self).values()))


def find_largest_consensus(
    odom: Mapping[int, Rigid3],
    localized: Mapping[int, Localization],
    slack_m: float,
    slack_deg: float,
    config: ScaleConfig,
) -> list[int]:
    """The frames of the most answers that one similarity of the motion explains but for its drift;
    fewer than three are none."""
    answers = _collect_localized_frames(odom, localized)
    num = len(answers.rows)
    tried = (
        np.unique(np.linspace(0, num - 1, min(num, config.max_pairs)).astype(int))
        if num
        else np.zeros(0, int)
    )
    best: Bool[np.ndarray, " k"] = np.zeros(num, np.bool_)
    for i in tried:
        for j in tried[tried != i]:
            agrees = _find_inliers(answers, int(i), int(j), slack_m, slack_deg, config)
            best = agrees if agrees.sum() > best.sum() else best
    return (
        [index for index, is_in in zip(localized, best, strict=True) if is_in]
        if best.sum() > 2
        else []
    )


def _find_inliers(
    answers: _LocalizedFrames, i: int, j: int, slack_m: float, slack_deg: float, config: ScaleConfig
) -> Bool[np.ndarray, " k"]:
    """By the similarity that turns the motion as answer i says, and makes it as long as i and j
    do."""
    apart, own_apart = (
        float(np.linalg.norm(places[i] - places[j])) for places in (answers.world, answers.odom)
    )
    if own_apart <= 0.0 or apart <= config.widened * float(
        np.hypot(answers.sigmas[i], answers.sigmas[j])
    ):
        return np.zeros(len(answers.rows), np.bool_)
    scale, turn = apart / own_apart, answers.world_rotations[i] @ answers.odom_rotations[i].T
    off = np.linalg.norm(
        answers.world - answers.world[i] - scale * (answers.odom - answers.odom[i]) @ turn.T, axis=1
    )
    traces = np.einsum("kij,kij->k", answers.world_rotations, turn @ answers.odom_rotations)
    turned = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    way = scale * np.abs(answers.path_lengths - answers.path_lengths[i])
    return (off <= slack_m + config.max_error * way) & (turned <= slack_deg + way)


def scale_to_metres(
    odom: Mapping[int, Rigid3], localized: Mapping[int, Localization], config: ScaleConfig
) -> dict[int, Rigid3]:
    """The motion with its steps in metres, as answers that agree say; only where these tell its
    unit. Its world stays the first frame's."""
    answers = _collect_localized_frames(odom, localized)
    positions = np.array([pose.translation for pose in odom.values()])
    path_lengths = compute_path_lengths(positions)
    pairs = _select_pairs(answers, config)
    if len(pairs) == 0:
        return {}
    logs, sigmas = _estimate_scale_profile(path_lengths, answers, pairs, config)
    steps = np.exp(0.5 * (logs[1:] + logs[:-1]))[:, None] * np.diff(positions, axis=0)
    metric = positions[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return {
        index: Rigid3(pose.rotation, position)
        for (index, pose), position, sigma in zip(odom.items(), metric, sigmas, strict=True)
        if sigma <= config.max_sigma
    }


def _estimate_scale_profile(
    path_lengths: Float[np.ndarray, " n"],
    answers: _LocalizedFrames,
    pairs: Int[np.ndarray, "p 2"],
    config: ScaleConfig,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The logarithm of the unit at each frame, and its sigma."""
    a, b = answers.select(pairs[:, 0]), answers.select(pairs[:, 1])
    apart, own_apart = (
        np.linalg.norm(a.world - b.world, axis=1),
        np.linalg.norm(a.odom - b.odom, axis=1),
    )
    measured = np.log(apart / own_apart)
    sigmas = config.widened * np.hypot(a.sigmas, b.sigmas) / apart
    knots = np.unique(
        path_lengths[
            np.linspace(0, len(path_lengths) - 1, min(len(path_lengths), config.max_knots)).astype(
                int
            )
        ]
    )
    metre = float(np.exp(np.median(measured)))
    mean = np.stack(
        [
            _interpolation_weights(np.linspace(u, v, 9), knots).mean(axis=0)
            for u, v in zip(a.path_lengths, b.path_lengths, strict=True)
        ]
    )
    difference = (
        np.diff(np.eye(len(knots)), axis=0)
        / (config.drift * np.sqrt(np.maximum(np.diff(knots) * metre, 1e-9)))[:, None]
    )
    matrix = np.concatenate([mean / sigmas[:, None], difference])
    covariance = np.linalg.inv(matrix.T @ matrix + 1e-12 * np.eye(len(knots)))
    logs = covariance @ (matrix[: len(mean)].T @ (measured / sigmas))
    return np.interp(path_lengths, knots, logs), np.interp(
        path_lengths, knots, np.sqrt(np.diag(covariance))
    )


def _select_pairs(answers: _LocalizedFrames, config: ScaleConfig) -> Int[np.ndarray, "p 2"]:
    """Answers with the ones 1, 2, 4, ... after them that lie apart for more than what they may be
    off."""
    num, pairs = len(answers.rows), []
    for offset in (2**power for power in range(16) if 2**power < num):
        first = np.arange(num - offset)
        second = first + offset
        apart = np.linalg.norm(answers.world[first] - answers.world[second], axis=1)
        own_apart = np.linalg.norm(answers.odom[first] - answers.odom[second], axis=1)
        clear = apart > 3.0 * config.widened * np.hypot(
            answers.sigmas[first], answers.sigmas[second]
        )
        pairs.append(np.column_stack([first, second])[clear & (own_apart > 0.0)])
    return np.concatenate(pairs) if pairs else np.zeros((0, 2), np.int64)


def _collect_localized_frames(
    odom: Mapping[int, Rigid3], localized: Mapping[int, Localization]
) -> _LocalizedFrames:
    row_of = {index: row for row, index in enumerate(odom)}
    rows = np.array([row_of[index] for index in localized], np.int64)
    path_lengths = compute_path_lengths(np.array([pose.translation for pose in odom.values()]))
    poses, found = [odom[index] for index in localized], list(localized.values())
    return _LocalizedFrames(
        rows,
        np.array([pose.translation for pose in poses]).reshape(-1, 3),
        np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3),
        np.array([answer.world_from_cam.translation for answer in found]).reshape(-1, 3),
        np.array([answer.world_from_cam.rotation for answer in found]).reshape(-1, 3, 3),
        path_lengths[rows],
        np.array([answer.position_sigma_m for answer in found]),
    )


def compute_path_lengths(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """How far it is along a motion to each of its positions."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])


def _interpolation_weights(
    at: Float[np.ndarray, " m"], knots: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "m k"]:
    """What each knot counts for a value in between, linearly."""
    right = np.clip(np.searchsorted(knots, at), 1, max(len(knots) - 1, 1))
    share = np.clip((at - knots[right - 1]) / (knots[right] - knots[right - 1]), 0.0, 1.0)
    weights = np.zeros((len(at), len(knots)))
    weights[np.arange(len(at)), right - 1] = 1.0 - share
    weights[np.arange(len(at)), right] += share
    return weights
