"""Convert poses from the conventions of other programs to topoloc's: world_from_cam, metres, camera
axes x right, y down, z forward.

Conventions are named as in `--poses`, one or several in turn:

``inverse``, ``wxyz,opengl``, ``mm``, ``scale=0.42``
``body=0.1,0,0,0,0,0,1``: body_from_cam as x, y, z, and the quaternion x, y, z, w.
``shift=0.2``: seconds by which the clock of the poses is ahead of that of the images.
``clock=1e6``: factor by which the times of the file, as read, are multiplied.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from topoloc.errors import TrajectoryError
from topoloc.geometry.rigid import Rigid3
from topoloc.node_ids import LazySequence

PoseConversion = Callable[[Rigid3], Rigid3]

_MIRROR_Y = np.diag([1.0, -1.0, 1.0])
_FORWARD_LEFT_UP = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # body_from_cam
_FORWARD_RIGHT_DOWN = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def _scale_pose(pose: Rigid3, factor: float) -> Rigid3:
    return Rigid3(pose.rotation, factor * pose.translation)


def _rotate_camera_axes(pose: Rigid3, body_from_cam: Float[np.ndarray, "3 3"]) -> Rigid3:
    return Rigid3(pose.rotation @ body_from_cam, pose.translation)


def _mirror_pose(pose: Rigid3) -> Rigid3:
    return Rigid3(_MIRROR_Y @ pose.rotation @ _MIRROR_Y, _MIRROR_Y @ pose.translation)


_PARAMETRIC_CONVENTIONS = "scale=FACTOR, body=X,Y,Z,QX,QY,QZ,QW, shift=SECONDS, clock=FACTOR"
UNITS = {"mm": 0.001, "cm": 0.01, "feet": 0.3048}
"""Length of each unit in metres."""
ROTATIONS: dict[str, PoseConversion] = {
    # The value read as x is w, y is x, z is y and w is z.
    "wxyz": lambda pose: Rigid3.from_quat_wxyz(np.roll(pose.quat_wxyz(), -1), pose.translation),
    "transposed": lambda pose: Rigid3(pose.rotation.T.copy(), pose.translation),
}
DIRECTIONS: dict[str, PoseConversion] = {"inverse": lambda pose: pose.inverse()}
AXES: dict[str, PoseConversion] = {
    "opengl": lambda pose: _rotate_camera_axes(pose, np.diag([1.0, -1.0, -1.0])),
    "flu": lambda pose: _rotate_camera_axes(pose, _FORWARD_LEFT_UP),
    "frd": lambda pose: _rotate_camera_axes(pose, _FORWARD_RIGHT_DOWN),
    "unity": _mirror_pose,
    "unreal": lambda pose: _rotate_camera_axes(_mirror_pose(pose), _FORWARD_LEFT_UP),
}
CONVENTION_DESCRIPTIONS = {
    "mm": "in millimetres",
    "cm": "in centimetres",
    "feet": "in feet",
    "scale": "of another unit than the metre",
    "wxyz": "with quaternions whose w comes first",
    "transposed": "with transposed rotations",
    "inverse": "cam_from_world, the inverse of what is wanted",
    "opengl": "of camera axes x right, y up, z back (OpenGL, ARKit, nerfstudio)",
    "flu": "of axes x forward, y left, z up (a ROS body)",
    "frd": "of axes x forward, y right, z down (aviation)",
    "unity": "left-handed with x right, y up, z forward (Unity)",
    "unreal": "left-handed with x forward, y right, z up (Unreal)",
    "body": "of a body that the camera is mounted on",
    "shift": "of a clock that is not the pictures'",
}


@dataclass(frozen=True)
class PoseConventions:
    """Convert the poses and times of a file. `conventions` are undone in turn. A time of the file
    times `time_scale` is the image time plus `shift_s` (seconds)."""

    conventions: tuple[str, ...] = ()
    time_scale: float = 1.0
    shift_s: float = 0.0

    def undo_conventions(self, pose: Rigid3) -> Rigid3:
        """Return the pose in topoloc's convention. Raises TrajectoryError if one of `conventions`
        is unknown."""
        for convention in self.conventions:
            pose = find_conversion(convention)(pose)
        return pose

    @staticmethod
    def parse(text: str | None) -> PoseConventions:
        """Parse a text such as ``wxyz,body=1,2,3,0,0,0,1,shift=0.2``. A part that begins with a
        number belongs to the part before it.

        Raises:
            TrajectoryError: a convention is unknown, or numbers are missing.
        """
        parts: list[str] = []
        for part in (text or "").split(","):
            part = part.strip()
            if parts and "=" in parts[-1] and part[:1] in set("+-.0123456789"):
                parts[-1] += "," + part
            elif part:
                parts.append(part)
        factors = {"clock": 1.0, "shift": 0.0}
        conventions = []
        for part in parts:
            name, _, value = part.partition("=")
            if name in factors:
                factors[name] = _parse_numbers(name, value, 1)[0]
            else:
                find_conversion(part)
                conventions.append(part)
        if factors["clock"] <= 0.0:
            raise TrajectoryError("poses 'clock': the factor must be above 0")
        return PoseConventions(tuple(conventions), factors["clock"], factors["shift"])


def describe_conventions(conventions: Sequence[str]) -> str:
    """Return a readable description of poses with these conventions."""
    return ", ".join(
        CONVENTION_DESCRIPTIONS[convention.partition("=")[0]] for convention in conventions
    )


def find_conversion(convention: str) -> PoseConversion:
    """Return the function that undoes a convention, named as in `--poses`. Raises TrajectoryError
    if it is unknown."""
    name, _, value = convention.partition("=")
    if name == "scale":
        (factor,) = _parse_numbers(convention, value, 1)
        if factor <= 0.0:
            raise TrajectoryError(f"poses {convention!r}: the scale must be above 0")
        return lambda pose: _scale_pose(pose, factor)
    if name == "body":
        body_from_cam = pose_from_quaternion(np.array(_parse_numbers(convention, value, 7)))
        return lambda pose: pose @ body_from_cam
    if name in UNITS and not value:
        return lambda pose: _scale_pose(pose, UNITS[name])
    found = (ROTATIONS | DIRECTIONS | AXES).get(convention)
    if found is None:
        known = ", ".join([*UNITS, *ROTATIONS, *DIRECTIONS, *AXES, _PARAMETRIC_CONVENTIONS])
        raise TrajectoryError(f"poses {convention!r}: not known; known are {known}")
    return found


def _parse_numbers(convention: str, value: str, count: int) -> list[float]:
    try:
        numbers = [float(number) for number in value.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        raise TrajectoryError(
            f"poses {convention[:80]!r}: {count} number{'s' if count > 1 else ''} are needed"
        )
    return numbers


def lazy_poses(
    rows: Float[np.ndarray, "n c"], to_pose: Callable[[Float[np.ndarray, " c"]], Rigid3]
) -> LazySequence[Rigid3]:
    """Return one pose for each row of numbers. A row is converted when it is accessed: a file may
    hold a million poses, and a recording uses few of them."""
    return LazySequence(lambda: len(rows), lambda row: to_pose(rows[row]))


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
) -> tuple[LazySequence[Rigid3], Bool[np.ndarray, " n"]]:
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
    return lazy_poses(matrices.reshape(-1, 12), _pose_from_matrix), is_rotation
