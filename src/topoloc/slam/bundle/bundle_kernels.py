"""Numba kernels of bundle adjustment: normal equations with eliminated points, and point updates.

A key frame sees a point at (x, y, d), pixel and disparity, with d = bf / depth + bias. Poses are
updated by left perturbations ``exp(xi) @ cam_from_world``, xi = (translation, rotation). Cameras
are rows (fx, fy, cx, cy, bf, bias).
"""

import numpy as np

from topoloc.compiled import kernel
from topoloc.slam.bundle.block_kernels import find_block_idx

_OPTIONS = {"error_model": "numpy"}
_MIN_DEPTH = 0.02
# Squared residual of an observation whose point is behind the camera, equal to an error of 100
# sigma.
_BEHIND_CAMERA_COST = 1e4


@kernel(**_OPTIONS)
def _residual(rotation, translation, camera, point, measured, weights, residual, point_cam):
    """Compute the whitened residual (measured - predicted) and the point in the camera frame.

    Return the squared residual, negative if the point is behind the camera.
    """
    for axis in range(3):
        point_cam[axis] = (
            rotation[axis, 0] * point[0]
            + rotation[axis, 1] * point[1]
            + rotation[axis, 2] * point[2]
            + translation[axis]
        )
    if point_cam[2] < _MIN_DEPTH:
        return -1.0
    inverse = 1.0 / point_cam[2]
    residual[0] = weights[0] * (measured[0] - camera[0] * point_cam[0] * inverse - camera[2])
    residual[1] = weights[1] * (measured[1] - camera[1] * point_cam[1] * inverse - camera[3])
    residual[2] = weights[2] * (measured[2] - camera[4] * inverse - camera[5])
    return residual[0] ** 2 + residual[1] ** 2 + residual[2] ** 2


@kernel(**_OPTIONS)
def squared_residuals(
    rotations, translations, cameras, points, keyframe_idx, rows, measured, weights, squares
):
    """Compute the squared whitened residual of each observation, infinite behind the camera.

    Each observation is given by the rows of its frame and its point.
    """
    residual, point_cam = np.empty(3), np.empty(3)
    for k in range(len(keyframe_idx)):
        f, point = keyframe_idx[k], points[rows[k]]
        square = _residual(
            rotations[f], translations[f], cameras[f], point, measured[k], weights[k], residual, point_cam  # noqa: E501
        )  # fmt: skip
        squares[k] = square if square >= 0.0 else np.inf


@kernel(**_OPTIONS)
def robust_cost(squares, scale_squared):
    """Return the sum of Cauchy's loss."""
    total = 0.0
    for k in range(len(squares)):
        total += scale_squared * np.log1p(min(squares[k], _BEHIND_CAMERA_COST) / scale_squared)
    return total


