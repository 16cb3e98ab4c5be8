"""Estimate poses from walls seen in the reverse direction.

PnP on matches with one wall is ambiguous. The points are coplanar, and a plane admits a second pose
that looks nearly the same from the other slant. But people and robots carry cameras upright. Two
such cameras differ by a rotation about the vertical and a translation, which two matches determine
(Kukelova, Bujnak and Pajdla, 2010: pose of a camera with known vertical direction). The pose with
the most agreeing matches is proposed. Its tilt is estimated later.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.walls.upright_pose_kernels import largest_agreement

_NUM_PAIRS = 1500
_MAX_YAW = math.radians(35.0)
# minimum tangent between the two key points of a pair; closer ones do not constrain the distance
_MIN_SEPARATION = 0.1
_MIN_DEPTH, _MAX_DEPTH = 0.2, 100.0  # metres: allowed depth of the points of a pair
_TOLERANCE, _TOLERANCE_SHARE = (
    0.02,
    0.015,
)  # tangents: allowance for a tilted camera, larger off the axis


def estimate_upright_pose(
    seen: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "n 3"]
) -> tuple[int, Rigid3] | None:
    """Return the number of matches that agree on one upright pose, and that cam_from_upright.

    None if fewer than three matches agree.

    Args:
        seen: position of each matched point in the camera, as tangents (x / z, y / z).
        points: the same points (metres) in the frame of another upright camera. Poses rotated by
            more than 35 degrees from it are not considered.
    """
    if len(seen) < 3:
        return None
    turns, shifts = _poses_from_pairs(seen, points)
    if len(turns) == 0:
        return None
    tolerances = _TOLERANCE + _TOLERANCE_SHARE * np.sum(seen**2, axis=1)
    best, num_agreeing = largest_agreement(seen, points, turns, shifts, tolerances, _MIN_DEPTH)
    if num_agreeing < 3:
        return None
    return num_agreeing, _upright_pose(float(turns[best]), shifts[best])


def _upright_pose(turn: float, shift: Float[np.ndarray, " 3"]) -> Rigid3:
    c, s = math.cos(turn), math.sin(turn)
    return Rigid3(np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]), shift)


def _poses_from_pairs(
    seen: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k 3"]]:
    """Compute rotations about the vertical and translations (cam_from_upright) from pairs of
    matches.

    The pairs are the same in every call.

    Let d be the depths of the two points, (u, v) their tangents, and ' a difference of the two.
    With e = d1 - d2 = z' cos - x' sin: v1 d1 - v2 d2 = y' and u1 d1 - u2 d2 = x' cos + z' sin.
    Eliminating d2 gives a cos + b sin + c = 0.
    """
    first, second = np.random.default_rng(0).integers(0, len(seen), (2, _NUM_PAIRS))
    apart = seen[first] - seen[second]
    kept = np.abs(apart).max(axis=1) > _MIN_SEPARATION
    first, second, apart = first[kept], second[kept], apart[kept]
    (u, v), (du, dv), (dx, dy, dz) = seen[first].T, apart.T, (points[first] - points[second]).T
    a, b, c = u * dz * dv - v * dz * du - dx * dv, v * dx * du - u * dx * dv - dz * dv, dy * du
    size = np.hypot(a, b)
    with np.errstate(invalid="ignore", divide="ignore"):
        middle, half = np.arctan2(b, a), np.arccos(-c / size)
    turns, rows = np.concatenate([middle + half, middle - half]), np.tile(np.arange(len(u)), 2)
    turns = np.angle(np.exp(1j * turns))
    allowed = np.abs(turns) < _MAX_YAW  # False for NaN
    turns, rows = turns[allowed], rows[allowed]
    cos, sin = np.cos(turns), np.sin(turns)
    e = cos * dz[rows] - sin * dx[rows]
    with np.errstate(invalid="ignore", divide="ignore"):
        by_rows = (dy[rows] - v[rows] * e) / dv[rows]
        by_columns = (cos * dx[rows] + sin * dz[rows] - u[rows] * e) / du[rows]
    depths = np.where(np.abs(dv[rows]) > np.abs(du[rows]), by_rows, by_columns) + e
    near = (depths > _MIN_DEPTH) & (depths < _MAX_DEPTH)
    turns, rows, cos, sin, depths = turns[near], rows[near], cos[near], sin[near], depths[near]
    x, y, z = points[first[rows]].T
    turned = np.column_stack([cos * x + sin * z, y, cos * z - sin * x])
    return turns, depths[:, None] * np.column_stack([u[rows], v[rows], np.ones(len(rows))]) - turned
