"""Relative poses between tiles, from images of one tile localized in another. Poses in joint
worlds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from msgspec import Meta, Struct

from topoloc.geometry.rigid import Rigid3, skew
from topoloc.json_data import Count, Finite, Matrix34, Matrix66

ID = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}\Z"
"""Pattern of tile ids and world names."""
TileId = Annotated[str, Meta(pattern=ID)]
_MAX_METRES = 1e8


@dataclass(frozen=True, eq=False)
class Join:
    """Hold the relative pose of two tiles.

    `first_from_second` transforms the world of the second map into that of the first. `covariance`
    is that of its left perturbation (m, rad), from the localization results. `num_agreeing` is the
    number of images of either tile that agree. `residual` is the residual in sigmas after all joins
    are adjusted together. None: the join contradicts others and is not used.
    """

    first: str
    second: str
    first_from_second: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    num_agreeing: int
    residual: float | None = 0.0

    def to_json(self) -> dict[str, Any]:
        """Return the join as a JSON object."""
        return {
            "first": self.first,
            "second": self.second,
            "first_from_second": self.first_from_second.matrix()[:3].tolist(),
            "covariance": self.covariance.tolist(),
            "num_agreeing": self.num_agreeing,
            "residual": self.residual,
        }

    def sigmas_at(self, point_second: Float[np.ndarray, "3"]) -> tuple[float, float]:
        """Return one sigma of the position (m, in the worst direction) of a point of the second
        tile in the world of the first, and one sigma of the rotation (rad)."""
        return sigmas_at(self.first_from_second.apply(point_second), self.covariance)

    @property
    def pair(self) -> tuple[str, str]:
        """Return the ids of the two tiles."""
        return self.first, self.second


@dataclass(frozen=True, eq=False)
class JointPose:
    """Hold the pose of a world in its joint world.

    The joint world has the name and coordinates of one of the joined worlds. `covariance` is that
    of the left perturbation of `joint_from_world` (m, rad).
    """

    joint: str
    joint_from_world: Rigid3
    covariance: Float[np.ndarray, "6 6"] = field(default_factory=lambda: np.zeros((6, 6)))

    def to_json(self) -> dict[str, Any]:
        """Return the pose as a JSON object."""
        pose = self.joint_from_world.matrix()[:3].tolist()
        return {
            "world": self.joint,
            "joint_from_world": pose,
            "covariance": self.covariance.tolist(),
        }


class JoinJson(Struct, frozen=True):
    """Hold the JSON of a `Join`."""

    first: TileId
    second: TileId
    first_from_second: Matrix34
    covariance: Matrix66
    num_agreeing: Count
    residual: Finite | None

    def join(self) -> Join:
        """Return the join. Raises ValueError or TrajectoryError if its matrices are invalid."""
        return Join(
            self.first,
            self.second,
            _pose(self.first_from_second),
            _covariance(self.covariance, is_definite=True),
            self.num_agreeing,
            self.residual,
        )


class JointPoseJson(Struct, frozen=True):
    """Hold the JSON of a `JointPose`."""

    world: TileId
    joint_from_world: Matrix34
    covariance: Matrix66

    def pose(self) -> JointPose:
        """Return the pose. Raises ValueError or TrajectoryError if its matrices are invalid."""
        covariance = _covariance(self.covariance, is_definite=False)
        return JointPose(self.world, _pose(self.joint_from_world), covariance)


def _pose(rows: Matrix34) -> Rigid3:
    pose = Rigid3.from_matrix(rows)
    if np.abs(pose.translation).max() > _MAX_METRES:
        raise ValueError("a pose is further away than the earth is wide")
    return pose


def _covariance(rows: Sequence[Sequence[float]], is_definite: bool) -> Float[np.ndarray, "6 6"]:
    """Return a 6x6 covariance as an exactly symmetric matrix. Raises ValueError if it is none."""
    matrix = np.array(rows)
    symmetric = 0.5 * (matrix + matrix.T)
    values = np.linalg.eigvalsh(symmetric)
    slack = 1e-9 * max(float(values[-1]), 0.0)
    if (
        np.abs(matrix).max() > _MAX_METRES**2
        or np.abs(matrix - symmetric).max() > slack
        or values[0] < -slack
        or (is_definite and values[0] <= 0.0)
    ):
        raise ValueError("the covariance of a join is no covariance")
    return symmetric


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
