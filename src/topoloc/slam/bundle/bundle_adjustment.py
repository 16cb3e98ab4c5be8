"""Bundle adjustment: optimise key frames and landmarks for minimal pixel and disparity errors.

It uses Levenberg-Marquardt with eliminated points (Triggs et al., *Bundle adjustment: a modern
synthesis*, 2000, section 6) and Cauchy's loss. The reduced system of the poses is sparse
(`block_system.py`). Observations are processed in chunks of landmarks, which bounds the memory. The
odometry window and a trajectory of kilometres are the same problem, whose time grows with its
length.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int, Int32

from topoloc.geometry.rigid import Rigid3
from topoloc.slam.bundle.block_kernels import count_covisible_pairs, find_covisible_pairs
from topoloc.slam.bundle.block_system import BlockPattern, solve_blocks
from topoloc.slam.bundle.bundle_kernels import eliminate_points, robust_cost, squared_residuals
from topoloc.slam.keyframes import DisparityBias, KeyFrame, Landmarks


@dataclass(frozen=True, eq=False)
class ObservationChunk:
    """Hold the observations of the landmarks `first` to `last` of a bundle, sorted by landmark.

    Those of landmark n are `starts[n - first]` to `starts[n - first + 1] - 1`. `keyframe_idx` is
    the key frame of each one, and `sources` the row in that key frame's observations.
    """

    first: int
    last: int
    starts: Int[np.ndarray, " n1"]
    keyframe_idx: Int32[np.ndarray, " m"]
    sources: Int32[np.ndarray, " m"]
    measured: Float[np.ndarray, "m 3"]
    weights: Float[np.ndarray, "m 3"]

    @property
    def rows(self) -> Int[np.ndarray, " m"]:
        """Return the landmark of each observation, counted from `first`."""
        return np.repeat(np.arange(self.last - self.first), np.diff(self.starts))


class ObservationChunks:
    """Provide the active observations of landmarks by key frames, chunk by chunk.

    It can be iterated repeatedly. Several chunks are built anew each time, a single one is cached.

    Args:
        ids: the landmarks, ascending.
        max_observations: approximate size of a chunk.
    """

    def __init__(
        self, keyframes: Sequence[KeyFrame], ids: Int[np.ndarray, " n"], max_observations: int
    ) -> None:
        self._keyframes, self._ids = keyframes, ids
        self._observation_orders = [_sort_observations(keyframe, ids) for keyframe in keyframes]
        num_parts = -(-self.num_observations // max_observations)
        self._chunk_bounds = np.linspace(0, len(ids), num_parts + 1).astype(np.int64)
        ends = ids[self._chunk_bounds[1:] - 1] + 1 if num_parts else ids[:0]
        seen = [
            k.observations.landmark_ids[order]
            for k, order in zip(keyframes, self._observation_orders, strict=True)
        ]
        self._observation_offsets: Int[np.ndarray, "k p1"] = np.array(
            [np.searchsorted(one, np.r_[0, ends]) for one in seen]
        )

    @property
    def num_observations(self) -> int:
        """Return the number of observations in all chunks."""
        return sum(map(len, self._observation_orders))

    def __iter__(self) -> Iterator[ObservationChunk]:
        num = len(self._chunk_bounds) - 1
        yield from [self._single_chunk] if num == 1 else map(self._make_chunk, range(num))

    @cached_property
    def _single_chunk(self) -> ObservationChunk:
        return self._make_chunk(0)

    def _make_chunk(self, number: int) -> ObservationChunk:
        first, last = self._chunk_bounds[number : number + 2].tolist()
        begins, ends = self._observation_offsets[:, number : number + 2].T
        seeing = np.flatnonzero(ends > begins).tolist()
        sources = [self._observation_orders[k][begins[k] : ends[k]] for k in seeing]
        seen = [
            (one.landmark_ids[rows], one.measured[rows], one.weights[rows])
            for one, rows in zip(
                (self._keyframes[k].observations for k in seeing), sources, strict=True
            )
        ]
        ids, measured, weights = map(np.concatenate, zip(*seen, strict=True))
        rows = np.searchsorted(self._ids[first:last], ids)
        order = np.argsort(rows, kind="stable")
        measured, weights = measured[order], weights[order]
        keyframe_idx = np.repeat(np.array(seeing, np.int32), [len(rows) for rows in sources])
        return ObservationChunk(
            first,
            last,
            starts=np.searchsorted(rows[order], np.arange(last - first + 1)),
            keyframe_idx=keyframe_idx[order],
            sources=np.concatenate(sources)[order],
            measured=np.where(weights > 0.0, measured, 0.0).astype(np.float64),
            weights=weights.astype(np.float64),
        )


def _sort_observations(keyframe: KeyFrame, ids: Int[np.ndarray, " n"]) -> Int32[np.ndarray, " m"]:
    """Return the rows of a key frame's active observations of these landmarks, by landmark."""
    seen = keyframe.observations
    if not len(ids):
        return np.zeros(0, np.int32)
    place = np.searchsorted(ids, seen.landmark_ids)
    place[place == len(ids)] = 0
    rows = np.flatnonzero(seen.active & (ids[place] == seen.landmark_ids))
    return rows[np.argsort(seen.landmark_ids[rows], kind="stable")].astype(np.int32)


