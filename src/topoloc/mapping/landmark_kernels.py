"""Numba kernel of `landmarks`: add the observations of one image to the normal equations of
points."""

import numpy as np

from topoloc.compiled import kernel


@kernel(error_model="numpy")
def add_observations(
    points,
    rows,
    normalized,
    sigmas,
    rotation,
    translation,
    cauchy_scale,
    information,
    gradient,
    squares,
):
    """Add observations of one image to `information`, `gradient` and `squares`, which have one row
    per point.

    Point `rows[m]` is observed at `normalized[m]` (plane z = 1) with standard deviation
    `sigmas[m]`. The pose of the camera is `rotation` and `translation`. A point behind the camera
    adds only to its squared residual.
    """
    jacobian = np.empty((2, 3))
    residual = np.empty(2)
    for m in range(len(rows)):
        n, sigma = rows[m], sigmas[m]
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
        if not depth > 1e-3:
            squares[n] += 1e6
            continue
        square = 0.0
        for k in range(2):
            projected = (
                rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z + translation[k]
            ) / depth
            residual[k] = projected - normalized[m, k]
            square += (residual[k] / sigma) ** 2
            for i in range(3):
                jacobian[k, i] = rotation[k, i] / depth - projected / depth * rotation[2, i]
        squares[n] += square
        weight = 1.0 / (1.0 + square / cauchy_scale**2) / sigma**2
        for i in range(3):
            a, b = weight * jacobian[0, i], weight * jacobian[1, i]
            gradient[n, i] += a * residual[0] + b * residual[1]
            for j in range(3):
                information[n, i, j] += a * jacobian[0, j] + b * jacobian[1, j]
