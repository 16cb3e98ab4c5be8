"""What is believed of a stream's motion: predicts the next picture's pose and refuses poses that cannot follow.

A refused pose is not forgotten: it begins a rival to what is believed, and where the next poses agree with the rival, it is
believed instead. So a camera that was carried elsewhere, or was placed wrongly to begin with, is found again.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Float

from topoloc.bounds import Above, AtLeast
from topoloc.geometry.rigid import Rigid3
from topoloc.tracking.motion import MotionConfig, MotionState, predict_motion, start_motion, surprise, update_motion


@dataclass(frozen=True)
class GateConfig:
    """What is refused, what is believed after all, and how far a prediction reaches."""

    motion: MotionConfig = field(default_factory=MotionConfig)
    max_surprise: Annotated[float, Above(0)] = 33.0
    """Squared Mahalanobis distance from the prediction (chi^2 with 6 degrees of freedom: 1 in 100,000) beyond which a pose is refused."""
    prediction_scale: Annotated[float, Above(0)] = 2.5
    """By how much the prediction may be more wrong than its sigma says: hands jerk, wheels meet kerbs."""
    num_agreeing: Annotated[int, AtLeast(1)] = 3
    """So many refused poses in a row that agree with each other are believed after all."""
    max_predicted: Annotated[float, AtLeast(0)] = 1.0
    """Seconds without a measured pose after which the camera is lost ..."""
    max_predicted_with_odometry: Annotated[float, AtLeast(0)] = 20.0
    """... or with external odometry."""


@dataclass(frozen=True, eq=False)
class _Rival:
    """Another belief, and how many poses speak for it."""

    state: MotionState
    odom_from_cam: Rigid3 | None
    num_agreeing: int


class MotionGate:
    """Holds the pose measured last with its velocity, the external odometry of that moment, and the rival."""

    def __init__(self, config: GateConfig) -> None:
        self._config = config
        self.forget()

    def forget(self) -> None:
        """Nothing is known."""
        self._state: MotionState | None = None
        self._odom_from_cam: Rigid3 | None = None
        self._rival: _Rival | None = None

    def seconds_since(self, t_ns: int) -> float:
        """Seconds from the pose believed last to this time; infinite where there is none."""
        return float("inf") if self._state is None else (t_ns - self._state.t_ns) / 1e9

    def predict(self, t_ns: int, odom_from_cam: Rigid3 | None = None) -> MotionState | None:
        """Where the camera is at this time; None where it is lost."""
        if self._state is None:
            return None
        before_from_cam = _since(self._odom_from_cam, odom_from_cam)
        config = self._config
        limit = config.max_predicted if before_from_cam is None else config.max_predicted_with_odometry
        if t_ns - self._state.t_ns > limit * 1e9:
            return None
        return predict_motion(self._state, t_ns, config.motion, before_from_cam)

    def follows(self, predicted: MotionState, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]) -> bool:
        """Whether this pose can follow. `covariance` is here, as everywhere below, of the right perturbation."""
        slack = (self._config.prediction_scale**2 - 1.0) * predicted.pose_covariance
        return surprise(predicted, world_from_cam, covariance + slack) <= self._config.max_surprise

    def is_overruled(
        self, t_ns: int, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"], odom_from_cam: Rigid3 | None = None
    ) -> bool:
        """Whether this pose, which cannot follow, has so many before it that agree with it that it is the belief that is wrong."""
        rival, config = self._rival, self._config
        if rival is not None and t_ns - rival.state.t_ns <= config.max_predicted * 1e9:
            predicted = predict_motion(rival.state, t_ns, config.motion, _since(rival.odom_from_cam, odom_from_cam))
            if self.follows(predicted, world_from_cam, covariance):
                state = update_motion(predicted, world_from_cam, covariance)
                self._rival = _Rival(state, odom_from_cam, rival.num_agreeing + 1)
                return self._rival.num_agreeing >= config.num_agreeing
        self._rival = _Rival(start_motion(t_ns, world_from_cam, covariance, config.motion), odom_from_cam, 1)
        return config.num_agreeing <= 1

    def begin(self, t_ns: int, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"], odom_from_cam: Rigid3 | None) -> MotionState:
        """Believe this pose whatever was before; a rival that led to it keeps its velocity."""
        known = self._rival.state if self._rival is not None and self._rival.state.t_ns == t_ns else None
        self._state = known or start_motion(t_ns, world_from_cam, covariance, self._config.motion)
        self._odom_from_cam, self._rival = odom_from_cam, None
        return self._state

    def correct(
        self, predicted: MotionState, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"], odom_from_cam: Rigid3 | None
    ) -> MotionState:
        """Believe this pose, which follows from the ones before."""
        self._state, self._odom_from_cam = update_motion(predicted, world_from_cam, covariance), odom_from_cam
        return self._state

    def drop_rival(self) -> None:
        """A pose that follows was measured in full."""
        self._rival = None


def _since(odom_from_before: Rigid3 | None, odom_from_cam: Rigid3 | None) -> Rigid3 | None:
    """The motion that external odometry saw, where it was there both times."""
    if odom_from_before is None or odom_from_cam is None:
        return None
    return odom_from_before.inverse() @ odom_from_cam
