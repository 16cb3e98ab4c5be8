"""Align coordinate frames, and measure the error between poses and between trajectories: absolute
error and KITTI's drift.

A trajectory is a list of ``world_from_cam`` poses. Two trajectories of the same moments, in worlds
a and b, give ``a_from_b`` of the worlds.
"""

from __future__ import annotations

from collections.abc import Sequence, Sized
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.errors import TrajectoryError
from topoloc.geometry.rigid import Rigid3, positions_of

# A spread below this fraction of the longest one, or below a micrometre, is due to rounding: the
# points lie on one line.
_MIN_RELATIVE_SPREAD = 1e-6
_MIN_SPREAD = 1e-6
_SIGMA_TRANSLATION, _SIGMA_ROTATION = 0.05, 0.02  # m, rad
KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
SHORT_LENGTHS = (10.0, 20.0, 30.0, 40.0, 50.0)
_MIN_KITTI_LENGTH = 200.0


def align_points(points_a: Float[np.ndarray, "n 3"], points_b: Float[np.ndarray, "n 3"]) -> Rigid3:
    """Return a_from_b that minimises the squared distances between points_a and the transformed
    points_b.

    Umeyama, *Least-squares estimation of transformation parameters between two point patterns*,
    1991, with the scale fixed at 1.

    Raises:
        TrajectoryError: the numbers of points differ, there are fewer than three, all lie on one
            line, or some are not finite.
    """
    _check_lengths(points_a, points_b)
    if not (np.isfinite(points_a).all() and np.isfinite(points_b).all()):
        raise TrajectoryError("points to align hold values that are not finite")
    for points in (points_a, points_b):
        spread = np.zeros(3)
        if len(points) >= 3:
            spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
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
    """Return the scale s and a_from_b that minimise the distances between points_a and
    ``a_from_b.apply(s * points_b)`` (Umeyama, 1991).

    Raises:
        TrajectoryError: as in `align_points`.
    """
    rotation = align_points(points_a, points_b).rotation
    centre_a, centre_b = points_a.mean(axis=0), points_b.mean(axis=0)
    turned = (points_b - centre_b) @ rotation.T
    scale = float(np.sum((points_a - centre_a) * turned) / np.sum(turned**2))
    return scale, Rigid3(rotation, centre_a - scale * rotation @ centre_b)


def align_scaled_poses(
    world_a_from_cams: Sequence[Rigid3], world_b_from_cams: Sequence[Rigid3]
) -> tuple[float, Rigid3]:
    """Return the scale s and world_a_from_world_b that transform poses of a world without metric
    scale (b) into a metric world (a).

    Only positions are used (`align_similarity`). If they lie on one line, orientations determine
    the rotation (`align_poses`).

    Raises:
        TrajectoryError: the lengths differ, values are not finite, or all positions coincide and
            fix no scale.
    """
    _check_lengths(world_a_from_cams, world_b_from_cams)
    positions_a, positions_b = positions_of(world_a_from_cams), positions_of(world_b_from_cams)
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
    """Return world_a_from_world_b from the positions alone, as in the usual absolute trajectory
    error.

    Raises:
        TrajectoryError: the lengths differ, or the positions fix no rotation because the camera
            stands or moves straight. Use `align_poses` then.
    """
    _check_lengths(world_a_from_cams, world_b_from_cams)
    return align_points(positions_of(world_a_from_cams), positions_of(world_b_from_cams))


def align_poses(world_a_from_cams: Sequence[Rigid3], world_b_from_cams: Sequence[Rigid3]) -> Rigid3:
    """Return world_a_from_world_b from positions and orientations together, also for short,
    straight and standing trajectories.

    The rotation minimises squared position residuals over `_SIGMA_TRANSLATION` plus squared chordal
    distances of the orientations over `_SIGMA_ROTATION`. This is a Wahba problem in closed form.
    Positions dominate on a long path, orientations on a short one.

    Raises:
        TrajectoryError: the lengths differ, there is no pose, or values are not finite.
    """
    _check_lengths(world_a_from_cams, world_b_from_cams)
    if len(world_a_from_cams) == 0:
        raise TrajectoryError("no common pose to align the trajectories by")
    positions_a, positions_b = positions_of(world_a_from_cams), positions_of(world_b_from_cams)
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
    """Return the distance between the two translations, metres. For poses world_from_cam it is the
    distance between the camera positions."""
    return float(np.linalg.norm(a_from_b.translation - estimated_a_from_b.translation))


def rotation_error(a_from_b: Rigid3, estimated_a_from_b: Rigid3) -> float:
    """Return the angle between the two rotations, radians in [0, pi]. It is precise for small
    angles, unlike the arccosine of the trace."""
    return Rigid3(a_from_b.rotation.T @ estimated_a_from_b.rotation, np.zeros(3)).angle()


def normalized_pose_error(
    a_from_b: Rigid3, estimated_a_from_b: Rigid3, metres: float, radians: float
) -> float:
    """Return the larger of the translation error in units of `metres` and the rotation error in
    units of `radians`."""
    return max(
        translation_error(a_from_b, estimated_a_from_b) / metres,
        rotation_error(a_from_b, estimated_a_from_b) / radians,
    )


def compute_path_lengths(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the distance travelled up to each position, in the unit of the positions."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])


@dataclass(frozen=True)
class Drift:
    """Hold the mean error of relative poses: translation as a fraction of the path length (0.01 is
    1 %), rotation in radians per metre."""

    translation: float
    rotation: float


def absolute_trajectory_errors(
    true_world_from_cams: Sequence[Rigid3], world_from_cams: Sequence[Rigid3]
) -> Float[np.ndarray, " n"]:
    """Return the distance (m) of each position from the true one, after a rigid alignment of the
    trajectories.

    Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems*, IROS 2012. Their ATE is
    the root mean square of these distances. If positions alone fix no alignment (a straight path, a
    standing camera), orientations are used too.

    Raises:
        TrajectoryError: the lengths differ, there is no pose, or values are not finite.
    """
    try:
        true_from_estimated = align_trajectories(true_world_from_cams, world_from_cams)
    except TrajectoryError:
        true_from_estimated = align_poses(true_world_from_cams, world_from_cams)
    positions = true_from_estimated.apply(positions_of(world_from_cams))
    return np.linalg.norm(positions - positions_of(true_world_from_cams), axis=1)


def relative_drift(
    true_world_from_cams: Sequence[Rigid3], world_from_cams: Sequence[Rigid3]
) -> Drift | None:
    """Return the mean error over all segments of certain lengths of the true path, starting at
    every frame. Return None if no segment fits.

    Geiger et al., *Are we ready for autonomous driving?*, CVPR 2012: 100 m to 800 m. Paths below
    200 m are measured over 10 m to 50 m.

    Raises:
        TrajectoryError: the lengths differ.
    """
    _check_lengths(true_world_from_cams, world_from_cams)
    path_lengths = compute_path_lengths(positions_of(true_world_from_cams))
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
    """Return the rotation R that maximises tr(R' C)."""
    u, _, vt = np.linalg.svd(correlation)
    return u * np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def _check_lengths(a: Sized, b: Sized) -> None:
    if len(a) != len(b):
        raise TrajectoryError(f"trajectories to compare have {len(a)} and {len(b)} poses")
