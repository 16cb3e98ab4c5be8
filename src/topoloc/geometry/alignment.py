"""Bringing two coordinate frames together; how far two poses, and two trajectories, are apart:
absolute error, and drift as KITTI has it.

A trajectory here is a list of ``world_from_cam`` poses; two of them, of the same moments in worlds
a and b, give ``a_from_b`` of the worlds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.errors import TrajectoryError
from topoloc.geometry.rigid import Rigid3

# A spread below this share of the longest one, or of a micrometre, is rounding: the points are on a
# line.
_MIN_RELATIVE_SPREAD = 1e-6
_MIN_SPREAD = 1e-6
_SIGMA_TRANSLATION, _SIGMA_ROTATION = 0.05, 0.02  # m, rad
KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
SHORT_LENGTHS = (10.0, 20.0, 30.0, 40.0, 50.0)
_MIN_KITTI_LENGTH = 200.0


def align_points(points_a: Float[np.ndarray, "n 3"], points_b: Float[np.ndarray, "n 3"]) -> Rigid3:
    """a_from_b that minimises the squared distances between points_a and the moved points_b.

    Umeyama, *Least-squares estimation of transformation parameters between two point patterns*,
    1991, with the scale held at 1.

    Raises:
        TrajectoryError: fewer than three points, all on a line, or not finite: no single rotation
            fits best.
    """
    if len(points_a) != len(points_b):
        raise TrajectoryError(
            f"point sets to align have {len(points_a)} and {len(points_b)} points"
        )
    if not (np.isfinite(points_a).all() and np.isfinite(points_b).all()):
        raise TrajectoryError("points to align hold values that are not finite")
    for points in (points_a, points_b):
        spread = (
            np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
            if len(points) >= 3
            else np.zeros(3)
        )
        if spread[1] <= max(_MIN_SPREAD, _MIN_RELATIVE_SPREAD * spread[0]):
            raise TrajectoryError(
                f"{len(points)} points on one line (or fewer than three) fix no rotation"
            )
    centre_a, centre_b = points_a.mean(axis=0), points_b.mean(axis=0)
    rotation = nearest_rotation((points_a - centre_a).T @ (points_b - centre_b))
    return Rigid3(rotation, centre_a - rotation @ centre_b)


def align_similarity(
    points_a: Float[np.ndarray, "n 3"], points_b: Float[np.ndarray, "n 3"]
) -> tuple[float, Rigid3]:
    """The scale s and a_from_b for which points_a and ``a_from_b.apply(s * points_b)`` are nearest
    (Umeyama, 1991).

    Raises:
        TrajectoryError: as `align_points`.
    """
    rotation = align_points(points_a, points_b).rotation
    centre_a, centre_b = points_a.mean(axis=0), points_b.mean(axis=0)
    turned = (points_b - centre_b) @ rotation.T
    scale = float(np.sum((points_a - centre_a) * turned) / np.sum(turned**2))
    return scale, Rigid3(rotation, centre_a - scale * rotation @ centre_b)


def align_scaled_poses(
    world_a_from_cams: Sequence[Rigid3], world_b_from_cams: Sequence[Rigid3]
) -> tuple[float, Rigid3]:
    """The scale s and world_a_from_world_b that bring poses of a world without a scale (b) into one
    of metres (a).

    By the positions alone (`align_similarity`); where these lie on one line, orientations say how
    it is turned (`align_poses`).

    Raises:
        TrajectoryError: different lengths, values that are not finite, or positions all in one
            place, which fix no scale.
    """
    _check_lengths(world_a_from_cams, world_b_from_cams)
    positions_a, positions_b = _positions(world_a_from_cams), _positions(world_b_from_cams)
    try:
        return align_similarity(positions_a, positions_b)
    except TrajectoryError:
        spreads = [
            float(np.linalg.norm(positions - positions.mean(axis=0))) if len(positions) else 0.0
            for positions in (positions_a, positions_b)
        ]
        if not min(spreads) > _MIN_SPREAD or not np.isfinite(spreads).all():
            raise TrajectoryError(
                f"{len(positions_a)} poses all in one place, or not finite, fix no scale"
            ) from None
    scale = spreads[0] / spreads[1]
    return scale, align_poses(
        world_a_from_cams,
        [Rigid3(pose.rotation, scale * pose.translation) for pose in world_b_from_cams],
    )


def align_trajectories(
    world_a_from_cams: Sequence[Rigid3], world_b_from_cams: Sequence[Rigid3]
) -> Rigid3:
    """world_a_from_world_b by the positions alone, as in the usual absolute trajectory error.

    Raises:
        TrajectoryError: different lengths, or positions that fix no rotation: a straight or
            standing camera; see `align_poses`.
    """
    _check_lengths(world_a_from_cams, world_b_from_cams)
    return align_points(_positions(world_a_from_cams), _positions(world_b_from_cams))


def align_poses(world_a_from_cams: Sequence[Rigid3], world_b_from_cams: Sequence[Rigid3]) -> Rigid3:
    """world_a_from_world_b by positions and orientations together: for short, straight and standing
    trajectories, too.

    The rotation minimises squared position residuals over `_SIGMA_TRANSLATION` plus squared chordal
    distances of the orientations over `_SIGMA_ROTATION`: one Wahba problem, in closed form. With a
    long way the positions decide, with a short one the orientations.

    Raises:
        TrajectoryError: different lengths, no pose, or values that are not finite.
    """
    _check_lengths(world_a_from_cams, world_b_from_cams)
    if len(world_a_from_cams) == 0:
        raise TrajectoryError("no common pose to align the trajectories by")
    positions_a, positions_b = _positions(world_a_from_cams), _positions(world_b_from_cams)
    centre_a, centre_b = positions_a.mean(axis=0), positions_b.mean(axis=0)
    correlation = (positions_a - centre_a).T @ (positions_b - centre_b) / _SIGMA_TRANSLATION**2
    for a, b in zip(world_a_from_cams, world_b_from_cams, strict=True):
        # A chordal distance ||R_a - R R_b||^2 is twice the squared angle, for small angles.
        correlation += a.rotation @ b.rotation.T / (2.0 * _SIGMA_ROTATION**2)
    if not np.isfinite(correlation).all():
        raise TrajectoryError("trajectories to align hold poses that are not finite")
    rotation = nearest_rotation(correlation)
    return Rigid3(rotation, centre_a - rotation @ centre_b)


def translation_error(a_from_b: Rigid3, estimated_a_from_b: Rigid3) -> float:
    """Distance of the two translations, metres: of poses world_from_cam, the distance of the
    camera's positions."""
    return float(np.linalg.norm(a_from_b.translation - estimated_a_from_b.translation))


