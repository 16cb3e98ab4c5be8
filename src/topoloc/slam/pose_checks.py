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
from pathlib import PurePath

import numpy as np
from jaxtyping import Float

from topoloc.errors import TrajectoryError
from topoloc.geometry.alignment import nearest_rotation
from topoloc.geometry.pose_conventions import (
    AXES,
    DIRECTIONS,
    ROTATIONS,
    UNITS,
    PoseConventions,
    PoseConversion,
    describe_conventions,
)
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import SequenceView, StereoSequence
from topoloc.recordings.trajectory import Trajectory
from topoloc.slam.calibration_checks import check_calibration
from topoloc.slam.input_checks import add_calibration
from topoloc.slam.measured_steps import (
    ROTATION_TOLERANCE,
    MeasuredStep,
    is_sum_of_short_steps,
    measure_steps,
)

_MIN_INFORMATIVE_STEPS = 5
# Share of informative steps that agree: accepted poses, and a reported convention.
_MIN_ACCEPTED_RATIO, _MIN_CONVENTION_RATIO = 0.5, 0.7
_UNIT_TOLERANCE = 0.15
_MAX_COORDINATE = 1e12  # larger than any place in any unit, and its square is finite
_MIN_SHIFT_S, _MAX_SHIFT_S, _MAX_GAP_S = 0.02, 3.0, 1.0
_NUM_SHIFTS = 60  # in each direction
_SUSPICIOUS_ERROR, _MAX_ERROR_RATIO = 0.3, 0.4
_NUM_MOUNTING_ITERATIONS, _MIN_SINGULAR_RATIO = 5, 0.05
_BODY_COMPLEXITY = 4.0  # in conventions: a mounting has six parameters

_Ends = Sequence[tuple[Rigid3, Rigid3]]  # the poses at the two ends of each step


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
    def median_error(self) -> float:
        return float(np.median(self.normalized_errors))

    @property
    def sort_key(self) -> tuple[float, float]:
        """Return a key that prefers the simpler of two interpretations that fit about as well."""
        complexity = sum(
            _BODY_COMPLEXITY if name.startswith("body") else 1.0 for name in self.conventions
        )
        return self.num_consistent - 0.5 * complexity, -self.median_error


def check_poses(sequence: StereoSequence) -> None:
    """Check that the poses and the calibration of a recording fit its images. For a single camera
    the scale and the calibration are not checked.

    Raises:
        TrajectoryError: they do not fit. The message contains the convention that makes them fit,
            in the format of `--poses`, if one does, or the value of the calibration.
        RecordingError, CalibrationError, UnreadableImageError: the recording cannot be read.
    """
    posed = [k for k, pose in enumerate(sequence.poses) if pose is not None]
    if len(posed) < _MIN_INFORMATIVE_STEPS or sequence[posed[0]].camera is None:
        return
    steps = measure_steps(sequence, posed)
    verdict = evaluate_poses(steps, sequence.poses, sequence.t_ns)
    if not verdict.is_accepted:
        steps = [one for one in steps if _is_of_pictures(sequence, one, posed)]
        verdict = evaluate_poses(steps, sequence.poses, sequence.t_ns)
    _check_order(sequence, steps, verdict)
    check_calibration(sequence, steps, verdict.is_accepted)
    if verdict.is_accepted:
        return
    differ = (
        f"{verdict.num_informative - verdict.num_consistent} of {verdict.num_informative} steps"
        " from picture to picture are not the poses'"
    )
    if not verdict.conventions:
        raise TrajectoryError(
            f"{sequence.name}: {differ}, and no known convention explains it: of another recording,"
            " or wrongly calibrated? --poses unchecked maps it all the same"
        )
    described = describe_conventions(verdict.conventions)
    looks = f"they look like poses {described}: --poses {','.join(verdict.conventions)}"
    explained = add_calibration(looks, sequence, verdict.conventions)
    raise TrajectoryError(f"{sequence.name}: {differ}; {explained}")


def _is_of_pictures(sequence: StereoSequence, step: MeasuredStep, posed: list[int]) -> bool:
    """Return whether a step may accuse the poses: those that repeated panels may feign do not."""
    first, last = sequence.poses[step.first], sequence.poses[step.last]
    if first is None or last is None or step.normalized_error(first.inverse() @ last) < 1.0:
        return True
    return is_sum_of_short_steps(sequence, step, posed)


