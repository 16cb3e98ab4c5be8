"""Relative poses between tiles, from images of one tile localized in another. Poses in joint
worlds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.atlas.manifest_values import ID, count, matching, number, parse_covariance, parse_pose
from topoloc.geometry.rigid import Rigid3, skew


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

    @staticmethod
    def from_json(row: Mapping[str, Any]) -> Join:
        """Parse the output of `to_json`.

        Raises:
            ValueError, TypeError, KeyError, TrajectoryError: a value is invalid.
        """
        residual = row["residual"]
        return Join(
            first=matching(ID, row["first"], "a join's tile"),
            second=matching(ID, row["second"], "a join's tile"),
            first_from_second=parse_pose(row["first_from_second"], "first_from_second"),
            covariance=parse_covariance(row["covariance"], "a join's covariance", is_definite=True),
            num_agreeing=count(row["num_agreeing"], "num_agreeing"),
            residual=None if residual is None else number(residual, "residual"),
        )

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

    @staticmethod
    def from_json(row: Mapping[str, Any]) -> JointPose:
        """Parse the output of `to_json`.

        Raises:
            ValueError, TypeError, KeyError, TrajectoryError: a value is invalid.
        """
        return JointPose(
            joint=matching(ID, row["world"], "a joint world"),
            joint_from_world=parse_pose(row["joint_from_world"], "joint_from_world"),
            covariance=parse_covariance(
                row["covariance"], "a joint pose's covariance", is_definite=False
            ),
        )


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
