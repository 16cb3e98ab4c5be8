"""Check that recordings whose poses should share one world do share it.

Steps between images of two recordings are measured (`measured_steps.py`). If the poses agree with a
few of them, the worlds are the same. If most agree on one transform between the worlds instead, the
worlds differ. Steps that agree on neither, as along equal panels, accuse nobody.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from topoloc.errors import TrajectoryError
from topoloc.features.parallel import parallel_map
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.transform_consensus import select_hypothesis
from topoloc.recordings.frame import StereoSequence
from topoloc.slam.measured_steps import MeasuredStep, ViewFeatures, estimate_step, extract_view


def check_common_world(sequences: Sequence[StereoSequence]) -> list[str]:
    """Check that the poses of recordings are in one world, as far as their images show it. Return
    one line for each recording of which no image could be compared with an earlier recording.

    Raises:
        TrajectoryError: the poses of a recording are in another world. Names the transform.
        RecordingError, CalibrationError, UnreadableImageError: a recording cannot be read.
    """
    earlier, notes = list[_Views](), list[str]()
    for sequence in sequences:
        views = _Views.of(sequence)
        results = (_compare_worlds(one, views) for one in earlier)
        if earlier and views.frames and not any(results):
            notes.append(
                f"{sequence.name}: no picture shows a place of {earlier[0].sequence.name} for"
                " sure; that their poses are of one world is not checked"
            )
        earlier.append(views)
    return notes


@dataclass(frozen=True, eq=False)
class _Views:
    """Hold sampled frames of a recording (rows, with a pose), and the features of those read."""

    sequence: StereoSequence
    frames: list[int]
    poses: dict[int, Rigid3]
    cache: dict[int, ViewFeatures] = field(default_factory=dict)

    @staticmethod
    def of(sequence: StereoSequence, num_frames: int = 16) -> _Views:
        poses = {k: pose for k, pose in enumerate(sequence.poses) if pose is not None}
        posed = list(poses) if sequence[0].camera is not None else []
        rows = np.unique(np.linspace(0, len(posed) - 1, min(num_frames, len(posed))).astype(int))
        return _Views(sequence, [posed[row] for row in rows], poses)

    def read(self, frames: set[int]) -> None:
        new = sorted(frames - self.cache.keys())
        views = parallel_map(extract_view, (self.sequence[k] for k in new))
        self.cache.update(zip(new, views, strict=True))

    def nearest(self, pose: Rigid3, max_angle: float = 0.5) -> tuple[float, int]:
        """Return distance (metres, infinite if all look elsewhere) and row of the nearest pose."""
        frames = list(self.poses)
        apart = [pose.inverse() @ self.poses[k] for k in frames]
        costs = [
            float(np.linalg.norm(one.translation)) if one.angle() < max_angle else np.inf
            for one in apart
        ]
        row = int(np.argmin(costs))
        return costs[row], frames[row]


def _compare_worlds(one: _Views, other: _Views) -> bool:
    """Return whether images show that both are in one world. Raises TrajectoryError."""
    near = sorted((one.nearest(other.poses[k]), k) for k in other.frames)[:8]
    pairs = [(a, b) for (metres, a), b in near if metres < np.inf]
    if _is_confirmed(one, other, _measure(one, other, pairs)):
        return True
    pairs = [(a, b) for a in one.frames for b in other.frames]
    steps = _measure(one, other, pairs)
    if _is_confirmed(one, other, steps):
        return True
    _check_transform(one, other, [step for step in steps if step.has_scale])
    return False


def _measure(one: _Views, other: _Views, pairs: list[tuple[int, int]]) -> list[MeasuredStep]:
    """Return the steps of the pairs of images that match, at most one for each image of `other`."""
    one.read({a for a, _ in pairs})
    other.read({b for _, b in pairs})
    found: dict[int, MeasuredStep] = {}
    measured = parallel_map(
        lambda pair: estimate_step(*pair, one.cache[pair[0]], other.cache[pair[1]]), pairs
    )
    for step in measured:
        if step is not None and (
            step.last not in found or step.num_inliers > found[step.last].num_inliers
        ):
            found[step.last] = step
    return list(found.values())


def _errors(
    one: _Views, other: _Views, steps: Sequence[MeasuredStep], one_from_other: Rigid3
) -> np.ndarray:
    """Return the errors of the poses against the steps, if `one_from_other` relates the worlds."""
    ends = [(one.poses[step.first], one_from_other @ other.poses[step.last]) for step in steps]
    return np.array(
        [step.normalized_error(a.inverse() @ b) for step, (a, b) in zip(steps, ends, strict=True)]
    )


def _is_confirmed(one: _Views, other: _Views, steps: Sequence[MeasuredStep]) -> bool:
    # Error in units of the tolerance: poses of two recordings agree less than those of one.
    min_pairs, max_error = 3, 2.0
    errors = _errors(one, other, steps, Rigid3.identity())
    return int(np.count_nonzero(errors < max_error)) >= min_pairs


def _check_transform(one: _Views, other: _Views, steps: list[MeasuredStep]) -> None:
    """Raise TrajectoryError if most steps agree on a transform far from the identity."""
    # Number and share of the steps that agree, and error of the poses as they are.
    min_pairs, min_ratio, min_error = 3, 0.6, 4.0
    if len(steps) < min_pairs:
        return
    candidates = [
        one.poses[step.first] @ step.first_from_last @ other.poses[step.last].inverse()
        for step in steps
    ]
    agree = np.array([_errors(one, other, steps, each) < 1.0 for each in candidates])
    best, _ = select_hypothesis(agree)
    kept = [step for step, is_kept in zip(steps, agree[best], strict=True) if is_kept]
    as_is = _errors(one, other, kept, Rigid3.identity())
    if len(kept) < max(min_pairs, min_ratio * len(steps)) or np.median(as_is) < min_error:
        return
    first, second, found = one.sequence.name, other.sequence.name, candidates[best]
    w, x, y, z = found.quat_wxyz()
    numbers = ",".join(f"{number:.4g}" for number in (*found.translation, x, y, z, w))
    raise TrajectoryError(
        f"{second}: its poses are not in the world of {first}: {len(kept)} of {len(steps)} pictures"
        f" that show a place of {first} agree on {first}_from_{second} = {numbers} (X,Y,Z,QX,QY,QZ,"
        f"QW); map {first} alone, then add {second} by topoloc update, which finds this by itself"
    )