def evaluate_poses(
    steps: Sequence[MeasuredStep], poses: Sequence[Rigid3 | None], t_ns: Sequence[int]
) -> PoseCheckResult:
    """Compare the poses (world_from_cam in metres, one for each frame) with the measured steps."""
    measured, ends = _informative_steps(steps, poses)
    num = len(measured)
    if num < _MIN_INFORMATIVE_STEPS:
        return PoseCheckResult(num, num)
    if any(pose is not None and np.abs(pose.translation).max() > _MAX_COORDINATE for pose in poses):
        return PoseCheckResult(num, 0)
    as_is = _interpret((), measured, _compute_steps(ends))
    verdict = PoseCheckResult(num, as_is.num_consistent)
    if verdict.is_accepted and as_is.median_error <= _SUSPICIOUS_ERROR:
        return verdict
    readings = [*_test_conventions(measured, ends), *_find_time_shift(measured, poses, t_ns)]
    if verdict.is_accepted:  # wrong poses may be nearly right on a straight and level trajectory
        max_error = _MAX_ERROR_RATIO * as_is.median_error
        readings = [
            one
            for one in readings
            if one.median_error < max_error and not any("scale" in name for name in one.conventions)
        ]
    else:
        readings += _test_body_poses(measured, ends)
        min_consistent = max(_MIN_CONVENTION_RATIO * num, as_is.num_consistent + 1)
        readings = [max(readings, key=lambda one: one.sort_key)]
        readings = [one for one in readings if one.num_consistent >= min_consistent]
    best = max(readings, key=lambda one: one.sort_key, default=as_is)
    return replace(verdict, conventions=best.conventions)


def _check_order(
    sequence: StereoSequence, steps: Sequence[MeasuredStep], verdict: PoseCheckResult
) -> None:
    """Raise TrajectoryError if the poses fit better where their rows are in the order of the names
    as text (10 before 2). Frames are in the order of the numbers in their names."""
    base, rows = sequence, list(range(len(sequence)))
    while isinstance(base, SequenceView) and not base.has_own_poses:
        base, rows = base.base, [base.indices[row] for row in rows]
    names = [PurePath(name).name for name in base.names]
    order = sorted(range(len(names)), key=names.__getitem__)
    if order == list(range(len(names))):
        return
    posed = dict(zip(order, base.poses, strict=True))
    measured, ends = _informative_steps(steps, [posed[row] for row in rows])
    if len(measured) < _MIN_INFORMATIVE_STEPS:
        return
    fits, num = _interpret((), measured, _compute_steps(ends)).num_consistent, len(measured)
    is_better = fits > verdict.num_consistent + 1
    is_better &= fits * verdict.num_informative > verdict.num_consistent * num
    if is_better and fits >= _MIN_CONVENTION_RATIO * num:
        as_text, by_number = (", ".join(names[k] for k in one[:4]) for one in (order, range(4)))
        raise TrajectoryError(
            f"{sequence.name}: the rows of the poses are in the order of the names sorted as text"
            f" ({as_text} ...), and the pictures in that of their numbers ({by_number} ...): sort"
            " the rows like the pictures, by number"
        )


def _informative_steps(
    steps: Sequence[MeasuredStep], poses: Sequence[Rigid3 | None]
) -> tuple[list[MeasuredStep], list[tuple[Rigid3, Rigid3]]]:
    """Return the steps that decide on the poses, and the poses at their two ends."""
    measured: list[MeasuredStep] = []
    ends: list[tuple[Rigid3, Rigid3]] = []
    for step in steps:
        first, last = poses[step.first], poses[step.last]
        if first is not None and last is not None and step.decides_on(first.inverse() @ last):
            measured.append(step)
            ends.append((first, last))
    return measured, ends


def _compute_steps(ends: _Ends, conventions: tuple[str, ...] = ()) -> list[Rigid3]:
    """Return first_from_last of the poses, with these conventions undone."""
    undo = PoseConventions(conventions).undo_conventions
    return [undo(first).inverse() @ undo(last) for first, last in ends]


def _interpret(
    conventions: tuple[str, ...], measured: Sequence[MeasuredStep], steps: Sequence[Rigid3]
) -> _PoseInterpretation:
    """Return the interpretation with the error of each step relative to the measured one."""
    errors = [one.normalized_error(step) for one, step in zip(measured, steps, strict=True)]
    return _PoseInterpretation(conventions, np.array(errors))


def _test_conventions(
    measured: Sequence[MeasuredStep], ends: _Ends
) -> Iterator[_PoseInterpretation]:
    for conventions in _combine_conventions(ROTATIONS, DIRECTIONS, AXES):
        steps = _compute_steps(ends, conventions)
        unit, factor = _estimate_unit(measured, steps)
        steps = [Rigid3(step.rotation, factor * step.translation) for step in steps]
        yield _interpret((*conventions, *unit), measured, steps)


