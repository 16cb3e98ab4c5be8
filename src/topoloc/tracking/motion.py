"""How a camera moves: a filter over pose and velocity on SE(3), which predicts the next pose and
says how surprising another is.

An extended Kalman filter whose error state is the right perturbation of `world_from_cam` (the
camera's own axes, in which position and turn are hardly correlated) and the velocity in these axes:
Sola et al., *A micro Lie theory*, 2018, section V. Between two pictures the velocity is constant
but for an unknown acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from topoloc.bounds import Above, AtLeast
from topoloc.geometry.rigid import Rigid3


@dataclass(frozen=True)
class MotionConfig:
    """What cameras do: in a hand, on a robot, on a car."""

    sigma_acceleration: Annotated[float, Above(0)] = 3.0
    """Of an unknown acceleration, m/s^2."""
    sigma_angular_acceleration: Annotated[float, Above(0)] = 12.0
    """rad/s^2."""
    sigma_velocity: Annotated[float, Above(0)] = 8.0
    """Of the velocity of a camera seen once, m/s: it may be on a car."""
    sigma_angular_velocity: Annotated[float, Above(0)] = 2.0
    """rad/s."""
    max_step: Annotated[float, Above(0)] = 1.0
    """Seconds: the velocity says nothing of what comes later, so that the predicted camera stands
    still from there on."""
    odometry_share: Annotated[float, AtLeast(0)] = 0.05
    """Standard deviation of external odometry, as a share of the way and of the turn ..."""
    odometry_sigma: Annotated[float, Above(0)] = 0.002
    """... and beside it, metres and radians."""


@dataclass(frozen=True, eq=False)
class MotionState:
    """Pose and velocity at a time. `covariance` is that of (translation, rotation, velocity,
    angular velocity) in the camera's axes."""

    t_ns: int
    world_from_cam: Rigid3
    velocity: Float[np.ndarray, "6"]
    covariance: Float[np.ndarray, "12 12"]

    @property
    def pose_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Of the right perturbation of `world_from_cam`, equally of the left one of
        `cam_from_world` (m, rad)."""
        return self.covariance[:6, :6]


def start_motion(
    t_ns: int, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"], config: MotionConfig
) -> MotionState:
    """A camera seen once, of unknown velocity. `covariance` is of the right perturbation of the
    pose."""
    variances = np.repeat([config.sigma_velocity**2, config.sigma_angular_velocity**2], 3)
    both = np.zeros((12, 12))
    both[:6, :6], both[6:, 6:] = covariance, np.diag(variances)
    return MotionState(t_ns, world_from_cam, np.zeros(6), both)


def predict_motion(
    state: MotionState, t_ns: int, config: MotionConfig, before_from_cam: Rigid3 | None = None
) -> MotionState:
    """The state at a later time; with external odometry (`before_from_cam`: the motion since the
    state) it replaces the velocity."""
    seconds = (t_ns - state.t_ns) / 1e9
    step = (
        Rigid3.exp(min(seconds, config.max_step) * state.velocity)
        if before_from_cam is None
        else before_from_cam
    )
    transition = np.eye(12)
    transition[:6, :6] = step.inverse().adjoint()
    acceleration = np.diag(
        np.repeat([config.sigma_acceleration**2, config.sigma_angular_acceleration**2], 3)
    )
    # A white acceleration, which leads as far in a step as one that is constant throughout.
    # Constant it must not be: pose and velocity would be tied so firmly that an error of the
    # velocity turned its sign with each exact pose and
    # never faded.
    noise = np.zeros((12, 12))
    noise[6:, 6:] = 0.75 * seconds**2 * acceleration
    if before_from_cam is None:
        transition[:6, 6:] = min(seconds, config.max_step) * np.eye(6)
        noise[:6, :6] = seconds**4 / 4.0 * acceleration
        noise[:6, 6:] = noise[6:, :6] = seconds**3 * 3.0 / 8.0 * acceleration
        velocity = state.velocity
    else:
        way, turn = float(np.linalg.norm(step.translation)), step.angle()
        sigmas = (
            np.repeat([config.odometry_share * way, config.odometry_share * turn], 3)
            + config.odometry_sigma
        )
        noise[:6, :6] = np.diag(sigmas**2)
        velocity = step.log() / seconds if seconds > 0 else state.velocity
    covariance = transition @ state.covariance @ transition.T + noise
    return MotionState(t_ns, state.world_from_cam @ step, velocity, covariance)


def squared_mahalanobis(
    predicted: MotionState, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]
) -> float:
    """Squared Mahalanobis distance of a measured pose (its covariance of the right perturbation)
    from the predicted one; chi^2 with 6."""
    error = (predicted.world_from_cam.inverse() @ world_from_cam).log()
    return float(error @ np.linalg.solve(predicted.pose_covariance + covariance, error))


def update_motion(
    predicted: MotionState, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]
) -> MotionState:
    """The predicted state, corrected by a measured pose."""
    error = (predicted.world_from_cam.inverse() @ world_from_cam).log()
    gain = np.linalg.solve(predicted.pose_covariance + covariance, predicted.covariance[:6]).T
    correction = gain @ error
    posterior = predicted.covariance - gain @ predicted.covariance[:6]
    return MotionState(
        predicted.t_ns,
        predicted.world_from_cam @ Rigid3.exp(correction[:6]),
        predicted.velocity + correction[6:],
        (posterior + posterior.T) / 2.0,
    )
