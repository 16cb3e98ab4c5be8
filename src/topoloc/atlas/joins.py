"""Relative poses between tiles, from images of one tile localized in another. Poses in joint
worlds."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from msgspec import Meta, Struct, field

from topoloc.geometry.rigid import Rigid3, skew
from topoloc.json_data import Count, Finite, encode_json

ID = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}\Z"
"""Pattern of tile ids and world names."""
TileId = Annotated[str, Meta(pattern=ID)]
_MAX_METRES = 1e8


class Join(Struct, frozen=True, eq=False):
    """Hold the relative pose of two tiles.

    `first_from_second` transforms the world of the second map into that of the first. `covariance`
    is that of its left perturbation (m, rad), from the localization results. `num_agreeing` is the
    number of images of either tile that agree. `residual` is the residual in sigmas after all joins
    are adjusted together. None: the join contradicts others and is not used.
    """

    first: TileId
    second: TileId
    first_from_second: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    num_agreeing: Count
    residual: Finite | None = 0.0

    def to_json(self) -> dict[str, Any]:
        """Return the join as a JSON object."""
        return encode_json(self)

    def sigmas_at(self, point_second: Float[np.ndarray, "3"]) -> tuple[float, float]:
        """Return one sigma of the position (m, in the worst direction) of a point of the second
        tile in the world of the first, and one sigma of the rotation (rad)."""
        return sigmas_at(self.first_from_second.apply(point_second), self.covariance)

    @property
    def pair(self) -> tuple[str, str]:
        """Return the ids of the two tiles."""
        return self.first, self.second


class JointPose(Struct, frozen=True, eq=False, rename={"joint": "world"}):
    """Hold the pose of a world in its joint world.

    The joint world has the name and coordinates of one of the joined worlds. `covariance` is that
    of the left perturbation of `joint_from_world` (m, rad).
    """

    joint: TileId
    joint_from_world: Rigid3
    covariance: Float[np.ndarray, "6 6"] = field(default_factory=lambda: np.zeros((6, 6)))


def sigmas_at(
    point_a: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "6 6"]
) -> tuple[float, float]:
    """Return the position sigma (metres, worst direction) and rotation sigma (radians) of a
    transform.

    Args:
        point_a: the transformed point, in metres in frame a.
        covariance: covariance of the left perturbation of ``a_from_b`` (m, rad).
    """
    moved = np.hstack([np.eye(3), -skew(point_a)])
    metres, radians = (
        np.linalg.eigvalsh(block)[-1]
        for block in (moved @ covariance @ moved.T, covariance[3:, 3:])
    )
    return float(np.sqrt(max(metres, 0.0))), float(np.sqrt(max(radians, 0.0)))


def check_join(pose: Rigid3, covariance: Float[np.ndarray, "6 6"], is_definite: bool) -> None:
    """Check a relative pose and its covariance. Raises ValueError if the covariance is none, or the
    pose is further away than the earth is wide."""
    values = np.linalg.eigvalsh(covariance)
    slack = 1e-9 * max(float(values[-1]), 0.0)
    if (
        max(np.abs(pose.translation).max(), np.abs(covariance).max() ** 0.5) > _MAX_METRES
        or np.abs(covariance - covariance.T).max() > 2.0 * slack
        or values[0] < -slack
        or (is_definite and values[0] <= 0.0)
    ):
        raise ValueError("a join whose pose or covariance is none")