@kernel(**_OPTIONS)
def _jacobians(rotation, camera, point_cam, weights, jacobian_pose, jacobian_point):
    """Compute the derivatives of the whitened prediction by the pose's xi and by the point."""
    inverse = 1.0 / point_cam[2]
    jacobian_cam = np.zeros((3, 3))
    jacobian_cam[0, 0] = weights[0] * camera[0] * inverse
    jacobian_cam[0, 2] = -weights[0] * camera[0] * point_cam[0] * inverse * inverse
    jacobian_cam[1, 1] = weights[1] * camera[1] * inverse
    jacobian_cam[1, 2] = -weights[1] * camera[1] * point_cam[1] * inverse * inverse
    jacobian_cam[2, 2] = -weights[2] * camera[4] * inverse * inverse
    for r in range(3):
        a, b, c = jacobian_cam[r, 0], jacobian_cam[r, 1], jacobian_cam[r, 2]
        jacobian_pose[r, 0], jacobian_pose[r, 1], jacobian_pose[r, 2] = a, b, c
        # d(omega x seen) = -[seen]x d(omega)
        jacobian_pose[r, 3] = -b * point_cam[2] + c * point_cam[1]
        jacobian_pose[r, 4] = a * point_cam[2] - c * point_cam[0]
        jacobian_pose[r, 5] = -a * point_cam[1] + b * point_cam[0]
        for axis in range(3):
            jacobian_point[r, axis] = (
                a * rotation[0, axis] + b * rotation[1, axis] + c * rotation[2, axis]
            )


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
def _linearize_point(
    point, rotations, translations, cameras, slots, column, keyframe_idx, measured, weights, scale_squared, damping, is_accumulating,  # noqa: E501
    pattern_starts, blocks, vector, border, corner, couplings, inverse, gradient, bias_coupling,
):  # fmt: skip
    """Linearise the observations of one point.

    If `is_accumulating`, their terms for the poses and the bias are added to the system. It fills
    `couplings` (k, 6, 3) with the poses, the `inverse` (3, 3) of the point's own block, its
    `gradient` and its `bias_coupling` (3,).
    """
    residual, point_cam = np.empty(3), np.empty(3)
    jacobian_pose, jacobian_point, block = np.empty((3, 6)), np.empty((3, 3)), np.zeros((3, 3))
    gradient[:] = 0.0
    bias_coupling[:] = 0.0
    for k in range(len(keyframe_idx)):
        f = keyframe_idx[k]
        couplings[k] = 0.0
        square = _residual(
            rotations[f], translations[f], cameras[f], point, measured[k], weights[k], residual, point_cam  # noqa: E501
        )  # fmt: skip
        if square < 0.0:
            continue
        robust = 1.0 / (1.0 + square / scale_squared)
        _jacobians(rotations[f], cameras[f], point_cam, weights[k], jacobian_pose, jacobian_point)
        for r in range(3):
            for s in range(3):
                gradient[r] += robust * jacobian_point[s, r] * residual[s]
                for q in range(3):
                    block[r, s] += robust * jacobian_point[q, r] * jacobian_point[q, s]
        slot = slots[f]
        if column >= 0:
            for r in range(3):
                bias_coupling[r] += robust * weights[k, 2] * jacobian_point[2, r]
        if slot >= 0:
            for r in range(6):
                for q in range(3):
                    for s in range(3):
                        couplings[k, r, s] += robust * jacobian_pose[q, r] * jacobian_point[q, s]
        if is_accumulating:
            _add_observation(
                slot, column, robust, weights[k, 2], residual, jacobian_pose, pattern_starts, blocks, vector, border, corner  # noqa: E501
            )  # fmt: skip
    for r in range(3):
        block[r, r] += damping * block[r, r] + 1e-9
    _invert_symmetric(block, inverse)


@kernel(**_OPTIONS)
def _add_observation(
    slot, column, robust, disparity_weight, residual, jacobian_pose, pattern_starts, blocks, vector, border, corner  # noqa: E501
):  # fmt: skip
    """Add the terms of one observation for the pose in `slot` and the bias in `column`.

    They are -1 if fixed.
    """
    if column >= 0:
        corner[column, 0] += robust * disparity_weight**2
        corner[column, 1] += robust * disparity_weight * residual[2]
    if slot < 0:
        return
    block = blocks[pattern_starts[slot]]
    for r in range(6):
        if column >= 0:
            border[column, slot, r] += robust * disparity_weight * jacobian_pose[2, r]
        for q in range(3):
            vector[slot, r] += robust * jacobian_pose[q, r] * residual[q]
            for s in range(6):
                block[r, s] += robust * jacobian_pose[q, r] * jacobian_pose[q, s]


