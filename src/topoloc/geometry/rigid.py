"""Compute with SE(3): rigid transforms between named frames.

Frames are read right to left: ``cam_from_world = cam_from_node @ node_from_world``. Equal
neighbours cancel. Tangent vectors are ``xi = (translation, rotation)``, and perturbations act on
the left: ``exp(xi) @ a_from_b`` (Sola et al., *A micro Lie theory*, 2018).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from msgspec import Struct

from topoloc.errors import TrajectoryError
from topoloc.json_data import decode_json

_SMALL_ANGLE = 1e-7
_TOLERANCE = 1e-2


def skew(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the matrix [v]x with ``skew(v) @ w == cross(v, w)``."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp_so3(omega: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of a rotation vector (radians), by Rodrigues' formula."""
    angle, k = float(np.linalg.norm(omega)), skew(omega)
    if angle < _SMALL_ANGLE:
        return np.eye(3) + k + 0.5 * k @ k
    return (
        np.eye(3) + np.sin(angle) / angle * k + 2.0 * np.sin(angle / 2.0) ** 2 / angle**2 * (k @ k)
    )


def log_so3(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Return the rotation vector (radians, norm in [0, pi]) of a rotation matrix. The quaternion
    makes it stable at 0 and at pi."""
    w, x, y, z = quat_wxyz_from_matrix(rotation)
    v = np.array([x, y, z])
    sin_half = float(np.linalg.norm(v))
    return 2.0 * v if sin_half < _SMALL_ANGLE else 2.0 * np.arctan2(sin_half, w) / sin_half * v


def quat_wxyz_from_matrix(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation matrix (Shepperd's method)."""
    (a, p, q), (r, b, s), (t, u, c) = rotation.tolist()
    rows = (  # each times the quaternion component on its diagonal
        (1.0 + a + b + c, u - s, q - t, r - p),
        (u - s, 1.0 + a - b - c, p + r, q + t),
        (q - t, p + r, 1.0 - a + b - c, s + u),
        (r - p, q + t, s + u, 1.0 - a - b + c),
    )
    quat = np.array(rows[max(range(4), key=lambda k: rows[k][k])])
    quat = quat / np.linalg.norm(quat)
    return -quat if quat[0] < 0 else quat


def matrix_from_quat_wxyz(quat_wxyz: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of a quaternion (w, x, y, z), which need not have unit length.

    Raises:
        TrajectoryError: the quaternion is not finite or zero.
    """
    norm = float(np.linalg.norm(quat_wxyz))
    if not np.isfinite(norm) or norm < 1e-6:
        raise TrajectoryError(f"not a rotation: quaternion {np.asarray(quat_wxyz).tolist()}")
    w, x, y, z = np.asarray(quat_wxyz, dtype=np.float64) / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


class Rigid3:
    """Hold a rigid transform ``a_from_b``: ``point_a = rotation @ point_b + translation``
    (metres)."""

    def __init__(
        self, rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]
    ) -> None:
        self.rotation: Final = rotation
        self.translation: Final = translation

    def __repr__(self) -> str:
        turn, t = np.degrees(log_so3(self.rotation)), self.translation
        shown = (
            ", ".join(f"{value:.4g}" for value in t),
            ", ".join(f"{value:.4g}" for value in turn),
        )
        return f"Rigid3(translation ({shown[0]}) m, rotation vector ({shown[1]}) deg)"

    @staticmethod
    def identity() -> Rigid3:
        """Return the identity."""
        return Rigid3(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: np.ndarray | Sequence[Any]) -> Rigid3:
        """Return the transform of a 3x4 or 4x4 matrix. Its rotation is made orthonormal.

        Raises:
            TrajectoryError: the shape is wrong, values are not finite, the last row of four is not
                0 0 0 1, or the 3x3 part is not a rotation within `_TOLERANCE`.
        """
        try:
            m = np.asarray(matrix, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            raise TrajectoryError("not a pose: not a 3x4 or 4x4 matrix of numbers") from None
        if m.shape not in ((3, 4), (4, 4)):
            raise TrajectoryError(f"not a pose: a matrix of shape {m.shape}, not 3x4 or 4x4")
        if not np.all(np.isfinite(m)):
            raise TrajectoryError("not a pose: NaN or infinite entries")
        if len(m) == 4 and not np.allclose(m[3], [0.0, 0.0, 0.0, 1.0], atol=1e-6):
            raise TrajectoryError("not a pose: its last row is not 0 0 0 1; is it transposed?")
        u, singular, vt = np.linalg.svd(m[:3, :3])
        if np.any(np.abs(singular - 1.0) > _TOLERANCE) or np.linalg.det(u @ vt) < 0:
            raise TrajectoryError("not a pose: its 3x3 part is no rotation")
        return Rigid3(u @ vt, m[:3, 3].copy())

    @staticmethod
    def from_quat_wxyz(quat_wxyz: np.ndarray, translation: np.ndarray) -> Rigid3:
        """Return the transform of a quaternion (w, x, y, z) and a translation in metres.

        Raises:
            TrajectoryError: values are not finite, or the quaternion is zero.
        """
        t = np.asarray(translation, dtype=np.float64)
        if t.shape != (3,) or not np.all(np.isfinite(t)):
            raise TrajectoryError(f"not a translation: {t.tolist()}")
        return Rigid3(matrix_from_quat_wxyz(np.asarray(quat_wxyz, dtype=np.float64)), t)

    def to_json(self) -> dict[str, list[float]]:
        """Return the form ``{"translation": [x, y, z], "quat_wxyz": [w, x, y, z]}``, in metres."""
        return {"translation": self.translation.tolist(), "quat_wxyz": self.quat_wxyz().tolist()}

    @staticmethod
    def from_json(data: Any, name: str = "pose") -> Rigid3:
        """Parse the form of `to_json`, from text or an object, or the rows of a 3x4 or 4x4 matrix.
        A rotation that is orthonormal within 1e-9 keeps its bits. `name` is the pose's name in
        errors.

        Raises:
            TrajectoryError: it has another form, or no unit quaternion or rotation.
        """
        if isinstance(data, list):
            rigid, rows = Rigid3.from_matrix(data), np.array(data, np.float64)[:3]
            is_exact = np.abs(rigid.rotation - rows[:, :3]).max() < 1e-9
            return Rigid3(rows[:, :3].copy(), rows[:, 3].copy()) if is_exact else rigid
        pose = decode_json(data, _PoseJson, TrajectoryError, name)
        return Rigid3.from_quat_wxyz(pose.quat_wxyz, pose.translation)

    def tolist(self) -> list[list[float]]:
        """Return the rows of the 3x4 matrix."""
        return self.matrix()[:3].tolist()

    @staticmethod
    def exp(xi: Float[np.ndarray, "6"]) -> Rigid3:
        """Return the transform of a tangent vector (translation, rotation)."""
        rho, omega = xi[:3], xi[3:]
        return Rigid3(exp_so3(omega), _left_jacobian_so3(omega) @ rho)

    def log(self) -> Float[np.ndarray, "6"]:
        """Return the tangent vector (translation, rotation) whose `exp` is this transform."""
        omega = log_so3(self.rotation)
        return np.concatenate([np.linalg.solve(_left_jacobian_so3(omega), self.translation), omega])

    def __matmul__(self, other: Rigid3) -> Rigid3:
        return Rigid3(
            self.rotation @ other.rotation, self.rotation @ other.translation + self.translation
        )

    def inverse(self) -> Rigid3:
        """Return b_from_a."""
        return Rigid3(self.rotation.T.copy(), -(self.rotation.T @ self.translation))

    def apply(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Transform points of frame b to frame a."""
        return points @ self.rotation.T + self.translation

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """Return the homogeneous 4x4 matrix."""
        rows = np.column_stack([self.rotation, self.translation])
        return np.vstack([rows, [0.0, 0.0, 0.0, 1.0]])

    def quat_wxyz(self) -> Float[np.ndarray, "4"]:
        """Return the rotation as a unit quaternion (w, x, y, z) with w >= 0."""
        return quat_wxyz_from_matrix(self.rotation)

    def adjoint(self) -> Float[np.ndarray, "6 6"]:
        """Return Ad with ``self @ exp(xi) == exp(Ad @ xi) @ self``."""
        ad = np.zeros((6, 6))
        ad[:3, :3] = ad[3:, 3:] = self.rotation
        ad[:3, 3:] = skew(self.translation) @ self.rotation
        return ad

    def transform_covariance(
        self, covariance: Float[np.ndarray, "6 6"]
    ) -> Float[np.ndarray, "6 6"]:
        """Return the covariance of the left perturbation of ``self @ b`` from that of ``b``."""
        adjoint = self.adjoint()
        return adjoint @ covariance @ adjoint.T

    def angle(self) -> float:
        """Return the rotation angle in radians, in [0, pi]."""
        return float(np.linalg.norm(log_so3(self.rotation)))

    def is_same(
        self,
        other: Rigid3,
        metres: float = 0.0,
        radians: float = 0.0,
        covariance: Float[np.ndarray, "6 6"] | None = None,
        max_square: float = 0.0,
    ) -> bool:
        """Return whether two world_from_cam are the same pose.

        They are if their translations differ by less than `metres` and their rotations by less than
        `radians`. With a covariance they also are if `squared_distance` is less than `max_square`.
        """
        shift = other.translation - self.translation
        square = float(shift @ shift)
        if square < metres**2 and (self.inverse() @ other).angle() < radians:
            return True
        if covariance is None:
            return False
        limit = max_square * float(np.trace(covariance))
        if square > limit or (self.inverse() @ other).angle() ** 2 > limit:
            return False  # the difference is longer than the largest that the covariance allows
        return self.squared_distance(other, covariance) < max_square

    def squared_distance(self, other: Rigid3, covariance: Float[np.ndarray, "6 6"]) -> float:
        """Return the squared Mahalanobis distance between two world_from_cam.

        `covariance` is the sum of those of their right perturbations (m, rad), which are the left
        ones of cam_from_world. The distance follows chi^2 with 6 degrees of freedom.
        """
        difference = (self.inverse() @ other).log()
        return float(difference @ np.linalg.solve(covariance, difference))

    def interpolate(self, other: Rigid3, fraction: float) -> Rigid3:
        """Return the pose between this one (fraction 0) and `other` (fraction 1). The position is
        linear, the rotation follows the geodesic."""
        omega = log_so3(other.rotation @ self.rotation.T)
        translation = (1.0 - fraction) * self.translation + fraction * other.translation
        return Rigid3(exp_so3(fraction * omega) @ self.rotation, translation)


class _PoseJson(Struct, frozen=True):
    translation: Float[np.ndarray, "3"]
    quat_wxyz: Float[np.ndarray, "4"]

    def __post_init__(self) -> None:
        if not abs(np.linalg.norm(self.quat_wxyz) - 1.0) < 1e-3:
            raise ValueError("quat_wxyz is not of unit length")


def positions_of(world_from_cams: Iterable[Rigid3]) -> Float[np.ndarray, "n 3"]:
    """Return the translations of poses, one row each."""
    return np.array([pose.translation for pose in world_from_cams], dtype=np.float64).reshape(-1, 3)


def standard_deviations(covariance: Float[np.ndarray, "6 6"]) -> tuple[float, float]:
    """Return the root mean square errors of position (metres) and rotation (radians) by the
    covariance of a pose."""
    return math.sqrt(np.trace(covariance[:3, :3])), math.sqrt(np.trace(covariance[3:, 3:]))


def inverse_covariance(
    a_from_b: Rigid3, covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of the left perturbation of ``b_from_a = a_from_b.inverse()`` from that
    of `a_from_b`.

    It follows from ``(exp(xi) @ a_from_b).inverse() == exp(-Ad @ xi) @ b_from_a`` with Ad the
    adjoint of b_from_a. The translation part belongs to frame b at its origin. Use
    `position_covariance` for the camera's own position.
    """
    return a_from_b.inverse().transform_covariance(covariance)


def position_covariance(
    cam_from_world: Rigid3, covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "3 3"]:
    """Return the covariance of the camera's position (m^2, world axes) from that of the left
    perturbation of `cam_from_world`.

    The position is ``-R' t``. To first order, a perturbation (rho, omega) moves it by ``-R' rho``
    alone.
    """
    return cam_from_world.rotation.T @ covariance[:3, :3] @ cam_from_world.rotation


def _left_jacobian_so3(omega: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    angle, k = float(np.linalg.norm(omega)), skew(omega)
    if angle < 1e-5:  # below this the closed form loses all digits of (angle - sin angle)
        return np.eye(3) + 0.5 * k + k @ k / 6.0
    return (
        np.eye(3)
        + 2.0 * np.sin(angle / 2.0) ** 2 / angle**2 * k
        + (angle - np.sin(angle)) / angle**3 * (k @ k)
    )
