"""Filter the camera's pose and velocity on SE(3), predict the next pose and test measured poses.
Define the hypotheses about them.

It is an extended Kalman filter. Its error state is the right perturbation of `world_from_cam` and
the velocity, both in the camera's axes. In these axes position and rotation are hardly correlated.
See Sola et al., *A micro Lie theory*, 2018, section V. The velocity between two images is constant
except for an unknown acceleration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from topoloc.bounds import Above
from topoloc.geometry.rigid import Rigid3
from topoloc.node_ids import NodeId


@dataclass(frozen=True)
class MotionConfig:
    """Configure the motion model for a handheld camera, a robot or a car."""

    sigma_acceleration: Annotated[float, Above(0)] = 3.0
    """Standard deviation of the unknown acceleration, m/s^2."""
    sigma_angular_acceleration: Annotated[float, Above(0)] = 12.0
    """Standard deviation of the unknown angular acceleration, rad/s^2."""


@dataclass(frozen=True, eq=False)
class MotionState:
    """Hold the pose and velocity at a time.

    `covariance` is that of (translation, rotation, velocity, angular velocity) in the camera's
    axes.
    """

    t_ns: int
    world_from_cam: Rigid3
    velocity: Float[np.ndarray, "6"]
    covariance: Float[np.ndarray, "12 12"]

    @property
    def pose_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Return the covariance of the right perturbation of `world_from_cam` (m, rad).

        It equals that of the left perturbation of `cam_from_world`.
        """
        return self.covariance[:6, :6]


@dataclass(frozen=True, eq=False)
class MeasuredTurn:
    """Hold the rotation of the camera since a state, as a gyroscope measured it.

    `rotvec` is a rotation vector in the camera's axes at the state, radians. `sigma` is its
    standard deviation about each axis.
    """

    rotvec: Float[np.ndarray, "3"]
    sigma: float

    def replace_velocity(self, state: MotionState, seconds: float) -> MotionState:
        """Return the state with the mean angular velocity of the turn, which takes `seconds`."""
        velocity, covariance = state.velocity.copy(), state.covariance.copy()
        velocity[3:] = self.rotvec / seconds
        covariance[9:], covariance[:, 9:] = 0.0, 0.0
        covariance[9:, 9:] = (self.sigma / seconds) ** 2 * np.eye(3)
        return replace(state, velocity=velocity, covariance=covariance)


def start_motion(
    t_ns: int, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]
) -> MotionState:
    """Return the state of a camera measured once, with unknown velocity.

    `covariance` is that of the right perturbation of the pose.
    """
    # Standard deviation of the initial velocity, m/s. The camera may be on a car.
    sigma_velocity = 8.0
    sigma_angular_velocity = 2.0  # standard deviation of the initial angular velocity, rad/s
    variances = np.repeat([sigma_velocity**2, sigma_angular_velocity**2], 3)
    both = np.zeros((12, 12))
    both[:6, :6], both[6:, 6:] = covariance, np.diag(variances)
    return MotionState(t_ns, world_from_cam, np.zeros(6), both)


