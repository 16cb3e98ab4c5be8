"""Check whether the poses of a trajectory fit the images, and find a convention that makes them
fit.

Steps between images are measured from the images alone (`measured_steps.py`), without scale for a
single camera. A trajectory with the right convention has nearly the same steps. If it does not,
three kinds of alternatives are tested. The first are the conventions of
`geometry/pose_conventions.py`, the second a shifted clock. The third is a camera mounted on the
body that the poses describe. That is hand-eye calibration, body_step @ body_from_cam =
body_from_cam @ camera_step (Park and Martin, *Robot sensor calibration: solving AX = XB on the
Euclidean group*, 1994).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from topoloc.errors import TrajectoryError
from topoloc.geometry.alignment import nearest_rotation, normalized_pose_error, rotation_error
from topoloc.geometry.pose_conventions import (
    AXES,
    DIRECTIONS,
    ROTATIONS,
    UNITS,
    PoseConversion,
    describe_conventions,
    undo_pose_conventions,
)
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.trajectory import Trajectory
from topoloc.slam.measured_steps import MeasuredStep, measure_steps

_MIN_INFORMATIVE_STEPS = 5
_MIN_ACCEPTED_RATIO, _MIN_CONVENTION_RATIO = (
    0.5,
    0.7,
)  # share of informative steps that agree: accepted poses, and a reported convention
_MIN_ROTATION, _ROTATION_TOLERANCE, _TRANSLATION_TOLERANCE, _RELATIVE_TOLERANCE = (
    math.radians(5.0),
    math.radians(1.5),
    0.02,
    0.15,
)  # rad, rad, m, share of the step
_DEPTH_TOLERANCE = 0.01  # error of a measured translation, as a share of the depth
_MIN_TRANSLATION_RATIO = 3.0  # times the tolerance
_UNIT_TOLERANCE = 0.15
_DIRECTION_TOLERANCE = math.radians(12.0)  # of a translation without scale
_MAX_COORDINATE = 1e12  # larger than any place in any unit, and its square is finite
_MIN_SHIFT_S, _MAX_SHIFT_S, _NUM_SHIFTS, _MAX_GAP_S = (
    0.02,
    3.0,
    60,
    1.0,
)  # seconds, seconds, number of shifts in each direction, seconds
_SUSPICIOUS_ERROR, _MAX_ERROR_RATIO = 0.3, 0.4
_NUM_MOUNTING_ITERATIONS, _MIN_SINGULAR_RATIO = 5, 0.05
_BODY_COMPLEXITY = 4.0  # in conventions: a mounting has six parameters

_Poses = Sequence[Rigid3 | None]


@dataclass(frozen=True)
class PoseCheckResult:
    """Hold the result of the check.

    `num_informative` steps are long enough to compare. `num_consistent` of them agree with the
    poses as given. `conventions` make most of them agree, in the format of `--poses`. It is empty
    if the poses are accepted, or no known convention fits.
    """

    num_informative: int
    num_consistent: int
    conventions: tuple[str, ...] = ()

    @property
    def is_accepted(self) -> bool:
        """Return whether the poses are accepted. Too few informative steps also accept them."""
        return not self.conventions and (
            self.num_informative < _MIN_INFORMATIVE_STEPS
            or self.num_consistent >= _MIN_ACCEPTED_RATIO * self.num_informative
        )


@dataclass(frozen=True)
class _PoseInterpretation:
    """Hold one interpretation of the poses, with the errors of the steps in units of the
    tolerance."""

    conventions: tuple[str, ...]
    normalized_errors: Float[np.ndarray, " n"]

    @property
    def num_consistent(self) -> int:
        return int(np.count_nonzero(self.normalized_errors < 1.0))

    @property
    def sort_key(self) -> tuple[float, float]:
        """Return a key that prefers the simpler of two interpretations that fit about as well."""
        complexity = sum(
            _BODY_COMPLEXITY if name.startswith("body") else 1.0 for name in self.conventions
        )
        return self.num_consistent - 0.5 * complexity, -float(np.median(self.normalized_errors))


def check_pose_coverage(sequence: StereoSequence) -> None:
    """Check that at least half of the frames have a pose, if any has one.

    Raises:
        TrajectoryError: fewer have one.
    """
    num_posed = sum(pose is not None for pose in sequence.poses)
    if 0 < 2 * num_posed < len(sequence):
        raise TrajectoryError(
            f"{sequence.name}: only {num_posed} of {len(sequence)} frames have a pose; --allow-gaps"
            " maps these, without the others"
        )


def check_poses(sequence: StereoSequence) -> None:
    """Check that the poses of a recording fit its images. For a single camera the scale is not
    checked.

    Raises:
        TrajectoryError: they do not fit. The message contains the convention that makes them fit,
            in the format of `--poses`, if one does.
        RecordingError, CalibrationError, UnreadableImageError: the recording cannot be read.
    """
    posed = [k for k, pose in enumerate(sequence.poses) if pose is not None]
    if len(posed) < _MIN_INFORMATIVE_STEPS:
        return
    if sequence[posed[0]].camera is None:
        return
    verdict = evaluate_poses(
        measure_steps(sequence, posed),
        sequence.poses,
        sequence.t_ns,
    )
    if verdict.is_accepted:
        return
    differ = (
        f"{verdict.num_informative - verdict.num_consistent} of {verdict.num_informative} steps"
        " from picture to picture are not the poses'"
    )
    if verdict.conventions:
        names = ",".join(verdict.conventions)
        raise TrajectoryError(
            f"{sequence.name}: {differ}; they look like poses"
            f" {describe_conventions(verdict.conventions)}: --poses {names}"
        )
    raise TrajectoryError(
        f"{sequence.name}: {differ}, and no known convention explains it: of another recording, or"
        " wrongly calibrated? --poses unchecked maps it all the same"
    )


def evaluate_poses(
    steps: Sequence[MeasuredStep], poses: _Poses, t_ns: Sequence[int]
) -> PoseCheckResult:
    """Compare the poses (world_from_cam in metres, one for each frame) with the measured steps."""
    informative_steps = [step for step in steps if _is_informative(step)]
    informative_steps = [
        step
        for step in informative_steps
        if poses[step.first] is not None and poses[step.last] is not None
    ]
    if len(informative_steps) < _MIN_INFORMATIVE_STEPS:
        return PoseCheckResult(len(informative_steps), len(informative_steps))
    if any(pose is not None and np.abs(pose.translation).max() > _MAX_COORDINATE for pose in poses):
        return PoseCheckResult(len(informative_steps), 0)
    as_is = _PoseInterpretation(
        (), _compute_step_errors(informative_steps, _steps_from_poses(informative_steps, poses))
    )
    verdict = PoseCheckResult(len(informative_steps), as_is.num_consistent)
    if verdict.is_accepted and not _is_suspicious(as_is):
        return verdict
    readings = [
        *_test_conventions(informative_steps, poses),
        *_find_time_shift(informative_steps, poses, t_ns),
    ]
    if verdict.is_accepted:  # wrong poses may be nearly right on a straight and level trajectory
        better = [
            one
            for one in readings
            if _has_lower_error(one, as_is) and not any("scale" in name for name in one.conventions)
        ]
        return replace(
            verdict,
            conventions=(
                max(better, key=lambda reading: reading.sort_key).conventions if better else ()
            ),
        )
    best = max(
        [*readings, *_test_body_poses(informative_steps, poses)],
        key=lambda reading: reading.sort_key,
    )
    is_named = best.num_consistent >= max(
        _MIN_CONVENTION_RATIO * len(informative_steps), as_is.num_consistent + 1
    )
    return replace(verdict, conventions=best.conventions if is_named else ())


def _is_informative(step: MeasuredStep) -> bool:
    tolerance = _TRANSLATION_TOLERANCE + _DEPTH_TOLERANCE * step.median_depth
    return not step.has_scale or not step.first_from_last.is_same(
        Rigid3.identity(), _MIN_TRANSLATION_RATIO * tolerance, _MIN_ROTATION
    )


def _steps_from_poses(informative_steps: Sequence[MeasuredStep], poses: _Poses) -> list[Rigid3]:
    """Return first_from_last of the poses."""
    pairs = ((poses[step.first], poses[step.last]) for step in informative_steps)
    return [
        first.inverse() @ last for first, last in pairs if first is not None and last is not None
    ]


def _compute_step_errors(
    informative_steps: Sequence[MeasuredStep], steps: Sequence[Rigid3]
) -> Float[np.ndarray, " n"]:
    """Return the error of each step relative to the measured one, in units of the tolerance."""
    return np.array(
        [
            _compute_step_error(measured, step)
            for measured, step in zip(informative_steps, steps, strict=True)
        ]
    )


def _compute_step_error(measured: MeasuredStep, step: Rigid3) -> float:
    """Return the error of a step. For a single camera only the direction of the translation is
    compared."""
    pose, theirs = measured.first_from_last, step.translation
    radians = _ROTATION_TOLERANCE + _RELATIVE_TOLERANCE * pose.angle()
    if measured.has_scale:
        metres = (
            _TRANSLATION_TOLERANCE
            + _DEPTH_TOLERANCE * measured.median_depth
            + _RELATIVE_TOLERANCE * float(np.linalg.norm(pose.translation))
        )
        return normalized_pose_error(step, pose, metres, radians)
    length = float(np.linalg.norm(theirs))
    cosine = np.clip(pose.translation @ theirs / length, -1.0, 1.0) if length > 0.0 else -1.0
    return max(math.acos(cosine) / _DIRECTION_TOLERANCE, rotation_error(step, pose) / radians)


def _test_conventions(
    informative_steps: Sequence[MeasuredStep], poses: _Poses
) -> Iterator[_PoseInterpretation]:
    for conventions in _combine_conventions(ROTATIONS, DIRECTIONS, AXES):
        steps = _steps_from_poses(
            informative_steps, _apply_conventions(informative_steps, poses, conventions)
        )
        unit, factor = _estimate_unit(informative_steps, steps)
        steps = [Rigid3(step.rotation, factor * step.translation) for step in steps]
        yield _PoseInterpretation(
            (*conventions, *unit), _compute_step_errors(informative_steps, steps)
        )


def _combine_conventions(*tables: dict[str, PoseConversion]) -> list[tuple[str, ...]]:
    """Return all combinations of at most one convention from each table."""
    choices = [[(), *((name,) for name in table)] for table in tables]
    return [tuple(itertools.chain(*parts)) for parts in itertools.product(*choices)]


def _apply_conventions(
    informative_steps: Sequence[MeasuredStep], poses: _Poses, conventions: tuple[str, ...]
) -> list[Rigid3 | None]:
    """Return the poses that the steps need, with these conventions undone."""
    needed = {step.first for step in informative_steps} | {step.last for step in informative_steps}
    return [
        undo_pose_conventions(pose, conventions) if pose is not None and k in needed else None
        for k, pose in enumerate(poses)
    ]


def _estimate_unit(
    informative_steps: Sequence[MeasuredStep], steps: Sequence[Rigid3]
) -> tuple[tuple[str, ...], float]:
    """Estimate the unit that gives the steps their measured lengths.

    Return it as a convention, with its length in metres.
    """
    if not all(step.has_scale for step in informative_steps):
        return (), 1.0
    measured = np.array(
        [np.linalg.norm(step.first_from_last.translation) for step in informative_steps]
    )
    lengths = np.array([np.linalg.norm(step.translation) for step in steps])
    long = lengths > 1e-9
    if not long.any() or not measured[long].any():
        return (), 1.0
    factor = float(np.sum(measured[long]) / np.sum(lengths[long]))
    for name, metres in {"": 1.0, **UNITS}.items():
        if abs(math.log(factor / metres)) < _UNIT_TOLERANCE:
            return (name,) if name else (), metres
    return (f"scale={factor:.4g}",), factor


def _find_time_shift(
    informative_steps: Sequence[MeasuredStep], poses: _Poses, t_ns: Sequence[int]
) -> list[_PoseInterpretation]:
    """Find the time shift between poses and images with the smallest error.

    The list is empty if the recording is too short.
    """
    posed = [k for k, pose in enumerate(poses) if pose is not None]
    trajectory = Trajectory.of_frames(poses, t_ns)
    largest = min(_MAX_SHIFT_S, 0.4e-9 * (t_ns[posed[-1]] - t_ns[posed[0]]))
    shifts = np.linspace(-largest, largest, 2 * _NUM_SHIFTS + 1)
    readings = (
        _test_time_shift(informative_steps, trajectory, t_ns, float(seconds))
        for seconds in shifts
        if abs(seconds) > _MIN_SHIFT_S
    )
    return sorted(
        (one for one in readings if one is not None),
        key=lambda one: float(np.median(one.normalized_errors)),
    )[:1]


def _test_time_shift(
    informative_steps: Sequence[MeasuredStep],
    trajectory: Trajectory,
    t_ns: Sequence[int],
    seconds: float,
) -> _PoseInterpretation | None:
    """Test one time shift. None if too few steps have poses at the shifted times."""
    normalized_errors = []
    for step in informative_steps:
        times = [t_ns[k] + round(1e9 * seconds) for k in (step.first, step.last)]
        first, last = trajectory.interpolate(times, _MAX_GAP_S)
        if first is not None and last is not None:
            normalized_errors.append(
                float(_compute_step_errors([step], [first.inverse() @ last])[0])
            )
    if len(normalized_errors) < max(_MIN_INFORMATIVE_STEPS, len(informative_steps) // 2):
        return None
    normalized_errors += [float(np.median(normalized_errors))] * (
        len(informative_steps) - len(normalized_errors)
    )  # steps beyond an end get the median error
    return _PoseInterpretation((f"shift={seconds:.3g}",), np.array(normalized_errors))


def _has_lower_error(other: _PoseInterpretation, as_is: _PoseInterpretation) -> bool:
    """Return whether another interpretation explains most of the error."""
    return _is_suspicious(as_is) and float(
        np.median(other.normalized_errors)
    ) < _MAX_ERROR_RATIO * float(np.median(as_is.normalized_errors))


def _is_suspicious(as_is: _PoseInterpretation) -> bool:
    """Return whether the error is large enough for another interpretation to be much better."""
    return float(np.median(as_is.normalized_errors)) > _SUSPICIOUS_ERROR


def _test_body_poses(
    informative_steps: Sequence[MeasuredStep], poses: _Poses
) -> Iterator[_PoseInterpretation]:
    """Test the poses as those of a body with the best-fitting camera mounting.

    Nothing is tested if the steps have no scale.
    """
    if not all(step.has_scale for step in informative_steps):
        return
    for conventions in _combine_conventions(ROTATIONS, DIRECTIONS):
        steps = _steps_from_poses(
            informative_steps, _apply_conventions(informative_steps, poses, conventions)
        )
        pairs = kept = list(zip(informative_steps, steps, strict=True))
        mounting, normalized_errors = Rigid3.identity(), np.zeros(len(pairs))
        for _ in range(
            _NUM_MOUNTING_ITERATIONS
        ):  # repeated without outliers, which may be measured wrongly
            mounting = _estimate_mounting(kept)
            normalized_errors = _compute_step_errors(
                informative_steps, [mounting.inverse() @ step @ mounting for step in steps]
            )
            kept = [
                pair
                for pair, miss in zip(pairs, normalized_errors, strict=True)
                if miss <= 1.5 * np.median(normalized_errors)
            ]
        w, x, y, z = mounting.quat_wxyz()
        numbers = ",".join(f"{number:.4g}" for number in (*mounting.translation, x, y, z, w))
        yield _PoseInterpretation((*conventions, f"body={numbers}"), normalized_errors)


def _estimate_mounting(pairs: Sequence[tuple[MeasuredStep, Rigid3]]) -> Rigid3:
    """Estimate body_from_cam by least squares, alternating between rotation and translation.

    The rotation comes from the axes and translations of the steps, the translation from the
    residual translations. The translation along an axis common to all rotations is not observable
    and stays 0.
    """
    rotation, translation = np.eye(3), np.zeros(3)
    of_axes = sum(
        (np.outer(step.log()[3:], measured.first_from_last.log()[3:]) for measured, step in pairs),
        np.zeros((3, 3)),
    )
    for _ in range(_NUM_MOUNTING_ITERATIONS):
        correlation = of_axes / _ROTATION_TOLERANCE**2
        for measured, step in pairs:
            way = step.translation - (translation - step.rotation @ translation)
            correlation = (
                correlation
                + np.outer(way, measured.first_from_last.translation)
                / (_TRANSLATION_TOLERANCE + _DEPTH_TOLERANCE * measured.median_depth) ** 2
            )
        rotation = nearest_rotation(correlation)
        lefts = np.concatenate([step.rotation - np.eye(3) for _, step in pairs])
        rights = np.concatenate(
            [
                rotation @ measured.first_from_last.translation - step.translation
                for measured, step in pairs
            ]
        )
        translation = np.linalg.lstsq(lefts, rights, rcond=_MIN_SINGULAR_RATIO)[0]
    return Rigid3(rotation, translation)
