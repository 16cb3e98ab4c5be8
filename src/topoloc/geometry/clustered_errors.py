"""Estimate how much correlated errors of neighbouring matches inflate the variance of a pose.

PnP's covariance assumes independent errors. If a chair was moved or the depth of a wall is wrong,
the errors of all its points pull the pose in one direction. Then the summed gradient of an image
cell is larger than that of independent errors. The inflation is the ratio of two covariances of the
pose: the clustered "sandwich" and the plain one (Liang and Zeger, *Longitudinal data analysis using
generalized linear models*, 1986).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from topoloc.geometry.absolute_pose_kernels import score_outer_products
from topoloc.geometry.camera import Camera
from topoloc.geometry.pose_matches import CAUCHY_SCALE, Matches
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
    matches = Matches.from_pixels(points_img, points_world, point_covariances, camera, sigma_px)
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
