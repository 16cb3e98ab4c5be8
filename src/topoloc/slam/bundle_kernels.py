"""Numba kernels of bundle adjustment: normal equations with the points eliminated, and what a step changes.

A key frame sees a point at (x, y, d): pixel and disparity, d = bf / depth + bias. Poses move by left perturbations
``exp(xi) @ cam_from_world``, xi = (translation, rotation). Cameras are rows (fx, fy, cx, cy, bf, bias).
"""

from __future__ import annotations

import numpy as np

from topoloc.compiled import kernel

_OPTIONS = {"error_model": "numpy"}
_MIN_DEPTH = 0.02
# What an observation costs whose point is behind the camera: as much as one that is off by a hundred sigma.
_BEHIND = 1e4


@kernel(**_OPTIONS)
def _residual(rotation, translation, camera, point, measured, weights, residual, seen):
    """Whitened (measured - predicted), and the point in the camera's frame; returns its square, negative behind the camera."""
    for axis in range(3):
        seen[axis] = rotation[axis, 0] * point[0] + rotation[axis, 1] * point[1] + rotation[axis, 2] * point[2] + translation[axis]
    if seen[2] < _MIN_DEPTH:
        return -1.0
    inverse = 1.0 / seen[2]
    residual[0] = weights[0] * (measured[0] - camera[0] * seen[0] * inverse - camera[2])
    residual[1] = weights[1] * (measured[1] - camera[1] * seen[1] * inverse - camera[3])
    residual[2] = weights[2] * (measured[2] - camera[4] * inverse - camera[5])
    return residual[0] ** 2 + residual[1] ** 2 + residual[2] ** 2


@kernel(**_OPTIONS)
def squared_residuals(rotations, translations, cameras, points, frames, rows, measured, weights, squares):
    """Fill the squared whitened residual of each observation (frame and point rows given); infinite behind the camera."""
    residual, seen = np.empty(3), np.empty(3)
    for k in range(len(frames)):
        f = frames[k]
        square = _residual(rotations[f], translations[f], cameras[f], points[rows[k]], measured[k], weights[k], residual, seen)
        squares[k] = square if square >= 0.0 else np.inf


@kernel(**_OPTIONS)
def robust_cost(squares, scale_squared):
    """Cauchy's loss, summed."""
    total = 0.0
    for k in range(len(squares)):
        total += scale_squared * np.log1p(min(squares[k], _BEHIND) / scale_squared)
    return total


@kernel(**_OPTIONS)
def _jacobians(rotation, camera, seen, weights, by_pose, by_point):
    """Derivatives of the whitened prediction by the pose's xi and by the point."""
    inverse = 1.0 / seen[2]
    by_seen = np.zeros((3, 3))
    by_seen[0, 0] = weights[0] * camera[0] * inverse
    by_seen[0, 2] = -weights[0] * camera[0] * seen[0] * inverse * inverse
    by_seen[1, 1] = weights[1] * camera[1] * inverse
    by_seen[1, 2] = -weights[1] * camera[1] * seen[1] * inverse * inverse
    by_seen[2, 2] = -weights[2] * camera[4] * inverse * inverse
    for r in range(3):
        a, b, c = by_seen[r, 0], by_seen[r, 1], by_seen[r, 2]
        by_pose[r, 0], by_pose[r, 1], by_pose[r, 2] = a, b, c
        # d(omega x seen) = -[seen]x d(omega)
        by_pose[r, 3] = -b * seen[2] + c * seen[1]
        by_pose[r, 4] = a * seen[2] - c * seen[0]
        by_pose[r, 5] = -a * seen[1] + b * seen[0]
        for axis in range(3):
            by_point[r, axis] = a * rotation[0, axis] + b * rotation[1, axis] + c * rotation[2, axis]


@kernel(**_OPTIONS)
def _invert_symmetric(m, inverse):
    a, b, c, d, e, f = m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]
    inverse[0, 0] = d * f - e * e
    inverse[0, 1] = c * e - b * f
    inverse[0, 2] = b * e - c * d
    inverse[1, 1] = a * f - c * c
    inverse[1, 2] = b * c - a * e
    inverse[2, 2] = a * d - b * b
    determinant = a * inverse[0, 0] + b * inverse[0, 1] + c * inverse[0, 2]
    for r in range(3):
        for s in range(r, 3):
            inverse[r, s] /= determinant
            inverse[s, r] = inverse[r, s]


