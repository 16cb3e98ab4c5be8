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
from topoloc.localization.walls.upright_pose_kernels import largest_agreement, poses_from_pairs

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
    pairs = np.random.default_rng(0).integers(0, len(seen), (2, _NUM_PAIRS))
    limits = _MIN_SEPARATION, _MAX_YAW, _MIN_DEPTH, _MAX_DEPTH
    turns, shifts = poses_from_pairs(seen, points, pairs, limits)
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
