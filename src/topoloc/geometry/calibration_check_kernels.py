"""Implement the inner loop of `calibration_check`. Each call passes over the points once."""

import numpy as np

from topoloc.compiled import kernel


@kernel()
def calibration_equations(
    rotation, translation, free, observed, points_world, point_covariances, sigma, cauchy_scale
):
    """Return Gauss-Newton's normal equations for the pose's left perturbation (translation,
    rotation) and for `free`: the logarithm of the scale, and the offset.

    `observed` (n, 2) are coordinates on the plane z = 1, with standard deviation `sigma`. Each
    point has Cauchy's weight 1 / (1 + s / c^2) of its squared Mahalanobis length s. Returns the
    information (9, 9), the gradient (9) and the squared lengths (n).
    """
    information, gradient, squares = np.zeros((9, 9)), np.zeros(9), np.empty(len(observed))
    jacobian, by_world, spread = np.zeros((2, 9)), np.zeros((2, 3)), np.zeros((2, 2))
    scale = np.exp(free[0])
    for i in range(len(observed)):
        p = points_world[i]
        x = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + translation[0]
        y = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + translation[1]
        z = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + translation[2]
        u, v, w = x / z, y / z, 1.0 / z
        jacobian[0, 0], jacobian[0, 2] = scale * w, -scale * u * w
        jacobian[1, 1], jacobian[1, 2] = scale * w, -scale * v * w
        jacobian[0, 3], jacobian[0, 4], jacobian[0, 5] = (
            -scale * u * v,
            scale * (1.0 + u * u),
            -scale * v,
        )
        jacobian[1, 3], jacobian[1, 4], jacobian[1, 5] = (
            -scale * (1.0 + v * v),
            scale * u * v,
            scale * u,
        )
        jacobian[0, 6], jacobian[0, 7] = scale * u, 1.0
        jacobian[1, 6], jacobian[1, 8] = scale * v, 1.0
        for a in range(2):
            for k in range(3):
                by_world[a, k] = (
                    jacobian[a, 0] * rotation[0, k]
                    + jacobian[a, 1] * rotation[1, k]
                    + jacobian[a, 2] * rotation[2, k]
                )
        for a in range(2):
            for b in range(2):
                spread[a, b] = sigma**2 if a == b else 0.0
                for j in range(3):
                    for k in range(3):
                        spread[a, b] += by_world[a, j] * point_covariances[i, j, k] * by_world[b, k]
        determinant = spread[0, 0] * spread[1, 1] - spread[0, 1] * spread[1, 0]
        i00, i01, i11 = (
            spread[1, 1] / determinant,
            -spread[0, 1] / determinant,
            spread[0, 0] / determinant,
        )
        e0, e1 = scale * u + free[1] - observed[i, 0], scale * v + free[2] - observed[i, 1]
        squares[i] = e0 * e0 * i00 + 2.0 * e0 * e1 * i01 + e1 * e1 * i11
        weight = 1.0 / (1.0 + squares[i] / cauchy_scale**2)
        for a in range(9):
            p0 = weight * (jacobian[0, a] * i00 + jacobian[1, a] * i01)
            p1 = weight * (jacobian[0, a] * i01 + jacobian[1, a] * i11)
            gradient[a] += p0 * e0 + p1 * e1
            for b in range(9):
                information[a, b] += p0 * jacobian[0, b] + p1 * jacobian[1, b]
    return information, gradient, squares