def _combine_conventions(*tables: dict[str, PoseConversion]) -> list[tuple[str, ...]]:
    """Return all combinations of at most one convention from each table."""
    choices = [[(), *((name,) for name in table)] for table in tables]
    return [tuple(itertools.chain(*parts)) for parts in itertools.product(*choices)]


def _estimate_unit(
    measured: Sequence[MeasuredStep], steps: Sequence[Rigid3]
) -> tuple[tuple[str, ...], float]:
    """Return the unit that gives the steps their measured lengths: as a convention, and in
    metres."""
    true = np.array([np.linalg.norm(step.first_from_last.translation) for step in measured])
    lengths = np.array([np.linalg.norm(step.translation) for step in steps])
    long = lengths > 1e-9
    if not all(step.has_scale for step in measured) or not true[long].any():
        return (), 1.0
    factor = float(np.sum(true[long]) / np.sum(lengths[long]))
    for name, metres in {"": 1.0, **UNITS}.items():
        if abs(math.log(factor / metres)) < _UNIT_TOLERANCE:
            return (name,) if name else (), metres
    return (f"scale={factor:.4g}",), factor


def _find_time_shift(
    measured: Sequence[MeasuredStep], poses: Sequence[Rigid3 | None], t_ns: Sequence[int]
) -> list[_PoseInterpretation]:
    """Find the time shift between poses and images with the smallest error.

    The list is empty if the recording is too short. Steps beyond an end get the median error.
    """
    posed = [(pose, time) for pose, time in zip(poses, t_ns, strict=True) if pose is not None]
    trajectory = Trajectory([pose for pose, _ in posed], [time for _, time in posed])
    largest = min(_MAX_SHIFT_S, 0.4e-9 * (posed[-1][1] - posed[0][1]))
    rows = [k for step in measured for k in (step.first, step.last)]
    min_steps, readings = max(_MIN_INFORMATIVE_STEPS, len(measured) // 2), []
    fractions = np.linspace(-1.0, 1.0, 2 * _NUM_SHIFTS + 1)
    for seconds in (largest * fractions * np.abs(fractions)).tolist():  # finer near 0
        shifted = trajectory.interpolate([t_ns[k] + round(1e9 * seconds) for k in rows], _MAX_GAP_S)
        errors = [
            step.normalized_error(first.inverse() @ last)
            for step, first, last in zip(measured, shifted[::2], shifted[1::2], strict=True)
            if first is not None and last is not None
        ]
        if abs(seconds) > _MIN_SHIFT_S and len(errors) >= min_steps:
            errors += [float(np.median(errors))] * (len(measured) - len(errors))
            readings.append(_PoseInterpretation((f"shift={seconds:.3g}",), np.array(errors)))
    return sorted(readings, key=lambda one: one.median_error)[:1]


def _test_body_poses(
    measured: Sequence[MeasuredStep], ends: _Ends
) -> Iterator[_PoseInterpretation]:
    """Test the poses as those of a body with the best-fitting camera mounting, if the steps have a
    scale."""
    if not all(step.has_scale for step in measured):
        return
    for conventions in _combine_conventions(ROTATIONS, DIRECTIONS):
        steps = _compute_steps(ends, conventions)
        pairs = kept = list(zip(measured, steps, strict=True))
        mounting, reading = Rigid3.identity(), _PoseInterpretation((), np.zeros(len(pairs)))
        for _ in range(_NUM_MOUNTING_ITERATIONS):  # without outliers, which may be measured wrongly
            mounting = _estimate_mounting(kept)
            w, x, y, z = mounting.quat_wxyz()
            numbers = ",".join(f"{number:.4g}" for number in (*mounting.translation, x, y, z, w))
            reading = _interpret(
                (*conventions, f"body={numbers}"),
                measured,
                [mounting.inverse() @ step @ mounting for step in steps],
            )
            is_kept = reading.normalized_errors <= 1.5 * reading.median_error
            kept = list(itertools.compress(pairs, is_kept))
        yield reading


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
    lefts = np.concatenate([step.rotation - np.eye(3) for _, step in pairs])
    for _ in range(_NUM_MOUNTING_ITERATIONS):
        correlation = of_axes / ROTATION_TOLERANCE**2
        for measured, step in pairs:
            way = step.translation - (translation - step.rotation @ translation)
            weighted = np.outer(way, measured.first_from_last.translation)
            correlation = correlation + weighted / measured.translation_tolerance**2
        rotation = nearest_rotation(correlation)
        rights = [
            rotation @ one.first_from_last.translation - step.translation for one, step in pairs
        ]
        translation = np.linalg.lstsq(lefts, np.concatenate(rights), rcond=_MIN_SINGULAR_RATIO)[0]
    return Rigid3(rotation, translation)
