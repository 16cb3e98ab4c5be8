"""Weigh camera models by the residuals of an image, and fit pose and camera together.

The principal point of a cropped image is not in its centre, lenses distort, a calibration may be of
another camera, and a camera that turns shears the image that a rolling shutter reads. Such errors
move the pose by metres, but the residuals of many points show them. Gauss-Newton estimates the pose
and eleven camera parameters together. These are the logarithm of the focal length, the principal
point, four cubic terms of distortion and one of the fifth power of the radius r:

    x' = f x (1 + a x^2 + b y^2 + e r^4) + cx,    y' = f y (1 + c x^2 + d y^2 + e r^4) + cy

and the rotation from the first to the last row. The pose is that of the middle row. A translation
during a frame is small beside the distance of the points, and is left out.

A radial lens has a = b = c = d, a panorama has not. Without e, fisheye lenses look off-centre. Each
hypothesis about the camera is a normal prior of the parameters: narrow where it assumes a value,
wide where the image decides. The evidence of a hypothesis is the density of the estimate under it.
So a parameter is only estimated if the residuals ask for it. Residuals that neighbouring points
share count as noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from topoloc.compiled import kernel
from topoloc.geometry.camera import Camera
from topoloc.geometry.joint_camera.camera_hypotheses import (
    CameraBelief,
    CameraHypothesis,
    CameraLikelihood,
    CameraPrior,
    Matrix,
    Vector,
    WeighedCamera,
    map_variance,
)
from topoloc.geometry.pose_matches import CAUCHY_SCALE, cells_of, estimate_noise_scale
from topoloc.geometry.rigid import Rigid3

_NUM_ROUNDS, _MIN_POINTS = 15, 8
INTRINSICS, TURN = slice(6, 9), slice(14, 17)
"""Columns of the focal length and the principal point, and of the rotation during a frame."""


@kernel()
def _fill_jacobian(jacobian, camera, u, v, w, row_time):
    """Write the derivatives of a projection on the plane z = 1 by the pose's left perturbation and
    the camera parameters. Return the projection. (u, v) is that of a pinhole, w the inverse
    depth."""
    scale = np.exp(camera[0])
    a, b, c, d, e = camera[3], camera[4], camera[5], camera[6], camera[7]
    uu, vv = u * u, v * v
    rr, r4 = uu + vv, (uu + vv) ** 2
    bent_u = scale * u * (1.0 + a * uu + b * vv + e * r4)
    bent_v = scale * v * (1.0 + c * uu + d * vv + e * r4)
    du_u = scale * (1.0 + 3.0 * a * uu + b * vv + e * rr * (rr + 4.0 * uu))
    du_v = scale * 2.0 * u * v * (b + 2.0 * e * rr)
    dv_u = scale * 2.0 * u * v * (c + 2.0 * e * rr)
    dv_v = scale * (1.0 + c * uu + 3.0 * d * vv + e * rr * (rr + 4.0 * vv))
    by_u = (w, 0.0, -u * w, -u * v, 1.0 + uu, -v)
    by_v = (0.0, w, -v * w, -(1.0 + vv), u * v, u)
    for k in range(6):
        jacobian[0, k] = du_u * by_u[k] + du_v * by_v[k]
        jacobian[1, k] = dv_u * by_u[k] + dv_v * by_v[k]
    jacobian[0, 6], jacobian[0, 7], jacobian[0, 9] = bent_u, 1.0, scale * u * uu
    jacobian[1, 6], jacobian[1, 8], jacobian[1, 11] = bent_v, 1.0, scale * v * uu
    jacobian[0, 10], jacobian[0, 13] = scale * u * vv, scale * u * r4
    jacobian[1, 12], jacobian[1, 13] = scale * v * vv, scale * v * r4
    for k in range(3):
        jacobian[0, 14 + k] = row_time * jacobian[0, 3 + k]
        jacobian[1, 14 + k] = row_time * jacobian[1, 3 + k]
        bent_u += jacobian[0, 14 + k] * camera[8 + k]
        bent_v += jacobian[1, 14 + k] * camera[8 + k]
    return bent_u + camera[1], bent_v + camera[2]


@kernel()
def _camera_equations(
    rotation, translation, camera, points, sigmas, points_world, covariances, row_times,
    active, max_error, cauchy_scale,
):  # fmt: skip
    """Return Gauss-Newton's information (17, 17) of pose and camera, the gradient of each
    observation (n, 17), the residuals (n, 2), their squared Mahalanobis lengths (n), and the active
    observations: those given, or those that agree if none are given. Points behind the camera are
    not active, and their residuals are infinite."""
    n = len(points)
    information, gradients, errors = np.zeros((17, 17)), np.zeros((n, 17)), np.full((n, 2), np.inf)
    squares, is_active = np.full(n, np.inf), np.zeros(n, np.bool_)
    jacobian, by_world = np.zeros((2, 17)), np.zeros((2, 3))
    for i in range(n):
        p = points_world[i]
        x = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + translation[0]
        y = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + translation[1]
        z = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + translation[2]
        if not z > 1e-6:
            continue
        u, v = _fill_jacobian(jacobian, camera, x / z, y / z, 1.0 / z, row_times[i])
        for k in range(3):
            for a in range(2):
                by_world[a, k] = 0.0
                for j in range(3):
                    by_world[a, k] += jacobian[a, j] * rotation[j, k]
        s00 = s11 = sigmas[i] ** 2
        s01 = 0.0
        for j in range(3):
            for k in range(3):
                s00 += by_world[0, j] * covariances[i, j, k] * by_world[0, k]
                s01 += by_world[0, j] * covariances[i, j, k] * by_world[1, k]
                s11 += by_world[1, j] * covariances[i, j, k] * by_world[1, k]
        determinant = s00 * s11 - s01 * s01
        i00, i01, i11 = s11 / determinant, -s01 / determinant, s00 / determinant
        e0, e1 = u - points[i, 0], v - points[i, 1]
        errors[i, 0], errors[i, 1] = e0, e1
        squares[i] = e0 * e0 * i00 + 2.0 * e0 * e1 * i01 + e1 * e1 * i11
        is_near = e0 * e0 + e1 * e1 <= max_error**2
        is_near &= squares[i] < (max_error / sigmas[i] / 3.0) ** 2
        is_active[i] = active[i] if len(active) else is_near
        if is_active[i]:
            weight = 1.0 / (1.0 + squares[i] / cauchy_scale**2)
            for a in range(17):
                p0 = weight * (jacobian[0, a] * i00 + jacobian[1, a] * i01)
                p1 = weight * (jacobian[0, a] * i01 + jacobian[1, a] * i11)
                gradients[i, a] = p0 * e0 + p1 * e1
                for b in range(17):
                    information[a, b] += p0 * jacobian[0, b] + p1 * jacobian[1, b]
    return information, gradients, errors, squares, is_active


@dataclass(frozen=True, eq=False)
class CameraObservations:
    """Hold n pixels on the plane z = 1 of a first camera (standard deviation `sigma`), and the
    world points (metres) with covariances (m^2) that they show.

    `cells` are parts of the image, within which errors may be shared. `row_times` are the times at
    which the pixels' rows are read, from -0.5 to 0.5 of a frame.
    """

    points: Float[np.ndarray, "n 2"]
    sigma: float
    points_world: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    cells: np.ndarray
    row_times: Float[np.ndarray, " n"]
    max_error: float = math.inf
    map_variance: float = 1.0

    @staticmethod
    def from_pixels(
        points_img: Float[np.ndarray, "n 2"],
        points_world: Float[np.ndarray, "n 3"],
        covariances: Float[np.ndarray, "n 3 3"],
        camera: Camera,
        sigma_px: float,
        *,
        max_error_px: float = math.inf,
        max_points: int | None = None,
        correlated_error_share: float = 0.0,
    ) -> CameraObservations:
        """Create observations of a first camera. Of more than `max_points`, some are chosen evenly:
        their noise is the smallest error."""
        count = len(points_img)
        rows = np.unique(np.linspace(0, count - 1, max_points or count).astype(int))
        points_img = points_img[rows].astype(np.float64)
        return CameraObservations(
            camera.normalized_from_img(points_img),
            sigma_px / camera.fx,
            points_world[rows],
            covariances[rows],
            cells_of(points_img, camera.width, camera.height),
            row_times(points_img, camera.height),
            max_error_px / camera.fx,
            map_variance(correlated_error_share),
        )

    def linearize(
        self, cam_from_world: Rigid3, camera: Vector, active: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Bool[np.ndarray, " n"]]:
        """Return the normal equations and residuals of a pose and camera (`_camera_equations`)."""
        return _camera_equations(
            np.ascontiguousarray(cam_from_world.rotation),
            np.ascontiguousarray(cam_from_world.translation),
            camera,
            self.points,
            np.full(len(self.points), self.sigma),
            self.points_world,
            self.covariances,
            self.row_times,
            np.empty(0, np.bool_) if active is None else active,
            self.max_error,
            CAUCHY_SCALE,
        )


def row_times(points_img: Float[np.ndarray, "n 2"], height: int) -> Float[np.ndarray, " n"]:
    """Return the time at which the row of each pixel is read, from -0.5 to 0.5 of a frame."""
    return (points_img[:, 1] + 0.5) / height - 0.5


@dataclass(frozen=True, eq=False)
class JointFit:
    """Hold a pose and a camera that fit observations together.

    Args:
        information: of the pose and the camera parameters, without the prior.
        gradients: of each of m active observations.
        squares: squared Mahalanobis lengths of their residuals.
        cells: the parts of the image that they lie in.
        errors: residuals of all n observations on the plane z = 1.
        map_variance: factor of the variance by errors that all points of the map share.
    """

    cam_from_world: Rigid3
    camera: Vector
    information: Float[np.ndarray, "17 17"]
    gradients: Float[np.ndarray, "m 17"]
    squares: Float[np.ndarray, " m"]
    cells: np.ndarray
    errors: Float[np.ndarray, "n 2"]
    map_variance: float = 1.0

    @cached_property
    def pose_by_camera(self) -> Float[np.ndarray, "6 11"]:
        """Return the shift of the pose for a change of the camera parameters."""
        return -np.linalg.solve(self.information[:6, :6], self.information[:6, 6:])

    @cached_property
    def variance(self) -> float:
        """Return the factor by which the noise exceeds the assumed one, errors shared within parts
        of the image and by all points of the map included."""
        alone = self.map_variance * estimate_noise_scale(self.squares, 14) ** 2
        own = slice(0, 14)  # but for the rotation: that of most cameras is zero
        return alone * _clustered_noise(
            self.information[own, own], self.gradients[:, own], self.cells
        )

    @cached_property
    def likelihood(self) -> CameraLikelihood:
        """Return what the observations show of the camera, whatever the pose."""
        gradient = self.gradients.sum(axis=0)
        known = self.information[6:, 6:] + self.information[6:, :6] @ self.pose_by_camera
        pull = known @ self.camera - (gradient[6:] + self.pose_by_camera.T @ gradient[:6])
        return CameraLikelihood(known / self.variance, pull / self.variance)


def estimate_intrinsics(
    fit: JointFit,
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
    """Return focal length and principal point, with the rest of the camera as it is, by one linear
    step: the parameters and their covariance under independent errors of the points."""
    # without a prior, a frontal view of a wall does not tell focal length from distance
    prior, prior_sigma = np.zeros((9, 9)), 0.3
    prior[INTRINSICS, INTRINSICS] = np.eye(3) / prior_sigma**2
    information = fit.information[:9, :9] + prior
    gradient = fit.gradients.sum(axis=0)[:9] + prior[:, INTRINSICS] @ fit.camera[:3]
    # a chi-square of two has its median at 2 ln 2
    noise = max(float(np.median(fit.squares)) / (2.0 * math.log(2.0)), 0.05)
    covariance = np.linalg.inv(information)[INTRINSICS, INTRINSICS]
    step = -np.linalg.solve(information, gradient)[INTRINSICS]
    return fit.camera[:3] + step, fit.map_variance * noise * covariance


def fit_jointly(
    seen: CameraObservations,
    cam_from_world: Rigid3,
    camera: Vector,
    prior: tuple[Vector, Matrix],
    basis: Float[np.ndarray, "11 k"],
) -> JointFit | None:
    """Fit pose and camera together, from a nearby pose and camera. Only the directions of `basis`
    are estimated. None if the observations do not fix the pose."""
    to_all = np.zeros((17, 6 + basis.shape[1]))
    to_all[:6, :6], to_all[6:, 6:] = np.eye(6), basis
    mean, by_prior = prior[0], np.linalg.inv(prior[1])
    active = None
    for number in range(_NUM_ROUNDS):
        if number % 3 == 0:
            active = None
        information, gradients, _, _, active = seen.linearize(cam_from_world, camera, active)
        if np.count_nonzero(active) < _MIN_POINTS:
            return None
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
    may_turn = any(hypothesis.is_turning for hypothesis in prior.hypotheses)
    fit = None
    for lens in ("radial", "other"):
        wide = CameraHypothesis(False, "xy", lens, may_turn)
        fit = fit_jointly(seen, cam_from_world, camera, prior.moments(wide), wide.basis)
        if fit is None:
            return None
        cam_from_world, camera = fit.cam_from_world, fit.camera
    return fit


def refit_camera(
    seen: CameraObservations, fit: JointFit, prior: CameraPrior, hypothesis: CameraHypothesis
) -> JointFit | None:
    """Return the fit under one hypothesis, from one of all parameters."""
    (expected, covariance), basis = prior.moments(hypothesis), hypothesis.basis
    _, estimate, _ = prior.weigh(fit.likelihood)[hypothesis]
    camera = basis @ np.linalg.lstsq(basis, estimate, rcond=None)[0]
    pose = Rigid3.exp(fit.pose_by_camera @ (camera - fit.camera)) @ fit.cam_from_world
    # errors of the points that the image does not show leave more to the prior
    return fit_jointly(seen, pose, camera, (expected, covariance / fit.variance), basis)


def linearized_fit(
    seen: CameraObservations, cam_from_world: Rigid3, camera: Vector
) -> JointFit | None:
    """Return what the observations show of pose and camera, linearized at these. None if they do
    not fix the pose."""
    information, gradients, errors, squares, active = seen.linearize(cam_from_world, camera)
    is_fixed = np.linalg.matrix_rank(information[:6, :6], hermitian=True) == 6
    if np.count_nonzero(active) < _MIN_POINTS or not is_fixed:
        return None
    return JointFit(
        cam_from_world, camera, information, gradients[active], squares[active],
        seen.cells[active], errors, seen.map_variance,
    )  # fmt: skip


def _clustered_noise(
    information: Float[np.ndarray, "k k"], gradients: Float[np.ndarray, "m k"], cells: np.ndarray
) -> float:
    """Return the factor of the variance of focal length and principal point by errors that are
    common to parts of the image, at least 1 (see `absolute_pose.py`)."""
    used, number = np.unique(cells, return_inverse=True)
    if len(used) < 8:
        return 1.0
    gradients = gradients - gradients.mean(axis=0)
    of_cells = np.zeros((len(used), len(information)))
    np.add.at(of_cells, number, gradients)
    inverse = np.linalg.inv(information + 1e-6 * np.diag(np.diag(information)))[INTRINSICS]
    alone = np.square(inverse @ gradients.T).sum(axis=1)
    together = np.square(inverse @ of_cells.T).sum(axis=1)
    return max(1.0, float(np.mean(together / alone)) * len(used) / (len(used) - 4.0))


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