@dataclass(frozen=True, eq=False)
class PosePrior:
    """Hold a prior on a key frame's pose.

    `information` (6, 6) is that of its left perturbation (metres, radians).
    """

    keyframe: KeyFrame
    cam_from_world: Rigid3
    information: Float[np.ndarray, "6 6"]


@dataclass(frozen=True, eq=False)
class _State:
    """Hold the optimised values. A camera is (fx, fy, cx, cy, bf, disparity bias)."""

    rotations: Float[np.ndarray, "k 3 3"]
    translations: Float[np.ndarray, "k 3"]
    cameras: Float[np.ndarray, "k 6"]
    points: Float[np.ndarray, "n 3"]

    def squares(self, chunk: ObservationChunk) -> Float[np.ndarray, " m"]:
        """Return the squared residuals of a chunk's observations."""
        squares = np.empty(len(chunk.keyframe_idx))
        points = self.points[chunk.first : chunk.last]
        squared_residuals(
            self.rotations, self.translations, self.cameras, points, chunk.keyframe_idx, chunk.rows, chunk.measured, chunk.weights, squares  # noqa: E501
        )  # fmt: skip
        return squares


@dataclass(frozen=True, eq=False)
class _Problem:
    """Hold the constant data of the optimisation.

    `slots` is the position of each key frame's pose in elimination order, -1 if it is fixed.
    `columns` is the index of its disparity bias, -1 if that is fixed.
    """

    chunks: ObservationChunks
    pattern: BlockPattern
    slots: Int[np.ndarray, " k"]
    columns: Int[np.ndarray, " k"]
    biases: list[DisparityBias]
    pose_priors: list[tuple[int, PosePrior]]

    def prior_cost(self, state: _State, scale_squared: float) -> float:
        """Return the cost of biases and poses that differ from their priors."""
        of_biases = sum(
            bias.information * (state.cameras[k, 5] - bias.value_px) ** 2
            for bias, k in self.find_bias_keyframes()
        )
        squares = [square for *_, square in self.compute_prior_residuals(state)]
        return float(of_biases + sum(scale_squared * np.log1p(k / scale_squared) for k in squares))

    def compute_prior_residuals(
        self, state: _State
    ) -> Iterator[tuple[int, PosePrior, Float[np.ndarray, "6"], float]]:
        """Generate the key frame, prior, pose error and squared error (in sigma) of each pose
        prior."""
        for k, pose_prior in self.pose_priors:
            pose = Rigid3(state.rotations[k], state.translations[k])
            off = (pose @ pose_prior.cam_from_world.inverse()).log()
            yield k, pose_prior, off, float(off @ pose_prior.information @ off)

    def find_bias_keyframes(self) -> list[tuple[DisparityBias, int]]:
        return [(bias, int(np.argmax(self.columns == i))) for i, bias in enumerate(self.biases)]


