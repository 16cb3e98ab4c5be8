"""Weigh camera models by the residuals of an image whose camera is not calibrated.

The principal point of a cropped image is not in its centre, and lenses distort. Such errors move
the pose by metres, but the residuals of many points show them. Gauss-Newton estimates the pose and
eight camera parameters together. These are the logarithm of the focal length, the principal point,
four cubic terms of distortion and one of the fifth power of the radius r:

    x' = f x (1 + a x^2 + b y^2 + e r^4) + cx,    y' = f y (1 + c x^2 + d y^2 + e r^4) + cy

A radial lens has a = b = c = d, a panorama has not. Without e, fisheye lenses look off-centre. Each
hypothesis about the camera is a normal prior of the eight parameters: narrow where it assumes a
value, wide where the image decides. The evidence of a hypothesis is the density of the estimate
under it. So a parameter is only estimated if the residuals ask for it. Residuals that neighbouring
points share count as noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from topoloc.geometry.joint_camera.camera_hypotheses import (
    CameraBelief,
    CameraHypothesis,
    CameraLikelihood,
    CameraPrior,
    Matrix,
    Vector,
    WeighedCamera,
)
from topoloc.geometry.pose_matches import CAUCHY_SCALE, estimate_noise_scale
from topoloc.geometry.rigid import Rigid3

_NUM_ROUNDS = 15


@dataclass(frozen=True, eq=False)
class CameraObservations:
    """Hold n pixels on the plane z = 1 of a first camera (standard deviation `sigma`), and the
    world points (metres) with covariances (m^2) that they show. `cells` are parts of the image,
    within which errors may be shared."""

    points: Float[np.ndarray, "n 2"]
    sigma: float | Float[np.ndarray, " n"]
    points_world: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    cells: np.ndarray
    max_error: float

    def linearize(
        self, cam_from_world: Rigid3, camera: Vector
    ) -> tuple[Float[np.ndarray, "n 2 14"], Float[np.ndarray, "n 2 2"], Float[np.ndarray, "n 2"]]:
        """Return the derivatives of the projections by the pose's left perturbation and the camera,
        the information of each pixel, and the residuals. The information of points behind the
        camera is zero."""
        x, y, z = cam_from_world.apply(self.points_world).T
        is_seen = z > 1e-6
        z = np.where(is_seen, z, 1.0)
        u, v, w, scale = x / z, y / z, 1.0 / z, math.exp(camera[0])
        a, b, c, d, e = camera[3:]
        uu, vv, zero = u * u, v * v, np.zeros_like(u)
        rr, r4 = uu + vv, (uu + vv) ** 2
        bent_u = u * (1.0 + a * uu + b * vv + e * r4)
        bent_v = v * (1.0 + c * uu + d * vv + e * r4)
        projected = scale * np.stack([bent_u, bent_v], axis=1) + camera[1:3]
        by_u = np.stack([w, zero, -u * w, -u * v, 1.0 + uu, -v], axis=1)
        by_v = np.stack([zero, w, -v * w, -(1.0 + vv), u * v, u], axis=1)
        jacobian = np.zeros((len(u), 2, 14))
        along_u, along_v = e * rr * (rr + 4.0 * uu), e * rr * (rr + 4.0 * vv)
        jacobian[:, 0, :6] = (1.0 + 3.0 * a * uu + b * vv + along_u)[:, None] * by_u
        jacobian[:, 0, :6] += (2.0 * u * v * (b + 2.0 * e * rr))[:, None] * by_v
        jacobian[:, 1, :6] = (1.0 + c * uu + 3.0 * d * vv + along_v)[:, None] * by_v
        jacobian[:, 1, :6] += (2.0 * u * v * (c + 2.0 * e * rr))[:, None] * by_u
        jacobian[:, 0, 6], jacobian[:, 1, 6] = bent_u, bent_v
        jacobian[:, 0, 9], jacobian[:, 0, 10] = u * uu, u * vv
        jacobian[:, 1, 11], jacobian[:, 1, 12] = v * uu, v * vv
        jacobian[:, 0, 13], jacobian[:, 1, 13] = u * r4, v * r4
        jacobian *= scale
        jacobian[:, 0, 7] = jacobian[:, 1, 8] = 1.0
        by_world = jacobian[:, :, :3] @ cam_from_world.rotation
        spread = by_world @ self.covariances @ by_world.transpose(0, 2, 1)
        spread += np.square(self.sigma)[..., None, None] * np.eye(2)
        return jacobian, np.linalg.inv(spread) * is_seen[:, None, None], projected - self.points


@dataclass(frozen=True, eq=False)
class JointFit:
    """Hold a pose and a camera that fit observations together.

    Args:
        information: of the pose and the eight camera parameters, without the prior.
        pull: information times the estimate of the camera parameters by the observations alone.
        variance: factor by which the noise exceeds the assumed one, errors shared within parts of
            the image included.
    """

    cam_from_world: Rigid3
    camera: Vector
    information: Float[np.ndarray, "14 14"]
    pull: Vector
    variance: float

    @cached_property
    def pose_by_camera(self) -> Float[np.ndarray, "6 8"]:
        """Return the shift of the pose for a change of the camera parameters."""
        return -np.linalg.solve(self.information[:6, :6], self.information[:6, 6:])

    @cached_property
    def likelihood(self) -> CameraLikelihood:
        """Return what the observations show of the camera, whatever the pose."""
        known = self.information[6:, 6:] + self.information[6:, :6] @ self.pose_by_camera
        return CameraLikelihood(known / self.variance, self.pull / self.variance)


def fit_jointly(
    seen: CameraObservations,
    cam_from_world: Rigid3,
    camera: Vector,
    prior: tuple[Vector, Matrix],
    basis: Float[np.ndarray, "8 k"],
) -> JointFit | None:
    """Fit pose and camera together, from a nearby pose and camera. Only the directions of `basis`
    are estimated. None if the observations do not fix the pose."""
    to_all = np.zeros((14, 6 + basis.shape[1]))
    to_all[:6, :6], to_all[6:, 6:] = np.eye(6), basis
    mean, by_prior = prior[0], np.linalg.inv(prior[1])
    active = None
    for number in range(_NUM_ROUNDS):
        system = _linear_system(seen, cam_from_world, camera, active if number % 3 else None)
        if system is None:
            return None
        information, gradients, _, active = system
        total, gradient = information.copy(), gradients.sum(axis=0)
        total[6:, 6:] += by_prior
        gradient[6:] += by_prior @ (camera - mean)
        try:
            step = to_all @ -np.linalg.solve(to_all.T @ total @ to_all, to_all.T @ gradient)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        step *= min(1.0, 0.3 / max(np.abs(step[6:]).max(), 1e-12))
        cam_from_world, camera = Rigid3.exp(step[:6]) @ cam_from_world, camera + step[6:]
        if np.abs(step).max() < 1e-5:
            break
    return linearized_fit(seen, cam_from_world, camera)


def fit_camera(
    seen: CameraObservations, cam_from_world: Rigid3, camera: Vector, prior: CameraPrior
) -> JointFit | None:
    """Fit pose and all camera parameters. Radial distortion comes first, because from far away the
    other terms lead astray. None if the observations do not fix the pose."""
    wide = CameraHypothesis(False, "xy", "radial")
    fit = fit_jointly(seen, cam_from_world, camera, prior.moments(wide), wide.basis)
    if fit is None:
        return None
    wide = CameraHypothesis(False, "xy", "other")
    return fit_jointly(seen, fit.cam_from_world, fit.camera, prior.moments(wide), wide.basis)


def linearized_fit(
    seen: CameraObservations, cam_from_world: Rigid3, camera: Vector
) -> JointFit | None:
    """Return what the observations show of pose and camera, linearized at these. None if they do
    not fix the pose."""
    system = _linear_system(seen, cam_from_world, camera, None)
    if system is None:
        return None
    information, gradients, squares, active = system
    try:
        by_pose = np.linalg.solve(information[:6, :6], information[:6, :])
    except np.linalg.LinAlgError:
        return None
    gradient = gradients.sum(axis=0)
    known = information[6:, 6:] - information[6:, :6] @ by_pose[:, 6:]
    pull = known @ camera - (gradient[6:] - by_pose[:, 6:].T @ gradient[:6])
    variance = estimate_noise_scale(squares[active], 14) ** 2
    variance *= clustered_noise(information, gradients[active], seen.cells[active], slice(6, 9))
    return JointFit(cam_from_world, camera, information, pull, variance)


def _linear_system(
    seen: CameraObservations,
    cam_from_world: Rigid3,
    camera: Vector,
    active: Bool[np.ndarray, " n"] | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Bool[np.ndarray, " n"]] | None:
    """Return Gauss-Newton's information (14, 14), the gradient of each observation (n, 14), the
    squared lengths of the residuals, and the active observations: those given, or those that agree.
    None if they are fewer than eight."""
    jacobian, weights, errors = seen.linearize(cam_from_world, camera)
    squares = np.einsum("ni,nij,nj->n", errors, weights, errors)
    is_active = active
    if is_active is None:
        is_active = np.linalg.norm(errors, axis=1) <= seen.max_error
        is_active &= (squares < (seen.max_error / seen.sigma / 3.0) ** 2) & weights.any((1, 2))
    if np.count_nonzero(is_active) < 8:
        return None
    weights = weights * (is_active / (1.0 + squares / CAUCHY_SCALE**2))[:, None, None]
    weighted = weights @ jacobian
    information = np.tensordot(weighted, jacobian, ((0, 1), (0, 1)))
    return information, (weighted * errors[:, :, None]).sum(axis=1), squares, is_active


def clustered_noise(
    information: Float[np.ndarray, "k k"],
    gradients: Float[np.ndarray, "n k"],
    cells: np.ndarray,
    of: slice,
) -> float:
    """Return the factor of the variance of some parameters (focal length and principal point, say)
    by errors that are common to parts of the image, at least 1 (see `pose_matches.py`)."""
    used, number = np.unique(cells, return_inverse=True)
    if len(used) < 8:
        return 1.0
    gradients = gradients - gradients.mean(axis=0)
    of_cells = np.zeros((len(used), len(information)))
    np.add.at(of_cells, number, gradients)
    inverse = np.linalg.inv(information + 1e-6 * np.diag(np.diag(information)))[of]
    alone = np.square(inverse @ gradients.T).sum(axis=1)
    together = np.square(inverse @ of_cells.T).sum(axis=1)
    return max(1.0, float(np.mean(together / alone)) * len(used) / (len(used) - 4.0))


def weigh_cameras(
    seen: CameraLikelihood, prior: CameraPrior
) -> dict[CameraHypothesis, tuple[float, Vector, Matrix]]:
    """Return the probability of each hypothesis, and the parameters' mean and covariance under
    it."""
    hypotheses = prior.hypotheses
    means, covariances = map(np.array, zip(*map(prior.moments, hypotheses), strict=True))
    evidence, estimates, posteriors = seen.posteriors(means, covariances)
    logs = evidence + [hypothesis.log_prior for hypothesis in hypotheses]
    shares = np.exp(logs - logs.max())
    found = zip((shares / shares.sum()).tolist(), estimates, posteriors, strict=True)
    return dict(zip(hypotheses, found, strict=True))


def weigh_poses(
    fit: JointFit,
    weighed: dict[CameraHypothesis, tuple[float, Vector, Matrix]],
    reported: tuple[CameraHypothesis, Vector],
) -> CameraBelief:
    """Return the belief for a pose that was reported with a hypothesis and camera parameters."""
    by_camera = fit.pose_by_camera
    parts = [
        WeighedCamera(
            hypothesis,
            share,
            by_camera @ (mean - reported[1]),
            by_camera @ covariance @ by_camera.T,
        )
        for hypothesis, (share, mean, covariance) in weighed.items()
    ]
    return CameraBelief(reported[0], parts)