@kernel(**_OPTIONS)
def _eliminate_point(
    slots, column, keyframe_idx, couplings, inverse, gradient, bias_coupling, pattern_starts, pattern_rows, blocks, vector, border, corner  # noqa: E501
):  # fmt: skip
    """Eliminate a point from the system by the Schur complement of its poses and bias."""
    step, product = np.zeros(3), np.empty((6, 3))
    for r in range(3):  # not `@`: Numba takes that from SciPy, which is not installed with topoloc
        for s in range(3):
            step[r] += inverse[r, s] * gradient[s]
            if column >= 0:
                corner[column, 0] -= bias_coupling[r] * inverse[r, s] * bias_coupling[s]
        if column >= 0:
            corner[column, 1] -= bias_coupling[r] * step[r]
    for k in range(len(keyframe_idx)):
        i = slots[keyframe_idx[k]]
        if i < 0:
            continue
        coupling = couplings[k]
        for r in range(6):
            for s in range(3):
                product[r, s] = (
                    coupling[r, 0] * inverse[0, s]
                    + coupling[r, 1] * inverse[1, s]
                    + coupling[r, 2] * inverse[2, s]
                )
            vector[i, r] -= (
                coupling[r, 0] * step[0] + coupling[r, 1] * step[1] + coupling[r, 2] * step[2]
            )
            if column >= 0:
                border[column, i, r] -= (
                    product[r, 0] * bias_coupling[0]
                    + product[r, 1] * bias_coupling[1]
                    + product[r, 2] * bias_coupling[2]
                )
        for other in range(len(keyframe_idx)):
            j = slots[keyframe_idx[other]]
            if j < 0 or j > i:
                continue
            block = blocks[find_block_idx(pattern_starts, pattern_rows, i, j)]
            coupled = couplings[other]
            for r in range(6):
                for s in range(6):
                    block[r, s] -= (
                        product[r, 0] * coupled[s, 0]
                        + product[r, 1] * coupled[s, 1]
                        + product[r, 2] * coupled[s, 2]
                    )


@kernel(**_OPTIONS)
def eliminate_points(
    rotations, translations, cameras, slots, columns, points, starts, keyframe_idx, measured, weights, scale_squared, damping,  # noqa: E501
    pattern_starts, pattern_rows, blocks, vector, border, corner, bias_steps, moved,
):  # fmt: skip
    """Add the observations of some points to the reduced system, with these points eliminated.

    `slots[f]` is the position of key frame f in elimination order, -1 if it is fixed. `columns[f]`
    is the index of its disparity bias, -1 if that is fixed. All key frames that see a point share
    the bias. Observations are sorted by point: those of point n are starts[n] .. starts[n + 1] - 1.

    The system consists of the pattern's `blocks` (b, 6, 6) and the right-hand side `vector` (k, 6)
    of the poses. `border` (c, k, 6) couples them with the biases. `corner` (c, 2) holds the
    information and the right-hand side of each bias.

    If `moved` is not empty, the system is not changed. `vector` then holds the steps of the poses
    and `bias_steps` those of the biases, and `moved` is filled with the points after their steps.
    """
    longest = 0
    for n in range(len(points)):
        longest = max(longest, starts[n + 1] - starts[n])
    couplings, is_updating = np.empty((longest, 6, 3)), len(moved) > 0
    inverse, gradient, bias_coupling = np.empty((3, 3)), np.empty(3), np.empty(3)
    for n in range(len(points)):
        first, last = starts[n], starts[n + 1]
        column = columns[keyframe_idx[first]] if last > first else -1
        _linearize_point(
            points[n], rotations, translations, cameras, slots, column, keyframe_idx[first:last], measured[first:last], weights[first:last],  # noqa: E501
            scale_squared, damping, not is_updating, pattern_starts, blocks, vector, border, corner, couplings, inverse, gradient, bias_coupling,  # noqa: E501
        )  # fmt: skip
        if is_updating:
            _move_point(
                slots, column, keyframe_idx[first:last], couplings, inverse, gradient, bias_coupling, vector, bias_steps, points[n], moved[n],  # noqa: E501
            )  # fmt: skip
        else:
            _eliminate_point(
                slots, column, keyframe_idx[first:last], couplings, inverse, gradient, bias_coupling, pattern_starts, pattern_rows,  # noqa: E501
                blocks, vector, border, corner,
            )  # fmt: skip


@kernel(**_OPTIONS)
def _move_point(
    slots, column, keyframe_idx, couplings, inverse, rest, bias_coupling, steps, bias_steps, point, moved  # noqa: E501
):  # fmt: skip
    """Write a point after the steps of its poses and bias to `moved`. `rest`, its gradient, is
    changed."""
    if column >= 0:
        for s in range(3):
            rest[s] -= bias_coupling[s] * bias_steps[column]
    for k in range(len(keyframe_idx)):
        slot = slots[keyframe_idx[k]]
        if slot < 0:
            continue
        for s in range(3):
            for r in range(6):
                rest[s] -= couplings[k, r, s] * steps[slot, r]
    for r in range(3):
        moved[r] = (
            point[r] + inverse[r, 0] * rest[0] + inverse[r, 1] * rest[1] + inverse[r, 2] * rest[2]
        )