def adjust_bundle(
    free: Sequence[KeyFrame],
    fixed: Sequence[KeyFrame],
    landmarks: Landmarks,
    pose_priors: Sequence[PosePrior] = (),
    *,
    max_steps: int = 6,
    min_decrease: float = 1e-3,
    cauchy_scale: float = 2.0,
    chunk_size: int = 100_000,
) -> None:
    """Optimise the poses of `free` and the landmarks that they see.

    `fixed` key frames see some of these landmarks too and do not move. Without fixed key frames and
    pose priors, the first of `free` is fixed. Outlier observations become inactive in all of these
    key frames. Residuals are in standard deviations of the measurements.

    Args:
        max_steps: maximum number of Levenberg-Marquardt steps.
        min_decrease: the optimisation ends when a step lowers the cost by less than this share.
        cauchy_scale: scale of Cauchy's loss. Larger residuals have less and less weight.
        chunk_size: approximate number of observations that are processed at once.
    """
    outlier_square = 25.0  # squared residual above which an observation is deactivated
    if not fixed and not pose_priors:
        free, fixed = free[1:], free[:1]
    if not free:
        return
    keyframes = [*free, *fixed]
    ids = _collect_landmark_ids(free if len(free) > 1 else keyframes)
    chunks = ObservationChunks(keyframes, ids, chunk_size)
    if chunks.num_observations == 0:
        return
    number_of = {id(keyframe): k for k, keyframe in enumerate(keyframes)}
    priors = [(number_of[id(pose_prior.keyframe)], pose_prior) for pose_prior in pose_priors]
    problem = _build_problem(chunks, keyframes, len(free), priors)
    own = [(k.stereo.camera, k.stereo.bf, k.bias.value_px) for k in keyframes]
    state = _State(
        rotations=np.array([k.cam_from_world.rotation for k in keyframes]),
        translations=np.array([k.cam_from_world.translation for k in keyframes]),
        cameras=np.array([(c.fx, c.fy, c.cx, c.cy, bf, bias) for c, bf, bias in own]),
        points=landmarks.positions[ids],
    )
    state = _optimize(problem, state, max_steps, min_decrease, cauchy_scale)
    for k, keyframe in enumerate(free):
        keyframe.cam_from_world = Rigid3(state.rotations[k].copy(), state.translations[k].copy())
    landmarks.positions[ids] = state.points
    for bias, k in problem.find_bias_keyframes():
        bias.value_px = float(state.cameras[k, 5])
    for chunk in chunks:
        wrong = np.flatnonzero(state.squares(chunk) > outlier_square)
        for k, row in zip(chunk.keyframe_idx[wrong], chunk.sources[wrong], strict=True):
            keyframes[k].observations.active[row] = False


def adjust_window(
    keyframes: list[KeyFrame], landmarks: Landmarks, num_free: int, num_fixed: int, max_steps: int
) -> None:
    """Adjust the last `num_free` key frames, with up to `num_fixed` fixed ones before them.

    Earlier key frames are removed from the list.
    """
    del keyframes[: -(num_free + num_fixed)]
    free, fixed = keyframes[-num_free:], keyframes[:-num_free]
    adjust_bundle(free, fixed, landmarks, max_steps=max_steps)


def _collect_landmark_ids(keyframes: Sequence[KeyFrame]) -> Int[np.ndarray, " n"]:
    """Return the ids of the active landmarks, ascending.

    It never concatenates all observations of a long trajectory.
    """
    of_each = [ids for k in keyframes if len(ids := k.observations.active_ids)]
    first = min((int(ids.min()) for ids in of_each), default=0)
    last = max((int(ids.max()) for ids in of_each), default=-1)
    is_seen = np.zeros(last + 1 - first, np.bool_)
    for ids in of_each:
        is_seen[ids - first] = True
    return np.flatnonzero(is_seen) + first


