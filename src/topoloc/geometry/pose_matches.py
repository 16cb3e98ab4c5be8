"""Hold matches of pixels with world points, and fit a pose to them: inliers, robust Gauss-Newton,
covariance. Each kernel passes over the matches once, without an allocation per match."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.compiled import kernel
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

_COLUMNS, _ROWS = 8, 6
_Array = np.ndarray
MIN_POINTS = 4
CAUCHY_SCALE = 2.3849  # 95 % efficiency on Gaussian residuals (Holland and Welsch, 1977)
_MAX_SCALE_STEPS = 30
# Effect of Cauchy's weights w on Gaussian residuals r of two dimensions, to correct the covariance
# for it: E[w r^2] / 2, and E[w] E[w^2 r^2 / 2] / E[w - w^2 r^2 / c^2]^2, the M-estimator's variance
# over the inverse of its information.
_MEAN_WEIGHTED_SQUARE = 0.6302
_ESTIMATOR_VARIANCE = 0.8265


@dataclass(frozen=True, eq=False)
class PoseMatches:
    """Hold the usable matches: standard deviations of pixels, coordinates and covariances of pixels
    on the plane z = 1, and world points."""

    sigma_px: float | Float[np.ndarray, " n"]
    normalized: Float[np.ndarray, "n 2"]
    covariances: Float[np.ndarray, "n 2 2"]
    points_world: Float[np.ndarray, "n 3"]
    point_covariances: Float[np.ndarray, "n 3 3"] | Float[np.ndarray, "0 3 3"]

    @staticmethod
    def from_pixels(
        points_img: _Array,
        points_world: _Array,
        covariances: _Array,
        camera: Camera,
        sigma_px: float | Float[np.ndarray, " n"],
        normalized: Float[np.ndarray, "n 2"] | None = None,
    ) -> PoseMatches:
        """Create matches from pixels, world points (metres) and the points' covariances (m^2).
        `sigma_px` is the standard deviation of the pixels, one for all or one for each.
        `normalized` are the pixels on the plane z = 1, if known."""
        if normalized is None:
            normalized = camera.normalized_from_img(points_img)
        a, b, c, d = camera.normalized_jacobian(normalized).reshape(-1, 4).T
        products = np.stack([a * a + b * b, a * c + b * d, a * c + b * d, c * c + d * d], axis=1)
        variances = np.square(sigma_px)[..., None]
        return PoseMatches(
            sigma_px,
            normalized=normalized,
            covariances=(variances * products).reshape(-1, 2, 2),
            points_world=np.ascontiguousarray(points_world, dtype=np.float64),
            point_covariances=np.ascontiguousarray(covariances, dtype=np.float64),
        )

    def kernel_args(self, cam_from_world: Rigid3) -> tuple[_Array, ...]:
        """Return the arguments that all kernels share."""
        pose = np.ascontiguousarray(cam_from_world.rotation), cam_from_world.translation.copy()
        points = self.points_world, self.point_covariances
        return *pose, self.normalized, self.covariances, *points

    def can_fix_pose(self) -> bool:
        """Return whether neither the points nor their pixels lie on one line."""
        usable = np.ones(len(self.normalized), np.bool_)
        return has_spread(self.points_world, usable) and has_spread(self.normalized, usable)

    def select_inliers(
        self, kernel_args: tuple[_Array, ...], max_error_px: float, max_scale: float = 1.0
    ) -> Bool[np.ndarray, " n"]:
        """Return the matches with a reprojection error of at most `max_error_px`. For uncertain
        points this limit is widened up to `max_scale` times, in proportion to the standard
        deviation that they add to `sigma_px`.

        A plain limit would truncate the errors of uncertain points, and the rest would look too
        precise. Points behind the camera are no inliers.
        """
        limits = np.square(max_error_px / np.asarray(self.sigma_px))
        of_pixels, squares = squared_errors(*kernel_args)
        if max_scale == 1.0 or len(self.point_covariances) == 0:
            return of_pixels <= limits
        return (squares <= limits) & (of_pixels <= max_scale**2 * limits)

    def fit(
        self,
        start: Rigid3,
        max_error_px: float,
        max_scale: float = 1.0,
        num_rounds: int = 2,
        min_noise_scale: float = 1.0,
    ) -> tuple[Rigid3, Bool[np.ndarray, " n"], Float[np.ndarray, "6 6"]] | None:
        """Return the pose that fits its inliers best, these inliers (`select_inliers`), and the
        pose's covariance: of the left perturbation (translation, rotation; m, rad).

        Each round uses the inliers of the one before. None if the inliers do not fix the pose.
        """
        pose, inliers = self.kernel_args(start), np.zeros(0, np.bool_)
        for number in range(num_rounds + 1):
            inliers = self.select_inliers(pose, max_error_px, max_scale)
            if not has_spread(self.points_world, inliers):
                return None
            if number < num_rounds:
                pose = (*run_gauss_newton(*pose, inliers, CAUCHY_SCALE, 10), *pose[2:])
        covariance = _estimate_covariance(pose, inliers, min_noise_scale)
        return None if covariance is None else (Rigid3(*pose[:2]), inliers, covariance)


def _estimate_covariance(
    kernel_args: tuple[_Array, ...], active: Bool[np.ndarray, " n"], min_noise_scale: float
) -> Float[np.ndarray, "6 6"] | None:
    """Return the covariance of a pose that was fitted to the active matches. None if they do not
    fix the pose."""
    scale = estimate_noise_scale(squared_errors(*kernel_args)[1][active], 6, min_noise_scale)
    information, *_ = normal_equations(*kernel_args, active, CAUCHY_SCALE * scale, 6)
    diagonal = np.sqrt(np.diag(information))
    if not (np.isfinite(information).all() and np.all(diagonal > 0.0)):
        return None
    scales = np.outer(diagonal, diagonal)  # makes metres and radians comparable
    if np.linalg.eigvalsh(information / scales)[0] < 1e-12:
        return None
    inverse = np.linalg.inv(information / scales) / scales
    return _ESTIMATOR_VARIANCE * scale**2 * ((inverse + inverse.T) / 2.0)


def cells_of(
    points_img: Float[np.ndarray, "n 2"], width: int, height: int
) -> Int[np.ndarray, " n"]:
    """Return the number of the image cell of each pixel."""
    grid = np.array([_COLUMNS, _ROWS])
    columns, rows = np.clip((points_img + 0.5) * grid / [width, height], 0, grid - 1).astype(int).T
    return rows * _COLUMNS + columns


@kernel()
def has_spread(points, active):
    """Return whether there are at least four active points, not all on one line."""
    number, size = 0, points.shape[1]
    mean, scatter = np.zeros(size), np.zeros((size, size))
    for i in range(len(points)):
        if active[i]:
            number += 1
            for a in range(size):
                mean[a] += points[i, a]
    if number < MIN_POINTS:
        return False
    mean /= number
    for i in range(len(points)):
        if active[i]:
            for a in range(size):
                for b in range(size):
                    scatter[a, b] += (points[i, a] - mean[a]) * (points[i, b] - mean[b])
    # Of variances a <= b <= c, trace^2 - |scatter|^2 is 2 (ab + ac + bc), between 2 bc and 6 bc.
    total = np.trace(scatter) ** 2
    return total - np.sum(scatter * scatter) > 2e-9 * total


@kernel(error_model="numpy")
def estimate_noise_scale(squares, num_unknowns, least=1.0):
    """Return the factor by which the noise exceeds its assumed standard deviation, from squared
    whitened residuals (n) of a fit of some unknowns (Huber's proposal 2, 1964).

    It is at least `least`. If few matches fit well, this is due to chance or to the fit itself.
    """
    num_free, variance = max(2 * len(squares) - num_unknowns, 1), 1.0
    for _ in range(_MAX_SCALE_STEPS):
        total = 0.0
        for square in squares:
            total += square / (variance + square / CAUCHY_SCALE**2)
        better = max(least**2, variance * total / (_MEAN_WEIGHTED_SQUARE * num_free))
        if abs(better / variance - 1.0) <= 0.001:
            break
        variance = better
    return np.sqrt(variance)


@kernel(error_model="numpy", inline="always")
def _whiten_residual(
    rotation, translation, normalized, covariances, points_world, point_covariances, i
):
    """Return (u, v, 1/z, e, S^-1, e' S^-1 e) of match i, with e = projected - observed on the plane
    z = 1. The last value is infinite for a point behind the camera.

    S is the pixel's covariance + D R P R' D', with the projection's derivative D and the point's
    covariance P. Without point covariances, only the first term is used. Elements are read one by
    one, because a view of each row would cost more than the arithmetic.
    """
    px, py, pz = points_world[i, 0], points_world[i, 1], points_world[i, 2]
    x = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz + translation[0]
    y = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz + translation[1]
    z = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz + translation[2]
    if not z > 1e-6:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.inf
    u, v, w = x / z, y / z, 1.0 / z
    s00, s01, s11 = covariances[i, 0, 0], covariances[i, 0, 1], covariances[i, 1, 1]
    if len(point_covariances) > 0:
        p00 = point_covariances[i, 0, 0]
        p01 = point_covariances[i, 0, 1]
        p02 = point_covariances[i, 0, 2]
        p10 = point_covariances[i, 1, 0]
        p11 = point_covariances[i, 1, 1]
        p12 = point_covariances[i, 1, 2]
        p20 = point_covariances[i, 2, 0]
        p21 = point_covariances[i, 2, 1]
        p22 = point_covariances[i, 2, 2]
        a0 = w * (rotation[0, 0] - u * rotation[2, 0])
        a1 = w * (rotation[0, 1] - u * rotation[2, 1])
        a2 = w * (rotation[0, 2] - u * rotation[2, 2])
        b0 = w * (rotation[1, 0] - v * rotation[2, 0])
        b1 = w * (rotation[1, 1] - v * rotation[2, 1])
        b2 = w * (rotation[1, 2] - v * rotation[2, 2])
        pa0, pb0 = p00 * a0 + p01 * a1 + p02 * a2, p00 * b0 + p01 * b1 + p02 * b2
        pa1, pb1 = p10 * a0 + p11 * a1 + p12 * a2, p10 * b0 + p11 * b1 + p12 * b2
        pa2, pb2 = p20 * a0 + p21 * a1 + p22 * a2, p20 * b0 + p21 * b1 + p22 * b2
        s00 += a0 * pa0 + a1 * pa1 + a2 * pa2
        s01 += a0 * pb0 + a1 * pb1 + a2 * pb2
        s11 += b0 * pb0 + b1 * pb1 + b2 * pb2
    determinant = s00 * s11 - s01 * s01
    if not determinant > 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.inf
    e0, e1 = u - normalized[i, 0], v - normalized[i, 1]
    i00, i01, i11 = s11 / determinant, -s01 / determinant, s00 / determinant
    return u, v, w, e0, e1, i00, i01, i11, e0 * e0 * i00 + 2.0 * e0 * e1 * i01 + e1 * e1 * i11


@kernel(error_model="numpy")
def squared_errors(rotation, translation, normalized, covariances, points_world, point_covariances):
    """Return the squared Mahalanobis length of each match's reprojection error, without and with
    the uncertainty of its point, infinite for points behind the camera."""
    of_pixels, squares = np.full(len(normalized), np.inf), np.empty(len(normalized))
    for i in range(len(normalized)):
        _, _, _, x, y, _, _, _, squares[i] = _whiten_residual(
            rotation, translation, normalized, covariances, points_world, point_covariances, i
        )
        if squares[i] < np.inf:
            a, b, d = covariances[i, 0, 0], covariances[i, 0, 1], covariances[i, 1, 1]
            of_pixels[i] = (d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b)
    return of_pixels, squares


@kernel(error_model="numpy")
def normal_equations(
    rotation, translation, normalized, covariances, points_world, point_covariances,
    active, cauchy_scale, num_unknowns,
):  # fmt: skip
    """Return Gauss-Newton's normal equations of the whitened reprojection errors on the plane z =
    1.

    `covariances` (n, 2, 2) are those of `normalized`. `point_covariances` is (n, 3, 3), or (0, 3,
    3) for exact points. The derivative of an error by the left perturbation (translation, rotation)
    is D [I, -[p]x]. Each match has Cauchy's weight 1 / (1 + e' S^-1 e / c^2).

    If `num_unknowns` is 7 instead of 6, the seventh unknown is the logarithm of the focal length.
    It moves the projection and not the observation. The noise is in pixels, so moving the
    observations would overestimate the focal length.

    Returns the information (k, k) and the gradient (k) of k unknowns, the Cauchy cost, and the sum
    of the weighted squared residuals.
    """
    information, gradient = np.zeros((num_unknowns, num_unknowns)), np.zeros(num_unknowns)
    cost, squares, product = 0.0, 0.0, 1.0
    jacobian = np.zeros((2, 7))
    for i in range(len(normalized)):
        if not active[i]:
            continue
        u, v, w, e0, e1, i00, i01, i11, squared = _whiten_residual(
            rotation, translation, normalized, covariances, points_world, point_covariances, i
        )
        if squared == np.inf:
            cost += 1e6  # so that a step that puts a match behind the camera is rejected
            continue
        weight = 1.0 / (1.0 + squared / cauchy_scale**2)
        product *= weight  # a logarithm of many is quicker than many logarithms
        if product < 1e-200:
            cost -= 0.5 * cauchy_scale**2 * np.log(product)
            product = 1.0
        squares += weight * squared
        # Rows of D [I, -[p]x] with p = (x, y, z), D = [[w, 0, -u w], [0, w, -v w]].
        jacobian[0, 0], jacobian[0, 1], jacobian[0, 2] = w, 0.0, -u * w
        jacobian[1, 0], jacobian[1, 1], jacobian[1, 2] = 0.0, w, -v * w
        jacobian[0, 3], jacobian[0, 4], jacobian[0, 5] = -u * v, 1.0 + u * u, -v
        jacobian[1, 3], jacobian[1, 4], jacobian[1, 5] = -(1.0 + v * v), u * v, u
        jacobian[0, 6], jacobian[1, 6] = u, v
        for a in range(num_unknowns):
            p0 = weight * (jacobian[0, a] * i00 + jacobian[1, a] * i01)
            p1 = weight * (jacobian[0, a] * i01 + jacobian[1, a] * i11)
            gradient[a] += p0 * e0 + p1 * e1
            for b in range(a, num_unknowns):
                information[a, b] += p0 * jacobian[0, b] + p1 * jacobian[1, b]
    cost -= 0.5 * cauchy_scale**2 * np.log(product)
    for a in range(num_unknowns):
        for b in range(a):
            information[a, b] = information[b, a]
    return information, gradient, cost, squares


@kernel()
def score_gradients(
    rotation, translation, normalized, covariances, points_world, point_covariances, cauchy_scale
):
    """Return the information (6, 6) of all matches, and the gradient (n, 6) of each."""
    information, gradients = np.zeros((6, 6)), np.zeros((len(normalized), 6))
    active = np.ones(1, np.bool_)
    for i in range(len(normalized)):
        own, gradients[i], _, _ = normal_equations(
            rotation, translation, normalized[i : i + 1], covariances[i : i + 1],
            points_world[i : i + 1], point_covariances[i : i + 1], active, cauchy_scale, 6,
        )  # fmt: skip
        information += own
    return information, gradients


@kernel()
def run_gauss_newton(
    rotation, translation, normalized, covariances, points_world, point_covariances,
    active, cauchy_scale, max_steps,
):  # fmt: skip
    """Run iteratively reweighted Gauss-Newton under Cauchy's loss until the cost no longer falls.
    Returns (rotation, translation)."""
    information, gradient, cost, _ = normal_equations(
        rotation, translation, normalized, covariances, points_world, point_covariances,
        active, cauchy_scale, 6,
    )  # fmt: skip
    for _ in range(max_steps):
        is_definite, step = solve_cholesky(information, -gradient)
        if not is_definite:
            break
        turn = _exp_so3(step[3:])
        new_rotation, new_translation = np.zeros((3, 3)), np.zeros(3)
        for i in range(3):
            new_translation[i] = step[i]
            for k in range(3):
                new_translation[i] += turn[i, k] * translation[k]
                for j in range(3):
                    new_rotation[i, j] += turn[i, k] * rotation[k, j]
        information, gradient, new_cost, _ = normal_equations(
            new_rotation, new_translation, normalized, covariances, points_world, point_covariances,
            active, cauchy_scale, 6,
        )  # fmt: skip
        if not new_cost <= cost:
            break
        rotation, translation = new_rotation, new_translation
        if cost - new_cost <= 1e-7 * cost:  # a hundredth of a standard deviation
            break
        cost = new_cost
    return rotation, translation


@kernel()
def solve_cholesky(matrix, right):
    """Return (True, x) with matrix @ x = right by Cholesky's decomposition, or (False, _) if the
    matrix is not positive definite."""
    n = len(right)
    lower, x = np.zeros((n, n)), np.zeros(n)
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 1e-12 * matrix[i, i]:
                    return False, x
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    for i in range(n):
        total = right[i]
        for k in range(i):
            total -= lower[i, k] * x[k]
        x[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * x[k]
        x[i] = total / lower[i, i]
    return True, x


@kernel()
def _exp_so3(omega):
    """Return the rotation matrix of a rotation vector by Rodrigues' formula."""
    x, y, z = omega[0], omega[1], omega[2]
    squared = x * x + y * y + z * z
    angle = np.sqrt(squared)
    a, b = 1.0, 0.5
    if angle > 1e-7:
        a, b = np.sin(angle) / angle, 2.0 * np.sin(0.5 * angle) ** 2 / squared
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )
