"""Bundle adjustment: key frames and the landmarks they see, moved to where they explain pixels and disparities best.

Levenberg-Marquardt with the points eliminated (Triggs et al., *Bundle adjustment: a modern synthesis*, 2000, section 6) and Cauchy's
loss. The reduced system is dense: right for the window of the odometry and for some hundred key frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int

from topoloc.bounds import Above, Between
from topoloc.geometry.rigid import Rigid3
from topoloc.slam.bundle_kernels import eliminate_points, move_points, robust_cost, squared_residuals
from topoloc.slam.keyframes import DisparityBias, KeyFrame, Landmarks


@dataclass(frozen=True)
class BundleConfig:
    """How long and how robustly to optimise; residuals are in standard deviations of the measurements."""

    max_steps: Annotated[int, Between(0, 1000)] = 6
    """Steps of Levenberg and Marquardt, at most."""
    cauchy_scale: Annotated[float, Above(0)] = 2.0
    """Residuals beyond this count less and less."""
    min_decrease: Annotated[float, Between(0, 1)] = 1e-3
    """A step that lowers the cost by less than this share of it is the last one."""
    outlier_square: Annotated[float, Above(0)] = 25.0
    """Squared residual, summed over x, y and disparity, from which on an observation is wrong and used no more."""


@dataclass(eq=False)
class _Problem:
    """Poses, points and observations as arrays, the observations sorted by point."""

    rotations: Float[np.ndarray, "k 3 3"]
    translations: Float[np.ndarray, "k 3"]
    cameras: Float[np.ndarray, "k 6"]
    slots: Int[np.ndarray, " k"]
    columns: Int[np.ndarray, " k"]
    biases: list[DisparityBias]
    points: Float[np.ndarray, "n 3"]
    starts: Int[np.ndarray, " n1"]
    frames: Int[np.ndarray, " m"]
    rows: Int[np.ndarray, " m"]
    measured: Float[np.ndarray, "m 3"]
    weights: Float[np.ndarray, "m 3"]

    def cost(self, rotations: np.ndarray, translations: np.ndarray, points: np.ndarray, cameras: np.ndarray, scale: float) -> float:
        """Robust cost of the observations, and of biases other than expected."""
        prior = sum(bias.information * (cameras[k, 5] - bias.value_px) ** 2 for bias, k in self.first_of_biases())
        return float(robust_cost(self.squares(rotations, translations, points, cameras), scale**2)) + prior

    def squares(self, rotations: np.ndarray, translations: np.ndarray, points: np.ndarray, cameras: np.ndarray) -> Float[np.ndarray, " m"]:
        squares = np.empty(len(self.frames))
        squared_residuals(rotations, translations, cameras, points, self.frames, self.rows, self.measured, self.weights, squares)
        return squares

    def first_of_biases(self) -> list[tuple[DisparityBias, int]]:
        first_column = 6 * int(self.slots.max() + 1)
        return [(bias, int(np.argmax(self.columns == first_column + i))) for i, bias in enumerate(self.biases)]

    def add_priors(self, matrix: np.ndarray, vector: np.ndarray) -> None:
        """What is known of the biases already."""
        for bias, k in self.first_of_biases():
            column = self.columns[k]
            matrix[column, column] += bias.information
            vector[column] += bias.information * (bias.value_px - self.cameras[k, 5])


def adjust_bundle(free: Sequence[KeyFrame], held: Sequence[KeyFrame], landmarks: Landmarks, config: BundleConfig) -> None:
    """Move the poses of `free` and the landmarks that they see; `held` key frames see some of these too, and stay.

    With nothing held, the first of `free` stays. Observations found to be wrong become inactive in all of these key frames.
    """
    if not held:
        free, held = free[1:], free[:1]
    if not free:
        return
    keyframes = [*free, *held]
    ids = _landmarks_of(free if len(free) > 1 else keyframes)
    problem, sources = _assemble(keyframes, len(free), ids, landmarks)
    if len(problem.frames) == 0:
        return
    _optimise(problem, config)
    for k, keyframe in enumerate(free):
        keyframe.cam_from_world = Rigid3(problem.rotations[k].copy(), problem.translations[k].copy())
    landmarks.positions[ids] = problem.points
    for bias, k in problem.first_of_biases():
        bias.value_px = float(problem.cameras[k, 5])
    wrong = problem.squares(problem.rotations, problem.translations, problem.points, problem.cameras) > config.outlier_square
    for k, keyframe in enumerate(keyframes):
        keyframe.observations.active[sources[wrong & (problem.frames == k)]] = False


def _landmarks_of(keyframes: Sequence[KeyFrame]) -> Int[np.ndarray, " n"]:
    return np.unique(np.concatenate([k.observations.landmark_ids[k.observations.active] for k in keyframes]))


def _assemble(
    keyframes: Sequence[KeyFrame], num_free: int, ids: Int[np.ndarray, " n"], landmarks: Landmarks
) -> tuple[_Problem, Int[np.ndarray, " m"]]:
    """The problem, and of each observation its row in its key frame."""
    frames, rows, sources = [], [], []
    for k, keyframe in enumerate(keyframes):
        seen = keyframe.observations
        place = np.searchsorted(ids, seen.landmark_ids)
        place[place == len(ids)] = 0
        chosen = np.flatnonzero(seen.active & (ids[place] == seen.landmark_ids)) if len(ids) else np.zeros(0, np.int64)
        frames.append(np.full(len(chosen), k))
        rows.append(place[chosen])
        sources.append(chosen)
    all_rows = np.concatenate(rows)
    order = np.argsort(all_rows, kind="stable")
    measured = np.concatenate([k.observations.measured[s] for k, s in zip(keyframes, sources, strict=True)])[order]
    weights = np.concatenate([k.observations.weights[s] for k, s in zip(keyframes, sources, strict=True)])[order]
    slots = np.arange(len(keyframes))
    slots[num_free:] = -1
    biases = list(dict.fromkeys(k.bias for k in keyframes if np.isfinite(k.bias.information)))
    problem = _Problem(
        rotations=np.array([k.cam_from_world.rotation for k in keyframes]),
        translations=np.array([k.cam_from_world.translation for k in keyframes]),
        cameras=np.array([_camera_row(k) for k in keyframes]),
        slots=slots,
        columns=np.array([6 * num_free + biases.index(k.bias) if k.bias in biases else -1 for k in keyframes]),
        biases=biases,
        points=landmarks.positions[ids],
        starts=np.searchsorted(all_rows[order], np.arange(len(ids) + 1)),
        frames=np.concatenate(frames)[order],
        rows=all_rows[order],
        measured=np.where(weights > 0.0, measured, 0.0),
        weights=weights,
    )
    return problem, np.concatenate(sources)[order]


def _camera_row(keyframe: KeyFrame) -> list[float]:
    camera = keyframe.stereo.camera
    return [camera.fx, camera.fy, camera.cx, camera.cy, keyframe.stereo.bf, keyframe.bias.value_px]


def _optimise(problem: _Problem, config: BundleConfig) -> None:
    p, num_free = problem, int(problem.slots.max() + 1)
    cost = p.cost(p.rotations, p.translations, p.points, p.cameras, config.cauchy_scale)
    damping = 1e-4
    num_points, size = len(p.points), 6 * num_free + len(p.biases)
    couplings, inverses = np.empty((len(p.frames), 6, 3)), np.empty((num_points, 3, 3))
    gradients, bias_couplings, moved = (np.empty((num_points, 3)) for _ in range(3))
    for _ in range(config.max_steps):
        matrix, vector = np.zeros((size, size)), np.zeros(size)
        eliminate_points(
            p.rotations, p.translations, p.cameras, p.slots, p.columns, p.points, p.starts, p.frames, p.measured, p.weights,
            config.cauchy_scale**2, damping, matrix, vector, couplings, inverses, gradients, bias_couplings,
        )  # fmt: skip
        p.add_priors(matrix, vector)
        matrix[np.diag_indices(size)] += damping * np.diag(matrix) + 1e-9
        steps = np.linalg.solve(matrix, vector)
        move_points(p.slots, p.columns, p.starts, p.frames, couplings, bias_couplings, inverses, gradients, steps, p.points, moved)
        rotations, translations, cameras = p.rotations.copy(), p.translations.copy(), p.cameras.copy()
        for k in range(num_free):
            new = Rigid3.exp(steps[6 * k : 6 * k + 6]) @ Rigid3(rotations[k], translations[k])
            rotations[k], translations[k] = new.rotation, new.translation
        cameras[p.columns >= 0, 5] += steps[p.columns[p.columns >= 0]]
        new_cost = p.cost(rotations, translations, moved, cameras, config.cauchy_scale)
        if not new_cost < cost:
            damping *= 10.0
            continue
        p.rotations, p.translations, p.points, p.cameras = rotations, translations, moved.copy(), cameras
        finished = cost - new_cost < config.min_decrease * cost
        cost, damping = new_cost, max(damping / 5.0, 1e-7)
        if finished:
            break