def rotation_error(a_from_b: Rigid3, estimated_a_from_b: Rigid3) -> float:
    """Angle between the two rotations, radians in [0, pi]; precise for small angles, where the
    trace's arccosine is not."""
    return Rigid3(a_from_b.rotation.T @ estimated_a_from_b.rotation, np.zeros(3)).angle()


@dataclass(frozen=True)
class Drift:
    """Mean error of relative poses: a share of the way (0.01 is 1 %), and radians a metre."""

    translation: float
    rotation: float


def absolute_trajectory_errors(
    true_world_from_cams: Sequence[Rigid3], world_from_cams: Sequence[Rigid3]
) -> Float[np.ndarray, " n"]:
    """Distance (m) of each position from the true one, once the trajectory is aligned with the
    truth by a rigid transform.

    Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems*, IROS 2012; their ATE is
    the root of the mean square. Where positions alone fix no alignment (a straight way, a standing
    camera) orientations help.

    Raises:
        TrajectoryError: different lengths, no pose, or values that are not finite.
    """
    try:
        true_from_estimated = align_trajectories(true_world_from_cams, world_from_cams)
    except TrajectoryError:
        true_from_estimated = align_poses(true_world_from_cams, world_from_cams)
    positions = true_from_estimated.apply(np.array([pose.translation for pose in world_from_cams]))
    return np.linalg.norm(
        positions - np.array([pose.translation for pose in true_world_from_cams]), axis=1
    )


def relative_drift(
    true_world_from_cams: Sequence[Rigid3], world_from_cams: Sequence[Rigid3]
) -> Drift | None:
    """Mean error over all pieces of some lengths (of the true way), from every frame on; None where
    no piece fits.

    Geiger et al., *Are we ready for autonomous driving?*, CVPR 2012: 100 m to 800 m. Ways below 200
    m are measured over 10 m to 50 m.

    Raises:
        TrajectoryError: different lengths.
    """
    if len(true_world_from_cams) != len(world_from_cams):
        raise TrajectoryError(
            f"trajectories to compare have {len(true_world_from_cams)} and {len(world_from_cams)}"
            " poses"
        )
    positions = np.array([pose.translation for pose in true_world_from_cams]).reshape(-1, 3)
    path_lengths = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
    )
    lengths = KITTI_LENGTHS if path_lengths[-1] >= _MIN_KITTI_LENGTH else SHORT_LENGTHS
    translations, rotations = [], []
    for length in lengths:
        for first, last in enumerate(np.searchsorted(path_lengths, path_lengths + length).tolist()):
            if last >= len(path_lengths):
                break
            true_motion = true_world_from_cams[first].inverse() @ true_world_from_cams[last]
            motion = world_from_cams[first].inverse() @ world_from_cams[last]
            error = motion.inverse() @ true_motion
            translations.append(float(np.linalg.norm(error.translation)) / length)
            rotations.append(error.angle() / length)
    return Drift(float(np.mean(translations)), float(np.mean(rotations))) if translations else None


def nearest_rotation(correlation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation R of the largest tr(R' C)."""
    u, _, vt = np.linalg.svd(correlation)
    return u * np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def _positions(world_from_cams: Sequence[Rigid3]) -> Float[np.ndarray, "n 3"]:
    return np.array([pose.translation for pose in world_from_cams], dtype=np.float64).reshape(-1, 3)


def _check_lengths(
    world_a_from_cams: Sequence[Rigid3], world_b_from_cams: Sequence[Rigid3]
) -> None:
    if len(world_a_from_cams) != len(world_b_from_cams):
        raise TrajectoryError(
            f"trajectories to align have {len(world_a_from_cams)} and {len(world_b_from_cams)}"
            " poses"
        )
