"""Numba kernel of `upright_pose.py`: select the upright pose with the most agreeing matches."""

from __future__ import annotations

import numpy as np

from topoloc.compiled import kernel


@kernel()
def largest_agreement(seen, points, turns, shifts, tolerances, nearest):
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
