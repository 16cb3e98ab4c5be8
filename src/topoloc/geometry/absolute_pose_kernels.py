"""Implement the inner loops of `absolute_pose` and `clustered_errors`. Each call passes over the
points once, without an allocation per point."""

import numpy as np

from topoloc.compiled import kernel


@kernel()
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


@kernel()
def squared_errors(rotation, translation, normalized, covariances, points_world, point_covariances):
    """Return the squared Mahalanobis length of each match's reprojection error, infinite for points
    behind the camera."""
    squares = np.empty(len(normalized))
    for i in range(len(normalized)):
        squares[i] = _whiten_residual(
            rotation, translation, normalized, covariances, points_world, point_covariances, i
        )[8]
    return squares


@kernel()
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
    cost, squares = 0.0, 0.0
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
        cost += 0.5 * cauchy_scale**2 * np.log1p(squared / cauchy_scale**2)
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
    for a in range(num_unknowns):
        for b in range(a):
            information[a, b] = information[b, a]
    return information, gradient, cost, squares


@kernel()
def score_outer_products(
    rotation, translation, normalized, covariances, points_world, point_covariances,
    cells, num_cells, cauchy_scale,
):  # fmt: skip
    """Return the information (6, 6) of all matches, and two sums of outer products g g' of the
    gradients minus their mean. The first sum is over single matches. The second sum is over cells,
    with the gradients in each cell added first."""
    count = len(normalized)
    active = np.ones(1, np.bool_)
    information, independent, clustered = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    gradients, cell_gradients = np.zeros((count, 6)), np.zeros((num_cells, 6))
    for i in range(count):
        own, gradients[i], _, _ = normal_equations(
            rotation, translation, normalized[i : i + 1], covariances[i : i + 1],
            points_world[i : i + 1], point_covariances[i : i + 1], active, cauchy_scale, 6,
        )  # fmt: skip
        information += own
    mean = gradients.sum(axis=0) / max(count, 1)
    for i in range(count):
        for a in range(6):
            gradients[i, a] -= mean[a]
            cell_gradients[cells[i], a] += gradients[i, a]
    for a in range(6):
        for b in range(6):
            for i in range(count):
                independent[a, b] += gradients[i, a] * gradients[i, b]
            for c in range(num_cells):
                clustered[a, b] += cell_gradients[c, a] * cell_gradients[c, b]
    return information, independent, clustered


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
