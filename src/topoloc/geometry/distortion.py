"""Distort points on the plane z = 1 with OpenCV's rational model and its fisheye model, with
Jacobians and inverses.

Coefficients are in OpenCV's order: (k1, k2, p1, p2, k3, k4, k5, k6), or (k1, k2, k3, k4) for
fisheye. Beyond some radius a radial polynomial folds back, and one pixel has two rays. The inverse
functions accept only radii before the first fold and return NaN outside.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float

_MAX_TAN = 20.0  # 87 deg off the axis: beyond it the plane z = 1 is of no use
_NUM_SAMPLES = 4000
_MAX_NEWTON_STEPS = 50
_CONVERGENCE_TOLERANCE = 1e-13


def distort_rational(
    coefficients: Float[np.ndarray, "8"], normalized: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Return distorted coordinates and their derivative (OpenCV's calib3d documentation: six
    radial, two tangential coefficients)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    x, y = normalized[:, 0], normalized[:, 1]
    xy, r2 = x * y, x * x + y * y
    denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / denominator
    slope = k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))
    slope = slope / denominator
    distorted_x = x * radial + 2 * p1 * xy + p2 * (r2 + 2 * x * x)
    distorted_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * xy
    jacobian = np.empty((len(normalized), 2, 2))
    jacobian[:, 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    jacobian[:, 1, 1] = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = 2 * xy * slope + 2 * p1 * x + 2 * p2 * y
    return np.stack([distorted_x, distorted_y], axis=1), jacobian


def distort_fisheye(
    coefficients: Float[np.ndarray, "4"], normalized: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Return distorted coordinates and their derivative (Kannala and Brandt, *A generic camera
    model*, 2006)."""
    r = np.linalg.norm(normalized, axis=1)
    theta_d, theta_d_slope = _fisheye_polynomial(coefficients, np.arctan(r))
    safe = np.maximum(r, 1e-9)
    scale = np.where(r > 1e-9, theta_d / safe, 1.0)
    scale_slope = np.where(r > 1e-9, (theta_d_slope / (1.0 + r * r) - scale) / safe, 0.0)
    unit = normalized / safe[:, None]
    along = (r * scale_slope)[:, None, None] * unit[:, :, None] * unit[:, None, :]
    return normalized * scale[:, None], scale[:, None, None] * np.eye(2) + along


def undistort_rational(
    coefficients: Float[np.ndarray, "8"], distorted: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Invert `distort_rational` by Newton's method, to machine precision. Points without a ray give
    NaN."""
    normalized = distorted.copy()
    limit = max_radius(tuple(coefficients.tolist()), is_fisheye=False)
    error = np.full(len(distorted), np.inf)
    with np.errstate(all="ignore"):
        for _ in range(_MAX_NEWTON_STEPS):
            redistorted, jacobian = distort_rational(coefficients, normalized)
            residual = distorted - redistorted
            error = np.abs(residual).max(axis=1, initial=0.0)
            if not np.any(error > _CONVERGENCE_TOLERANCE):
                break
            a, b, d = jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 1]
            determinant = a * d - b * b
            step_x = (d * residual[:, 0] - b * residual[:, 1]) / determinant
            step_y = (a * residual[:, 1] - b * residual[:, 0]) / determinant
            normalized = normalized + np.stack([step_x, step_y], axis=1)
            # A point is kept within the limit, so that one without a ray cannot move beyond the
            # fold.
            radius = np.linalg.norm(normalized, axis=1, keepdims=True)
            normalized = np.where(radius > limit, normalized * (limit / radius), normalized)
        solved = error < 1e-9
    return np.where(solved[:, None], normalized, np.nan)


def undistort_fisheye(
    coefficients: Float[np.ndarray, "4"], distorted: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Invert `distort_fisheye` by Newton's method on the angle. Points without a ray within 87 deg
    of the axis give NaN."""
    theta_d = np.linalg.norm(distorted, axis=1)
    limit = float(np.arctan(max_radius(tuple(coefficients.tolist()), is_fisheye=True)))
    theta, error = np.minimum(theta_d, limit), np.full(len(distorted), np.inf)
    with np.errstate(all="ignore"):
        for _ in range(_MAX_NEWTON_STEPS):
            value, slope = _fisheye_polynomial(coefficients, theta)
            error = np.abs(theta_d - value)
            if not np.any(error > _CONVERGENCE_TOLERANCE):
                break
            theta = np.clip(theta + (theta_d - value) / slope, 0.0, limit)
        scale = np.where(theta_d > 1e-9, np.tan(theta) / np.maximum(theta_d, 1e-9), 1.0)
        return np.where((error < 1e-9)[:, None], distorted * scale[:, None], np.nan)


@lru_cache(maxsize=256)
def max_radius(coefficients: tuple[float, ...], is_fisheye: bool) -> float:
    """Return the largest distance from the axis on the plane z = 1 up to which the distorted radius
    grows. It is at most tan(87 deg)."""
    r = np.tan(np.linspace(0.0, np.arctan(_MAX_TAN), _NUM_SAMPLES))
    k = np.array(coefficients)
    if is_fisheye:
        grows = _fisheye_polynomial(k, np.arctan(r))[1] > 0.0
    else:
        # Use the radial part alone: the tangential one is a small correction without a fold.
        radial_only = k * [1, 1, 0, 0, 1, 1, 1, 1]
        with np.errstate(all="ignore"):
            along_x = np.stack([r, np.zeros_like(r)], axis=1)
            distorted, jacobian = distort_rational(radial_only, along_x)
        grows = (jacobian[:, 0, 0] > 0.0) & (distorted[:, 0] >= 0.0)
    folds = np.flatnonzero(~grows)
    return float(r[-1] if len(folds) == 0 else r[max(int(folds[0]) - 1, 0)])


def _fisheye_polynomial(
    k: Float[np.ndarray, "4"], theta: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    t2 = theta * theta
    value = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    slope = 1.0 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
    return value, slope
