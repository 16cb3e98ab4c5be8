"""How two tiles lie to each other, as pictures of one that the other knows say it; and where a
world lies among those joined with it."""

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
    """Tile `second` lies so to tile `first`: `first_from_second` brings the world of its map into
    that of the other's.

    `covariance` is that of the left perturbation (m, rad), as the pictures' answers have it;
    `num_agreeing` pictures of either tile say so. `residual` is by how many sigma all joins
    together miss it; None of one that contradicts the others and is not used.
    """

    first: str
    second: str
    first_from_second: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    num_agreeing: int
    residual: float | None = 0.0

    def to_json(self) -> dict[str, Any]:
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
        """The inverse of `to_json`. Raises ValueError, TypeError, KeyError, TrajectoryError."""
        residual = row["residual"]
        return Join(
            first=matching(ID, row["first"], "a join's tile"),
            second=matching(ID, row["second"], "a join's tile"),
            first_from_second=parse_pose(row["first_from_second"], "first_from_second"),
            covariance=parse_covariance(row["covariance"], "a join's covariance", is_definite=True),
            num_agreeing=count(row["num_agreeing"], "num_agreeing"),
            residual=None if residual is None else number(residual, "residual"),
        )

    def sigmas_at(self, point_second: Float[np.ndarray, "3"]) -> tuple[float, float]:
        """Return one sigma of the position (m, in the worst direction) of a point of the second
        tile in the world of the first, and one sigma of the rotation (rad)."""
        return sigmas_at(self.first_from_second.apply(point_second), self.covariance)

    @property
    def pair(self) -> tuple[str, str]:
        """The ids of the tiles."""
        return self.first, self.second


@dataclass(frozen=True, eq=False)
class JointPose:
    """Where a world lies in the one that it shares with others, which has the name, and the
    coordinates, of one of them.

    `covariance` is that of the left perturbation of `joint_from_world` (m, rad).
    """

    joint: str
    joint_from_world: Rigid3
    covariance: Float[np.ndarray, "6 6"] = field(default_factory=lambda: np.zeros((6, 6)))

    def to_json(self) -> dict[str, Any]:
        pose = self.joint_from_world.matrix()[:3].tolist()
        return {
            "world": self.joint,
            "joint_from_world": pose,
            "covariance": self.covariance.tolist(),
        }

    @staticmethod
    def from_json(row: Mapping[str, Any]) -> JointPose:
        """The inverse of `to_json`. Raises ValueError, TypeError, KeyError, TrajectoryError."""
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
    """One sigma of where a point (m, frame a) lies that a transform brings into a: metres, in the
    worst direction; and of its turn, radians.

    Args:
        covariance: of the left perturbation of ``a_from_b`` (m, rad).
    """
    moved = np.hstack([np.eye(3), -skew(point_a)])
    metres, radians = (
        np.linalg.eigvalsh(block)[-1]
        for block in (moved @ covariance @ moved.T, covariance[3:, 3:])
    )
    return float(np.sqrt(max(metres, 0.0))), float(np.sqrt(max(radians, 0.0)))