def _build_problem(
    chunks: ObservationChunks,
    keyframes: Sequence[KeyFrame],
    num_free: int,
    pose_priors: list[tuple[int, PosePrior]],
) -> _Problem:
    slots = np.arange(len(keyframes))
    slots[num_free:] = -1
    ties = np.zeros(0, np.int64)
    for chunk in chunks:
        keys = np.empty(count_covisible_pairs(chunk.starts, chunk.keyframe_idx, slots), np.int64)
        find_covisible_pairs(chunk.starts, chunk.keyframe_idx, slots, num_free, keys)
        ties = np.union1d(ties, keys)
    pattern = BlockPattern.from_pairs(
        num_free, zip((ties // num_free).tolist(), (ties % num_free).tolist(), strict=True)
    )
    slots[:num_free] = pattern.elimination_idx
    biases = list(dict.fromkeys(k.bias for k in keyframes if np.isfinite(k.bias.information)))
    columns = np.array([biases.index(k.bias) if k.bias in biases else -1 for k in keyframes])
    return _Problem(chunks, pattern, slots, columns, biases, pose_priors)


def _optimize(
    problem: _Problem, state: _State, max_steps: int, min_decrease: float, cauchy_scale: float
) -> _State:
    scale = cauchy_scale**2
    cost = problem.prior_cost(state, scale) + sum(
        float(robust_cost(state.squares(chunk), scale)) for chunk in problem.chunks
    )
    damping = 1e-4
    for _ in range(max_steps):
        steps, bias_steps = _solve_steps(problem, state, scale, damping)
        moved, new_cost = _apply_steps(problem, state, steps, bias_steps, scale, damping)
        if not new_cost < cost:
            damping *= 10.0
            continue
        state, finished = moved, cost - new_cost < min_decrease * cost
        cost, damping = new_cost, max(damping / 5.0, 1e-7)
        if finished:
            break
    return state


def _solve_steps(
    problem: _Problem, state: _State, scale: float, damping: float
) -> tuple[Float[np.ndarray, "f 6"], Float[np.ndarray, " c"]]:
    """Build and solve the reduced system.

    Return the steps of the free poses, in elimination order, and of the biases.
    """
    p, pattern = problem, problem.pattern
    blocks, vector = pattern.empty(), np.zeros((len(pattern.elimination_idx), 6))
    border, corner = np.zeros((len(p.biases), *vector.shape)), np.zeros((len(p.biases), 2))
    unused = np.empty(0), np.empty((0, 3))
    for chunk in p.chunks:
        eliminate_points(
            state.rotations, state.translations, state.cameras, p.slots, p.columns, state.points[chunk.first : chunk.last],  # noqa: E501
            chunk.starts, chunk.keyframe_idx, chunk.measured, chunk.weights, scale, damping,
            pattern.starts, pattern.rows, blocks, vector, border, corner, *unused,
        )  # fmt: skip
    for k, pose_prior, off, square in p.compute_prior_residuals(state):
        pull = pose_prior.information / (1.0 + square / scale)
        blocks[pattern.diagonal[p.slots[k]]] += pull
        vector[p.slots[k]] -= pull @ off
    for row, (bias, k) in enumerate(p.find_bias_keyframes()):  # priors on the biases
        corner[row] += [bias.information, bias.information * (bias.value_px - state.cameras[k, 5])]
    along = np.arange(6)
    blocks[pattern.diagonal[:, None], along, along] *= 1.0 + damping
    blocks[pattern.diagonal[:, None], along, along] += 1e-9
    own = np.diag((1.0 + damping) * corner[:, 0] + 1e-9)
    solved = solve_blocks(pattern, blocks, np.concatenate([vector[None], border]))
    flat, of_border = (k.reshape(len(border), vector.size) for k in (border, solved[1:]))
    bias_steps = np.linalg.solve(own - flat @ of_border.T, corner[:, 1] - flat @ solved[0].ravel())
    return solved[0] - np.tensordot(bias_steps, solved[1:], 1), bias_steps


def _apply_steps(
    problem: _Problem,
    state: _State,
    of_poses: Float[np.ndarray, "f 6"],
    of_biases: Float[np.ndarray, " c"],
    scale: float,
    damping: float,
) -> tuple[_State, float]:
    """Return the state after these steps, and its cost."""
    p, points = problem, np.empty_like(state.points)
    rotations, translations = state.rotations.copy(), state.translations.copy()
    cameras = state.cameras.copy()
    for k in np.flatnonzero(p.slots >= 0).tolist():
        new = Rigid3.exp(of_poses[p.slots[k]]) @ Rigid3(rotations[k], translations[k])
        rotations[k], translations[k] = new.rotation, new.translation
    cameras[p.columns >= 0, 5] += of_biases[p.columns[p.columns >= 0]]
    moved = _State(rotations, translations, cameras, points)
    cost = p.prior_cost(moved, scale)
    unused = np.empty((0, 6, 6)), of_poses, np.empty((0, *of_poses.shape)), np.empty((0, 2))
    for chunk in p.chunks:
        rows = slice(chunk.first, chunk.last)
        eliminate_points(
            state.rotations, state.translations, state.cameras, p.slots, p.columns, state.points[rows],  # noqa: E501
            chunk.starts, chunk.keyframe_idx, chunk.measured, chunk.weights, scale, damping,
            p.pattern.starts, p.pattern.rows, *unused, of_biases, points[rows],
        )  # fmt: skip
        cost += float(robust_cost(moved.squares(chunk), scale))
    return moved, cost
