"""Compare both side views of an image with their predicted content at a candidate place.

Few strong features are matched first. All are matched if enough of these agree on one upright pose.

PnP on matches with one wall is ambiguous. The points are coplanar, and a plane admits a second pose
that looks nearly the same from the other slant. But people and robots carry cameras upright. Two
such cameras differ by a rotation about the vertical and a translation, which two matches determine
(Kukelova, Bujnak and Pajdla, 2010: pose of a camera with known vertical direction). The pose with
the most agreeing matches is proposed. Its tilt is estimated later.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.features.features import Matches
from topoloc.features.matching import Matcher
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.pose_fit import PointMatches
from topoloc.localization.walls.upright_pose_kernels import largest_agreement, poses_from_pairs
from topoloc.localization.walls.virtual_view_matching import Sides, VirtualViewSearch, merge_matches

_NUM_PAIRS = 1500
_MAX_YAW = math.radians(35.0)
# minimum tangent between the two key points of a pair; closer ones do not constrain the distance
_MIN_SEPARATION = 0.1
_MIN_DEPTH, _MAX_DEPTH = 0.2, 100.0  # metres: allowed depth of the points of a pair
_TOLERANCE, _TOLERANCE_SHARE = (
    0.02,
    0.015,
)  # tangents: allowance for a tilted camera, larger off the axis


@dataclass(frozen=True, eq=False)
class AgreedPose:
    """Hold the matches of both views with one place, and the upright pose that `num_agreeing` of
    them agree on."""

    matches: PointMatches
    num_agreeing: int
    cam_from_world: Rigid3


@dataclass(frozen=True, eq=False)
class Comparison:
    """Hold both views beside their predicted content at a place.

    Of the matches of the strongest features, `num_strong` agree on one upright pose. `matchers`
    match further features of each view.
    """

    walls: VirtualViewSearch
    cam_from_place: Rigid3
    sides: Sides
    matchers: list[Matcher]
    num_strong: int

    @staticmethod
    def of(walls: VirtualViewSearch, place: Rigid3) -> Comparison:
        """Match the strongest features of both views with the points predicted from a place."""
        cam_from_place, weights = place.inverse(), walls.search.weights.walls
        sides, config = walls.sides_around(cam_from_place), walls.search.config.walls.matching
        matchers = [
            Matcher(side.features.descriptors, m.descriptors, (m.points_world, m.radii), config)
            for side, m in sides
        ]
        matches = [matcher.match_first(weights.stop.num_strong) for matcher in matchers]
        agreeing = _find_agreement(sides, matches, cam_from_place)
        num_strong = 0 if agreeing is None else agreeing[0]
        return Comparison(walls, cam_from_place, sides, matchers, num_strong)

    def match_all(self) -> AgreedPose | None:
        """Match all features and return the upright pose that most matches agree on. None if too
        few do to recognise a place."""
        stop = self.walls.search.weights.walls.stop
        matches = [matcher.match_first() for matcher in self.matchers]
        agreeing = _find_agreement(self.sides, matches, self.cam_from_place)
        if agreeing is None or agreeing[0] < stop.min_agreeing:
            return None
        merged = merge_matches(self.sides, matches, self.walls.camera)
        if merged is None:
            return None
        return AgreedPose(merged, agreeing[0], agreeing[1] @ self.cam_from_place)


def _find_agreement(
    sides: Sides, matches: list[Matches], cam_from_place: Rigid3
) -> tuple[int, Rigid3] | None:
    """Return the number of matches of both views that agree on one upright pose, and that pose
    (cam_from_place)."""
    if not sides:
        return None
    seen = [side.tangents[one.query_idx] for (side, _), one in zip(sides, matches, strict=True)]
    points = [m.points_world[one.train_idx] for (_, m), one in zip(sides, matches, strict=True)]
    return estimate_upright_pose(np.concatenate(seen), cam_from_place.apply(np.concatenate(points)))


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