@kernel(**_OPTIONS)
def _subtract_point(n, first, last, column, slots, frames, couplings, inverses, bias_couplings, step, product, matrix, vector):
    """Take point n out of the system: what the poses and the bias that it ties together still know without it."""
    if column >= 0:
        for r in range(3):
            vector[column] -= bias_couplings[n, r] * step[r]
            for s in range(3):
                matrix[column, column] -= bias_couplings[n, r] * inverses[n, r, s] * bias_couplings[n, s]
    for k in range(first, last):
        i = slots[frames[k]]
        if i < 0:
            continue
        for r in range(6):
            for s in range(3):
                product[r, s] = (
                    couplings[k, r, 0] * inverses[n, 0, s] + couplings[k, r, 1] * inverses[n, 1, s] + couplings[k, r, 2] * inverses[n, 2, s]
                )
            vector[6 * i + r] -= couplings[k, r, 0] * step[0] + couplings[k, r, 1] * step[1] + couplings[k, r, 2] * step[2]
            if column >= 0:
                shared = product[r, 0] * bias_couplings[n, 0] + product[r, 1] * bias_couplings[n, 1] + product[r, 2] * bias_couplings[n, 2]
                matrix[6 * i + r, column] -= shared
                matrix[column, 6 * i + r] -= shared
        for other in range(first, last):
            j = slots[frames[other]]
            if j < 0:
                continue
            for r in range(6):
                for s in range(6):
                    matrix[6 * i + r, 6 * j + s] -= (
                        product[r, 0] * couplings[other, s, 0]
                        + product[r, 1] * couplings[other, s, 1]
                        + product[r, 2] * couplings[other, s, 2]
                    )


@kernel(**_OPTIONS)
def eliminate_points(
    rotations, translations, cameras, slots, columns, points, starts, frames, measured, weights, scale_squared, damping,
    matrix, vector, couplings, inverses, gradients, bias_couplings,
):  # fmt: skip
    """The reduced system of the free poses and biases (`matrix` (s, s) and `vector`, zero at the call), point by point.

    `slots[k]` is the place of key frame k among the free ones, -1 where it is held; `columns[k]` that of its disparity's bias
    in the system, -1 where that is held; the key frames that see a point share it. Observations are sorted by point: those
    of point n are starts[n] .. starts[n + 1] - 1. `couplings` (m, 6, 3), `inverses` (n, 3, 3), `gradients` (n, 3) and
    `bias_couplings` (n, 3) are kept for `move_points`.
    """
    residual, seen = np.empty(3), np.empty(3)
    by_pose, by_point = np.empty((3, 6)), np.empty((3, 3))
    product = np.empty((6, 3))
    block, step = np.empty((3, 3)), np.empty(3)
    for n in range(len(points)):
        first, last = starts[n], starts[n + 1]
        block[:] = 0.0
        gradients[n] = 0.0
        bias_couplings[n] = 0.0
        column = columns[frames[first]] if last > first else -1
        for k in range(first, last):
            f = frames[k]
            couplings[k] = 0.0
            square = _residual(rotations[f], translations[f], cameras[f], points[n], measured[k], weights[k], residual, seen)
            if square < 0.0:
                continue
            robust = 1.0 / (1.0 + square / scale_squared)
            _jacobians(rotations[f], cameras[f], seen, weights[k], by_pose, by_point)
            for r in range(3):
                for s in range(3):
                    gradients[n, r] += robust * by_point[s, r] * residual[s]
                    for q in range(3):
                        block[r, s] += robust * by_point[q, r] * by_point[q, s]
            slot = slots[f]
            if column >= 0:
                vector[column] += robust * weights[k, 2] * residual[2]
                matrix[column, column] += robust * weights[k, 2] ** 2
                for r in range(3):
                    bias_couplings[n, r] += robust * weights[k, 2] * by_point[2, r]
                if slot >= 0:
                    for r in range(6):
                        matrix[6 * slot + r, column] += robust * weights[k, 2] * by_pose[2, r]
                        matrix[column, 6 * slot + r] += robust * weights[k, 2] * by_pose[2, r]
            if slot < 0:
                continue
            for r in range(6):
                for q in range(3):
                    vector[6 * slot + r] += robust * by_pose[q, r] * residual[q]
                    for s in range(6):
                        matrix[6 * slot + r, 6 * slot + s] += robust * by_pose[q, r] * by_pose[q, s]
                    for s in range(3):
                        couplings[k, r, s] += robust * by_pose[q, r] * by_point[q, s]
        for r in range(3):
            block[r, r] += damping * block[r, r] + 1e-9
        _invert_symmetric(block, inverses[n])
        for r in range(3):
            step[r] = inverses[n, r, 0] * gradients[n, 0] + inverses[n, r, 1] * gradients[n, 1] + inverses[n, r, 2] * gradients[n, 2]
        _subtract_point(n, first, last, column, slots, frames, couplings, inverses, bias_couplings, step, product, matrix, vector)


@kernel(**_OPTIONS)
def move_points(slots, columns, starts, frames, couplings, bias_couplings, inverses, gradients, steps, points, moved):
    """The points after the `steps` (s,) of poses and biases, into `moved`."""
    rest = np.empty(3)
    for n in range(len(points)):
        first, last = starts[n], starts[n + 1]
        rest[:] = gradients[n]
        column = columns[frames[first]] if last > first else -1
        if column >= 0:
            for s in range(3):
                rest[s] -= bias_couplings[n, s] * steps[column]
        for k in range(first, last):
            slot = slots[frames[k]]
            if slot < 0:
                continue
            for s in range(3):
                for r in range(6):
                    rest[s] -= couplings[k, r, s] * steps[6 * slot + r]
        for r in range(3):
            moved[n, r] = points[n, r] + inverses[n, r, 0] * rest[0] + inverses[n, r, 1] * rest[1] + inverses[n, r, 2] * rest[2]
