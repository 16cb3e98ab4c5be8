"""Numba kernels of `propose_virtual_views.py`: upright poses from pairs of matches, and the pose
with the most agreeing matches."""

from __future__ import annotations

import numpy as np

from topoloc.compiled import kernel


@kernel()
def largest_pose_agreement(seen, points, turns, shifts, tolerances, nearest):
    """Return the row of the pose with the most agreeing matches, and their number.

    Match k sees `points[k]` at the tangents `seen[k]`. Pose j rotates the point by `turns[j]` about
    the vertical (y) and adds `shifts[j]`. They agree within `tolerances[k]`, if the depth of the
    point is at least `nearest` metres.
    """
    best, most = 0, 0
    for j in range(len(turns)):
        cosine, sine = np.cos(turns[j]), np.sin(turns[j])
        count = 0
        for k in range(len(seen)):
            if count + len(seen) - k <= most:
                break
            x, y, z = points[k, 0], points[k, 1], points[k, 2]
            depth = cosine * z - sine * x + shifts[j, 2]
            if depth < nearest:
                continue
            miss_u = cosine * x + sine * z + shifts[j, 0] - seen[k, 0] * depth
            miss_v, limit = y + shifts[j, 1] - seen[k, 1] * depth, tolerances[k] * depth
            if miss_u * miss_u + miss_v * miss_v < limit * limit:
                count += 1
        if count > most:
            best, most = j, count
    return best, most


@kernel(error_model="numpy")
def poses_from_pairs(seen, points, pairs, limits):
    """Compute rotations about the vertical (k) and translations (k, 3), cam_from_upright, from
    pairs of matches. `pairs` (2, n) holds their rows. Each pair gives up to two poses.

    `limits` are the minimum tangent between the two key points of a pair, the maximum rotation
    (radians), and the minimum and maximum depth (metres) of the first point.

    Let d be the depths of the two points, (u, v) their tangents, and ' a difference of the two.
    With e = d1 - d2 = z' cos - x' sin: v1 d1 - v2 d2 = y' and u1 d1 - u2 d2 = x' cos + z' sin.
    Eliminating d2 gives a cos + b sin + c = 0.
    """
    min_separation, max_yaw, min_depth, max_depth = limits
    turns, shifts = np.empty(2 * pairs.shape[1]), np.empty((2 * pairs.shape[1], 3))
    count = 0
    for sign in (1.0, -1.0):
        for pair in range(pairs.shape[1]):
            i, j = pairs[0, pair], pairs[1, pair]
            u, v = seen[i, 0], seen[i, 1]
            du, dv = u - seen[j, 0], v - seen[j, 1]
            if max(abs(du), abs(dv)) <= min_separation:
                continue
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            dx, dy, dz = x - points[j, 0], y - points[j, 1], z - points[j, 2]
            a = u * dz * dv - v * dz * du - dx * dv
            b = v * dx * du - u * dx * dv - dz * dv
            half = np.arccos(-dy * du / np.hypot(a, b))  # NaN if there is no pose
            turn = np.arctan2(b, a) + sign * half
            turn = np.arctan2(np.sin(turn), np.cos(turn))
            if not abs(turn) < max_yaw:
                continue
            cosine, sine = np.cos(turn), np.sin(turn)
            e = cosine * dz - sine * dx
            if abs(dv) > abs(du):
                depth = (dy - v * e) / dv + e
            else:
                depth = (cosine * dx + sine * dz - u * e) / du + e
            if not (depth > min_depth and depth < max_depth):
                continue
            turns[count] = turn
            shifts[count, 0] = depth * u - (cosine * x + sine * z)
            shifts[count, 1] = depth * v - y
            shifts[count, 2] = depth - (cosine * z - sine * x)
            count += 1
    return turns[:count], shifts[:count]