def predict_motion(
    state: MotionState,
    t_ns: int,
    config: MotionConfig,
    before_from_cam: Rigid3 | None = None,
    turn: MeasuredTurn | None = None,
) -> MotionState:
    """Predict the state at a later time.

    External odometry replaces the velocity if it is given. `before_from_cam` is its motion since
    the state. Else `turn` replaces the angular velocity.
    """
    # Seconds for which the velocity is extrapolated. The predicted camera stands still after
    # that.
    max_step = 1.0
    # Standard deviation of external odometry, as a share of the translation and the rotation.
    odometry_share = 0.05
    # Standard deviation of external odometry that is added to this share, metres and radians.
    odometry_sigma, seconds = 0.002, (t_ns - state.t_ns) / 1e9
    spans, sigma_angular = np.full(6, min(seconds, max_step)), config.sigma_angular_acceleration
    if turn is not None and before_from_cam is None:
        state, spans[3:], sigma_angular = turn.replace_velocity(state, seconds), seconds, 0.0
    step = Rigid3.exp(spans * state.velocity) if before_from_cam is None else before_from_cam
    transition = np.eye(12)
    transition[:6, :6] = step.inverse().adjoint()
    acceleration = np.diag(np.repeat([config.sigma_acceleration**2, sigma_angular**2], 3))
    # The acceleration is white and moves as far in a step as a constant one. A constant
    # acceleration would tie pose and velocity so firmly that a velocity error changes its sign with
    # each exact pose and never fades.
    noise = np.zeros((12, 12))
    noise[6:, 6:] = 0.75 * seconds**2 * acceleration
    if before_from_cam is None:
        transition[:6, 6:] = np.diag(spans)
        noise[:6, :6] = seconds**4 / 4.0 * acceleration
        noise[:6, 6:] = noise[6:, :6] = seconds**3 * 3.0 / 8.0 * acceleration
        velocity = state.velocity
    else:
        way, angle = float(np.linalg.norm(step.translation)), step.angle()
        sigmas = np.repeat([odometry_share * way, odometry_share * angle], 3) + odometry_sigma
        noise[:6, :6] = np.diag(sigmas**2)
        velocity = step.log() / seconds if seconds > 0 else state.velocity
    covariance = transition @ state.covariance @ transition.T + noise
    return MotionState(t_ns, state.world_from_cam @ step, velocity, covariance)


def update_motion(
    predicted: MotionState, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]
) -> MotionState:
    """Return the predicted state, corrected by a measured pose."""
    error = (predicted.world_from_cam.inverse() @ world_from_cam).log()
    gain = np.linalg.solve(predicted.pose_covariance + covariance, predicted.covariance[:6]).T
    correction, posterior = gain @ error, predicted.covariance - gain @ predicted.covariance[:6]
    return MotionState(
        predicted.t_ns,
        predicted.world_from_cam @ Rigid3.exp(correction[:6]),
        predicted.velocity + correction[6:],
        (posterior + posterior.T) / 2.0,
    )


@dataclass(frozen=True, eq=False)
class MotionHypothesis:
    """Hold one hypothesis.

    `state` and `odom_from_cam` belong to the last measured pose, `current` to the current image.
    `from_best` transforms poses of the best hypothesis into those of this one, and stays valid
    under common motion. `candidate_idx` is the index of the candidate used for this image, None if
    none was. `track` numbers the hypotheses that an image started.
    """

    state: MotionState
    odom_from_cam: Rigid3 | None
    current: MotionState
    weight: float
    node_id: NodeId
    from_best: Rigid3
    candidate_idx: int | None
    track: int = 0

    def measured(
        self, state: MotionState, odom_from_cam: Rigid3 | None, **changes: Any
    ) -> MotionHypothesis:
        """Return the hypothesis with the state measured in the current image."""
        return replace(self, state=state, current=state, odom_from_cam=odom_from_cam, **changes)


def merge_duplicates(hypotheses: list[MotionHypothesis]) -> list[MotionHypothesis]:
    """Merge hypotheses with the same pose and velocity, and prefer those measured now."""
    kept: list[MotionHypothesis] = []
    least = 1e-4 * max(hypothesis.weight for hypothesis in hypotheses)
    heavy = [hypothesis for hypothesis in hypotheses if hypothesis.weight > least]
    for hypothesis in sorted(
        heavy, key=lambda hypothesis: (hypothesis.candidate_idx is None, -hypothesis.weight)
    ):
        for k, other in enumerate(kept):
            if _is_same_motion(hypothesis.current, other.current):
                kept[k] = replace(other, weight=other.weight + hypothesis.weight)
                break
        else:
            kept.append(hypothesis)
    return kept


def _is_same_motion(a: MotionState, b: MotionState) -> bool:
    """Return whether two states differ by less than their covariances allow.

    The limit on the squared Mahalanobis distance (12 degrees of freedom) is 6.
    """
    error = np.concatenate(
        [(a.world_from_cam.inverse() @ b.world_from_cam).log(), b.velocity - a.velocity]
    )
    return float(error @ np.linalg.solve(a.covariance + b.covariance, error)) < 6.0


def is_same_place(a: Rigid3, b: Rigid3) -> bool:
    """Return whether two poses are within 0.25 m and 5 degrees."""
    return a.is_same(b, 0.25, math.radians(5.0))
