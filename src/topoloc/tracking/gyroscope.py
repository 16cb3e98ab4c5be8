"""Measure the rotation between two images with a gyroscope, as a prior of a stream alone.

The rates of the images, log(R) / seconds, are those of the gyroscope in other axes, less its bias:
``rate_cam = cam_from_imu (rate_imu - bias)``. This is a rigid transform of points in the space of
rates. Least median of squares over three turns each gives a start, and all turns that agree refine
it. The transform comes from the images alone, so it needs no calibration. The gyroscope is used
once enough turns agree. It is refused if they contradict it.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from topoloc.errors import TrajectoryError
from topoloc.geometry.alignment import align_points
from topoloc.geometry.rigid import Rigid3, exp_so3, log_so3, quat_wxyz_from_matrix
from topoloc.geometry.transform_consensus import find_least_median
from topoloc.localization.result import Localization
from topoloc.tracking.motion import MeasuredTurn
from topoloc.tracking.stream_result import StreamedPose

_KEPT_NS, _GAP_NS = 30_000_000_000, 100_000_000
"""Nanoseconds for which samples are kept, and the longest time between two samples."""
_ENOUGH_TURNS, _CLEAR = 10, 0.7
"""Turns before a decision, and the share of them that agrees with a gyroscope in use."""
_Rotation = Float[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False)
class _Observation:
    """Hold the rates between two localized images, rad/s: by the images and by the gyroscope.

    `sigma` is the standard deviation of the rate by the images.
    """

    by_images: Float[np.ndarray, "3"]
    by_imu: Float[np.ndarray, "3"]
    seconds: float
    sigma: float

    @property
    def is_turn(self) -> bool:
        """Return whether the camera turned by more than the errors of the poses."""
        least = 0.03  # radians
        rate = float(np.linalg.norm(self.by_images))
        return rate * self.seconds > least and rate > 3.0 * self.sigma


class Gyroscope:
    """Hold the samples of a gyroscope, its bias, and its axes in those of the camera.

    `fault` is the reason for which it is not used, None if there is none.

    Args:
        cam_from_imu: rotation (3, 3), if it is known. Default: it is found from the images.
    """

    def __init__(self, cam_from_imu: Float[np.ndarray, "3 3"] | None = None) -> None:
        self._given = cam_from_imu
        self.fault: str | None = None
        self._t_ns, self._rates = list[int](), list[np.ndarray]()
        self._observed = deque[_Observation](maxlen=200)
        self._last: StreamedPose | None = None
        self._fitted: Rigid3 | None = None  # of rates, rad/s
        self._sigma = math.inf  # of a rate between images, rad/s
        self._axes_sigma = 0.0  # of the axes, radians

    def add(self, t_ns: int, rate: Float[np.ndarray, "3"]) -> None:
        """Add a sample: angular velocity in the axes of the IMU, rad/s. Samples without finite
        numbers are left out. An earlier time than before starts anew."""
        if not np.isfinite(rate).all():
            return
        if self._t_ns and t_ns <= self._t_ns[-1]:
            if t_ns == self._t_ns[-1]:
                return
            self._t_ns, self._rates, self._last = [], [], None
        self._t_ns.append(t_ns)
        self._rates.append(np.asarray(rate, np.float64))
        if len(self._t_ns) % 1000 == 0:
            old = bisect_left(self._t_ns, t_ns - _KEPT_NS)
            del self._t_ns[:old], self._rates[:old]

    @property
    def bias(self) -> Float[np.ndarray, "3"]:
        """Return the bias in the axes of the IMU, rad/s. It is zero until it is known."""
        fit = self._fitted
        return np.zeros(3) if fit is None else -fit.rotation.T @ fit.translation

    @property
    def cam_from_imu(self) -> Float[np.ndarray, "3 3"] | None:
        """Return the rotation, None until the images confirm the gyroscope."""
        return None if self._fitted is None else self._fitted.rotation

    def measure_turn(self, start_ns: int, end_ns: int) -> MeasuredTurn | None:
        """Return the rotation of the camera between two times. None if samples are missing, or the
        images have not confirmed the gyroscope."""
        seconds, transform = (end_ns - start_ns) / 1e9, self._fitted
        interval = 0.1  # seconds between observations
        if transform is None or self.fault is not None or seconds <= 0.0:
            return None
        integrated = self._integrate(start_ns, end_ns, self.bias)
        if integrated is None:
            return None
        turn = integrated[0]
        sigma = self._sigma * math.sqrt(interval * max(seconds, interval))
        return MeasuredTurn(
            transform.rotation @ turn,
            math.hypot(sigma, self._axes_sigma * float(np.linalg.norm(turn))),
        )

    def observe(self, answer: StreamedPose) -> None:
        """Compare the gyroscope with a measured pose. Poses that are no evidence are left out."""
        min_seconds, max_seconds, wanted_turn = 0.1, 0.5, 0.05  # radians end an observation, too
        result, before = answer.result, self._last
        if not isinstance(result, Localization) or not answer.is_measured or answer.is_repeated:
            return
        if before is None or before.track != answer.track:
            self._last = answer
            return
        was, dt = before.result, (answer.t_ns - before.t_ns) / 1e9
        if dt < min_seconds or not isinstance(was, Localization):
            return
        seen = log_so3(was.world_from_cam.rotation.T @ result.world_from_cam.rotation)
        if dt < max_seconds and np.linalg.norm(seen) < wanted_turn:
            return
        self._last = answer
        integrated = self._integrate(before.t_ns, answer.t_ns, np.zeros(3))
        if integrated is None or dt > 2.0 * max_seconds:
            return
        turn, total = integrated
        if np.linalg.norm(total) > math.pi:  # as of degrees; the rotation has a shorter vector
            turn = total
        sigma = math.radians(math.hypot(was.rotation_sigma_deg, result.rotation_sigma_deg))
        self._observed.append(_Observation(seen / dt, turn / dt, dt, sigma / dt))
        if self.fault is None:
            self._fit()

    def _integrate(
        self, start_ns: int, end_ns: int, bias: Float[np.ndarray, "3"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
        """Return the rotation vector between two times in the axes of the IMU at the first one, and
        the integral of the rates. None if samples are missing."""
        first, last = bisect_right(self._t_ns, start_ns), bisect_left(self._t_ns, end_ns)
        inner = self._t_ns[first:last]
        around = self._t_ns[max(first - 1, 0) : last + 1]
        if not around or max(around[0] - start_ns, end_ns - around[-1]) > _GAP_NS // 4:
            return None
        if any(after - before > _GAP_NS for before, after in pairwise(around)):
            return None
        rates = np.array(self._rates[max(first - 1, 0) : last + 1])
        times = np.array([start_ns, *inner, end_ns], np.int64)
        at = np.column_stack([np.interp(times, around, column) for column in rates.T]) - bias
        rotation, steps = np.eye(3), (at[:-1] + at[1:]) / 2.0 * np.diff(times)[:, None] / 1e9
        for step in steps:
            rotation = rotation @ exp_so3(step)
        return log_so3(rotation), steps.sum(axis=0)

    def _fit(self) -> None:
        """Fit rotation and bias to the observations, and decide whether the gyroscope is used."""
        max_axes_sigma = 0.1  # radians; a turn is predicted this share of it wrongly
        is_turn = np.array([one.is_turn for one in self._observed])
        num_turns = int(np.count_nonzero(is_turn))
        if num_turns < _ENOUGH_TURNS:
            return
        rates, known = _Rates.of(self._observed), self._fitted
        turns = rates.select(is_turn)
        start = turns.find_start(self._given) if known is None else known
        fit = rates.refine(start, self._given)
        share = turns.share_of_agreeing(fit)
        axes_sigma = 0.01 if self._given is not None else rates.axes_sigma(fit)
        if share < 0.5 and num_turns >= 2 * _ENOUGH_TURNS:
            self.fault, self._fitted = turns.describe_fault(self._given), None
        elif known is not None or (share >= _CLEAR and axes_sigma <= max_axes_sigma):
            self._fitted, self._sigma = fit, rates.sigma(fit)
            self._axes_sigma = axes_sigma


@dataclass(frozen=True, eq=False)
class _Rates:
    """Hold the rates of turns by the images and by the gyroscope, rad/s. `sigmas` are those of the
    images."""

    by_images: Float[np.ndarray, "n 3"]
    by_imu: Float[np.ndarray, "n 3"]
    sigmas: Float[np.ndarray, " n"]

    @staticmethod
    def of(observed: Sequence[_Observation]) -> _Rates:
        by_images, by_imu = (
            np.array([getattr(one, name) for one in observed]) for name in ("by_images", "by_imu")
        )
        return _Rates(by_images, by_imu, np.array([one.sigma for one in observed]))

    def select(self, chosen: Bool[np.ndarray, " n"]) -> _Rates:
        return _Rates(self.by_images[chosen], self.by_imu[chosen], self.sigmas[chosen])

    def find_start(self, given: _Rotation | None) -> Rigid3:
        """Return the transform with the least median of errors. `given` fixes its rotation."""
        num_hypotheses = 100
        if given is not None:
            return Rigid3(given, np.median(self.by_images - self.by_imu @ given.T, axis=0))
        rng, hypotheses = np.random.default_rng(0), [Rigid3.identity()]
        for _ in range(num_hypotheses):
            rows = rng.choice(len(self.sigmas), 3, replace=False)
            with suppress(TrajectoryError):  # three turns about one axis
                hypotheses.append(align_points(self.by_images[rows], self.by_imu[rows]))
        return find_least_median(hypotheses, self.errors)[0]

    def refine(self, fit: Rigid3, given: _Rotation | None) -> Rigid3:
        """Return the fit to the turns that agree with a transform."""
        agrees = self.agrees(fit)
        if given is not None:
            shifts = (self.by_images - self.by_imu @ given.T)[agrees]
            return Rigid3(given, shifts.mean(axis=0)) if len(shifts) else fit
        try:
            return align_points(self.by_images[agrees], self.by_imu[agrees])
        except TrajectoryError:
            return fit

    def errors(self, fit: Rigid3) -> Float[np.ndarray, " n"]:
        return np.linalg.norm(self.by_images - fit.apply(self.by_imu), axis=1)

    def sigma(self, fit: Rigid3) -> float:
        """Return the standard deviation of an error along an axis, rad/s."""
        return float(np.median(self.errors(fit))) / 1.538  # the median length of a normal vector

    def agrees(self, fit: Rigid3) -> Bool[np.ndarray, " n"]:
        """Return which turns agree: within a quarter of the rate, and three sigma of the images."""
        allowed = 0.25 * np.linalg.norm(self.by_images, axis=1) + 3.0 * self.sigmas
        return self.errors(fit) <= allowed

    def axes_sigma(self, fit: Rigid3) -> float:
        """Return the standard deviation of the rotation about its least known axis, radians."""
        spread = np.linalg.svd(self.by_imu - self.by_imu.mean(axis=0), compute_uv=False)
        return self.sigma(fit) / max(float(np.hypot(*spread[1:])), 1e-9)

    def share_of_agreeing(self, fit: Rigid3) -> float:
        return float(np.mean(self.agrees(fit)))

    def describe_fault(self, given: _Rotation | None) -> str:
        """Return why the turns contradict the gyroscope, and what to do."""
        axes = self.find_start(None).rotation if given is None else given
        others = (
            (1.0, "the given rotation of the IMU is off by {:.0f} degrees: the images give {}"),
            (math.pi / 180.0, "the rates seem to be in degrees per second; give rad/s"),
            (-1.0, "the axes are left-handed; change the sign of one axis, or swap two"),
        )
        for scale, text in others:
            scaled = replace(self, by_imu=scale * self.by_imu)
            fit = scaled.refine(scaled.find_start(None), None)
            if scaled.share_of_agreeing(fit) >= _CLEAR:
                angle = math.degrees(Rigid3(axes.T @ fit.rotation, np.zeros(3)).angle())
                return text.format(angle, format_rotation(fit.rotation))
        return "its turns are not those of the images; check that the times have one clock"


def format_rotation(rotation: _Rotation) -> str:
    """Return a rotation as the quaternion `w,x,y,z`."""
    return ",".join(f"{value:.4f}" for value in quat_wxyz_from_matrix(rotation))
