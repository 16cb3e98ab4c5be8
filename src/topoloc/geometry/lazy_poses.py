"""Create poses only when they are accessed: a file may hold a million poses, and a recording uses
few of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from jaxtyping import Bool, Float

from topoloc.geometry.rigid import Rigid3


@dataclass(frozen=True, eq=False)
class LazyPoses(Sequence[Rigid3]):
    """Hold one row of numbers per pose. `to_pose` converts a row when it is accessed."""

    rows: Float[np.ndarray, "n c"]
    to_pose: Callable[[Float[np.ndarray, " c"]], Rigid3]

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> Rigid3: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Rigid3]: ...
    def __getitem__(self, index: int | slice) -> Rigid3 | Sequence[Rigid3]:
        return (
            LazyPoses(self.rows[index], self.to_pose)
            if isinstance(index, slice)
            else self.to_pose(self.rows[index])
        )


def pose_from_quaternion(row: Float[np.ndarray, "7"]) -> Rigid3:
    """Return the pose of a row: position (metres) and quaternion (x, y, z, w) of any length above
    zero. Raises TrajectoryError if the quaternion is zero or a value is not finite."""
    return Rigid3.from_quat_wxyz(row[[6, 3, 4, 5]], row[:3])


def _pose_from_matrix(row: Float[np.ndarray, "12"]) -> Rigid3:
    """Return the pose of the upper 3x4 of a matrix, row by row. Its 3x3 part must be a rotation."""
    matrix = row.reshape(3, 4)
    return Rigid3(matrix[:, :3].copy(), matrix[:, 3].copy())


def poses_from_matrices(
    numbers: Float[np.ndarray, "n 12"], tolerance: float
) -> tuple[LazyPoses, Bool[np.ndarray, " n"]]:
    """Return the poses of the upper 3x4 rows of matrices, and whether each 3x3 part is a rotation
    within the tolerance.

    Rotations are made orthonormal by Newton's iteration for the polar factor. Other 3x3 parts are
    replaced by the identity.
    """
    matrices = numbers.reshape(-1, 3, 4).copy()
    given = matrices[:, :, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        residual = np.abs(given @ given.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        is_rotation = (residual <= 2.0 * tolerance) & (np.linalg.det(given) > 0.0)
    rotations = np.where(is_rotation[:, None, None], given, np.eye(3))
    for _ in range(4):
        rotations = 0.5 * rotations @ (3.0 * np.eye(3) - rotations.transpose(0, 2, 1) @ rotations)
    matrices[:, :, :3] = rotations
    return LazyPoses(matrices.reshape(-1, 12), _pose_from_matrix), is_rotation
