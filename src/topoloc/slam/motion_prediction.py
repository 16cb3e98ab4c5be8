"""Predict the camera pose from constant velocity, with its uncertainty.

The error of constant velocity was observed at every frame so far, as an acceleration. A camera
without an image for a time T is off by the acceleration times T^2 / 2. So four lost frames are
bridged if a person walks steadily, but not if they start and stop.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from topoloc.geometry.alignment import normalized_pose_error
from topoloc.geometry.rigid import Rigid3


@dataclass(frozen=True, eq=False)
class Prediction:
    """Hold a predicted cam_from_world with the sigma of its position (metres) and direction
    (radians).

    Both are infinite if the motion is unknown. An expected pose is less than `max_sigmas` away.
    """

    cam_from_world: Rigid3
    step: Rigid3
    sigma: float
    sigma_rad: float
    is_gap: bool
    max_sigmas: float = 3.0

    def distance(self, cam_from_world: Rigid3) -> float:
        """Return the distance of a pose from the prediction, in sigma."""
        poses = self.cam_from_world.inverse(), cam_from_world.inverse()
        return normalized_pose_error(*poses, self.sigma, self.sigma_rad)

    def is_near(self, cam_from_world: Rigid3) -> bool:
        """Return whether a pose is expected."""
        return self.distance(cam_from_world) < self.max_sigmas


def select_expected_pose(prediction: Prediction | None, poses: Sequence[Rigid3]) -> Rigid3 | None:
    """Select the pose (cam_from_world) that the motion supports: it is near the prediction, all
    others far.

    None if there is no such pose. If it is unknown how fast the motion changes, all other poses of
    the next frame must be twice as far from the prediction.
    """
    # Minimum margin of an expected step over another one: the root of the difference of their
    # squared distances, in sigma. The sigma of the very next frame allows a sudden stop.
    clear_sigmas = 3.5 if prediction is not None and prediction.is_gap else 3.0
    if len(poses) == 1:
        return poses[0]
    if prediction is None or not poses:
        return None
    is_unknown = np.isinf(prediction.sigma) and not prediction.is_gap
    expected = replace(prediction, sigma=1.0) if is_unknown else prediction
    distances = np.array([expected.distance(pose) for pose in poses])
    nearest, next_one = np.argsort(distances, kind="stable")[:2]
    least, is_near = distances[nearest], distances[nearest] < prediction.max_sigmas
    others = 2.0 * least if is_unknown else np.hypot(least, clear_sigmas)
    clear = (is_near or is_unknown) and distances[next_one] > others
    return poses[int(nearest)] if clear else None


class MotionHistory:
    """Hold the velocity of the last step, and the accelerations before it."""

    def __init__(self) -> None:
        num_remembered = 20  # number of recent steps from which the acceleration is estimated
        self._squared_accelerations: deque[np.ndarray] = deque(maxlen=num_remembered)
        self._intervals: deque[float] = deque(maxlen=num_remembered)
        self._velocity: np.ndarray | None = None  # twist, left of cam_from_world, per second
        self._t_ns: int | None = None
        self._cam_from_world: Rigid3 | None = None

    def add_pose(self, t_ns: int, cam_from_world: Rigid3, motion: Rigid3 | None = None) -> None:
        """Add the pose of a frame. `motion` is its motion since the preceding frame, None if
        unknown."""
        if motion is not None and self._t_ns is not None and t_ns > self._t_ns:
            interval = 1e-9 * (t_ns - self._t_ns)
            velocity = motion.log() / interval
            if self._velocity is not None:
                change = (velocity - self._velocity) * interval
                between = 0.5 * (interval + self._intervals[-1])
                rates = np.linalg.norm(change.reshape(2, 3), axis=1) / (interval * between)
                self._squared_accelerations.append(rates**2)
            self._velocity = velocity
            self._intervals.append(interval)
        self._t_ns, self._cam_from_world = t_ns, cam_from_world

    def update_last_pose(self, cam_from_world: Rigid3) -> None:
        """Replace the last pose after an adjustment."""
        self._cam_from_world = cam_from_world

    def reset(self) -> None:
        """Discard the motion after the camera was lost. Accelerations are kept."""
        self._velocity, self._t_ns, self._cam_from_world = None, None, None

    def predict(self, t_ns: int, is_gap: bool = False) -> Prediction | None:
        """Predict the pose at a time after the last frame. None if there is no last frame. `is_gap`
        tells that frames were lost since; a long time tells it, too."""
        max_intervals = 10.0  # maximum number of intervals over which a motion is extrapolated
        gap = 1.5  # A frame follows a gap if it comes later than this many median intervals
        min_remembered = 3  # minimum number of steps for this estimate
        # Minimum sigma of a prediction after a gap, as a share of its translation and rotation. For
        # the very next frame it is larger, because a camera may stop or turn back.
        way_share, stop_share = 0.1, 0.7
        if self._t_ns is None or self._cam_from_world is None:
            return None
        time = max(1e-9 * (t_ns - self._t_ns), 0.0)
        is_gap |= bool(self._intervals) and time > gap * float(np.median(self._intervals))
        if self._velocity is None or not self._intervals:
            return Prediction(self._cam_from_world, Rigid3.identity(), np.inf, np.inf, is_gap)
        last = self._intervals[-1]
        step = self._velocity * min(time, max_intervals * last)
        way, turn = float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))
        motion = Rigid3.exp(step)
        pose = motion @ self._cam_from_world
        if len(self._squared_accelerations) < min_remembered:
            return Prediction(pose, motion, np.inf, np.inf, is_gap)
        growth = 0.5 * time * (time + last)
        share = way_share if is_gap else stop_share
        rates = np.sqrt(np.mean(np.array(self._squared_accelerations), axis=0)).tolist()
        sigma, sigma_rad = (
            max(rate * growth, share * size, 1e-3)
            for rate, size in zip(rates, (way, turn), strict=True)
        )
        return Prediction(pose, motion, sigma, sigma_rad, is_gap)
