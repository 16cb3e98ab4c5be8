"""Hold matches of pixels with world points for the kernels of pose estimation. Refine a pose, and
estimate its covariance.

That covariance assumes independent errors. If a chair was moved or the depth of a wall is wrong,
the errors of all its points pull the pose in one direction. Then the summed gradient of an image
cell is larger than that of independent errors. The inflation is the ratio of two covariances of the
pose: the clustered "sandwich" and the plain one (Liang and Zeger, *Longitudinal data analysis using
generalized linear models*, 1986).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.geometry.absolute_pose_kernels import (
    normal_equations,
    run_gauss_newton,
    score_outer_products,
    squared_errors,
)
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

_COLUMNS, _ROWS = 8, 6
_MIN_CELLS = 6  # with fewer occupied cells no inflation is estimated


def cells_of(
    points_img: Float[np.ndarray, "n 2"], width: int, height: int
) -> Int[np.ndarray, " n"]:
    """Return the number of the image cell of each pixel."""
    grid = np.array([_COLUMNS, _ROWS])
    columns, rows = np.clip((points_img + 0.5) * grid / [width, height], 0, grid - 1).astype(int).T
    return rows * _COLUMNS + columns


def compute_variance_inflation(
    points_img: Float[np.ndarray, "n 2"],
    points_world: Float[np.ndarray, "n 3"],
    point_covariances: Float[np.ndarray, "n 3 3"],
    camera: Camera,
    cam_from_world: Rigid3,
    sigma_px: float | Float[np.ndarray, " n"],
) -> float:
    """Return the ratio of the pose's variance to that under independent errors of the inliers. It
    is averaged over the six directions and at least 1.

    If the inliers lie in fewer than six image cells, the ratio is 1.

    Args:
        points_img: pixels of the inliers.
        points_world: world points of the inliers (metres).
        point_covariances: covariances of these points (m^2).
        sigma_px: standard deviation of the pixels.
    """
    matches = PoseMatches.from_pixels(points_img, points_world, point_covariances, camera, sigma_px)
    used, cells = np.unique(cells_of(points_img, camera.width, camera.height), return_inverse=True)
    if len(used) < _MIN_CELLS:
        return 1.0
    information, independent, clustered = score_outer_products(
        *matches.kernel_args(cam_from_world), cells, len(used), CAUCHY_SCALE
    )
    if not (
        np.isfinite(information).all() and np.linalg.matrix_rank(information, hermitian=True) == 6
    ):
        return 1.0
    # The pose is fitted to the same matches, which makes the sums smaller.
    fit_correction = len(used) / (len(used) - 3.0)
    variance_alone, variance_together = (
        np.trace(np.linalg.solve(information, gradients)) for gradients in (independent, clustered)
    )
    if variance_alone <= 0.0:
        return 1.0
    return max(1.0, float(fit_correction * variance_together / variance_alone))


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
    """Hold the usable matches: pixels, their coordinates and covariances on the plane z = 1, and
    world points."""

    points_img: Float[np.ndarray, "n 2"]
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
        sigmas = np.asarray(sigma_px)[..., None, None]
        to_normalized = sigmas * camera.normalized_jacobian(normalized)
        return PoseMatches(
            points_img=np.ascontiguousarray(points_img, dtype=np.float64),
            normalized=normalized,
            covariances=to_normalized @ to_normalized.transpose(0, 2, 1),
            points_world=np.ascontiguousarray(points_world, dtype=np.float64),
            point_covariances=np.ascontiguousarray(covariances, dtype=np.float64),
        )

    def kernel_args(self, cam_from_world: Rigid3) -> tuple[_Array, ...]:
        """Return the arguments that all kernels share."""
        return (
            np.ascontiguousarray(cam_from_world.rotation),
            np.ascontiguousarray(cam_from_world.translation),
            self.normalized,
            self.covariances,
            self.points_world,
            self.point_covariances,
        )


def refine_pose(
    cam_from_world: Rigid3, matches: PoseMatches, active: Bool[np.ndarray, " n"]
) -> Rigid3:
    """Return the pose that fits the active matches best, starting from a nearby pose, in at most 10
    steps."""
    return Rigid3(*run_gauss_newton(*matches.kernel_args(cam_from_world), active, CAUCHY_SCALE, 10))


def is_non_collinear(points: Float[np.ndarray, "n 3"]) -> bool:
    """Return whether there are at least four points, not all on one line."""
    if len(points) < MIN_POINTS:
        return False
    centred = points - points.mean(axis=0)
    scatter = centred.T @ centred
    # Of variances a <= b <= c, trace^2 - |scatter|^2 is 2 (ab + ac + bc), between 2 bc and 6 bc.
    total = float(np.trace(scatter)) ** 2
    return total - float(np.vdot(scatter, scatter)) > 2e-9 * total


def estimate_pose_covariance(
    cam_from_world: Rigid3,
    matches: PoseMatches,
    active: Bool[np.ndarray, " n"],
    min_noise_scale: float = 1.0,
) -> Float[np.ndarray, "6 6"] | None:
    """Return the covariance of a pose that was fitted to the active matches: of the left
    perturbation (translation, rotation; m, rad). None if they do not fix the pose."""
    if np.count_nonzero(active) < MIN_POINTS or not is_non_collinear(matches.points_world[active]):
        return None
    arguments = matches.kernel_args(cam_from_world)
    scale = estimate_noise_scale(squared_errors(*arguments)[active], 6, min_noise_scale)
    information, *_ = normal_equations(*arguments, active, CAUCHY_SCALE * scale, 6)
    diagonal = np.sqrt(np.diag(information))
    if not (np.isfinite(information).all() and np.all(diagonal > 0.0)):
        return None
    scales = np.outer(diagonal, diagonal)  # makes metres and radians comparable
    if np.linalg.eigvalsh(information / scales)[0] < 1e-12:
        return None
    inverse = np.linalg.inv(information / scales) / scales
    return _ESTIMATOR_VARIANCE * scale**2 * ((inverse + inverse.T) / 2.0)


def estimate_noise_scale(
    squares: Float[np.ndarray, " n"], num_unknowns: int, least: float = 1.0
) -> float:
    """Return the factor by which the noise exceeds its assumed standard deviation, from squared
    whitened residuals of a fit of some unknowns (Huber's proposal 2, 1964).

    It is at least `least`. If few matches fit well, this is due to chance or to the fit itself.
    """
    num_free, variance = max(2 * len(squares) - num_unknowns, 1), 1.0
    for _ in range(_MAX_SCALE_STEPS):
        scaled = squares / variance
        total = float(np.sum(scaled / (1.0 + scaled / CAUCHY_SCALE**2)))
        better = max(least**2, variance * total / (_MEAN_WEIGHTED_SQUARE * num_free))
        if abs(better / variance - 1.0) <= 0.001:
            break
        variance = better
    return float(np.sqrt(variance))
