"""First poses from walls seen from the other side: where might a picture have been taken?

PnP on matches with a wall does not say from where it was seen: the points lie in one plane, and a
plane has a second pose that looks nearly the same from the other slant. But people and robots carry
cameras upright: two cameras that saw the same walls differ by a turn about the vertical and a
shift, which two matches give (Kukelova, Bujnak and Pajdla, 2010: pose of a camera with known
vertical direction). The pose that most of the matches agree with is the first one; how level the
cameras were follows later.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.walls.upright_pose_kernels import largest_agreement

_NUM_PAIRS = 1500
_MAX_YAW = math.radians(35.0)
# tangents of angles between the two key points of a pair: nearer ones say little of the distance
_MIN_SEPARATION = 0.1
_MIN_DEPTH, _MAX_DEPTH = 0.2, 100.0  # metres of depth that the points of a pair may have
_TOLERANCE, _TOLERANCE_SHARE = (
    0.02,
    0.015,
)  # in tangents: for a camera that is not quite level, more off the axis


def estimate_upright_pose(
    seen: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "n 3"]
) -> tuple[int, Rigid3] | None:
    """How many matches agree on one upright pose, and that cam_from_upright. None with fewer than
    three matches that agree.

    Args:
        seen: where the camera sees each matched point, as tangents (x / z, y / z).
        points: the same points (metres) in the frame of a camera that is held upright as well and
            looks about the same way: poses turned by more than 35 degrees from it are not
            considered.
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
    """Turns about the vertical and shifts (cam_from_upright) that explain pairs of matches; the
    pairs are the same at every call.

    With depths d of the two points, (u, v) where they are seen and e = d1 - d2 = z' cos - x' sin
    for the turn, where ' is a difference: v1 d1 - v2 d2 = y' and u1 d1 - u2 d2 = x' cos + z' sin.
    Without d2 that is a cos + b sin + c = 0.
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
    allowed = np.abs(turns) < _MAX_YAW  # NaN is not
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
