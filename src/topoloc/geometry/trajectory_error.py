"""How good is a trajectory? Absolute error after alignment, and drift over sub-lengths as KITTI measures it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.errors import TrajectoryError
from topoloc.geometry.alignment import align_poses, align_trajectories
from topoloc.geometry.rigid import Rigid3

KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
SHORT_LENGTHS = (10.0, 20.0, 30.0, 40.0, 50.0)
_SHORTEST_FOR_KITTI = 200.0


@dataclass(frozen=True)
class Drift:
    """Mean error of relative poses: a share of the way (0.01 is 1 %), and radians a metre."""

    translation: float
    rotation: float


def absolute_trajectory_errors(true_world_from_cams: Sequence[Rigid3], world_from_cams: Sequence[Rigid3]) -> Float[np.ndarray, " n"]:
    """Distance (m) of each position from the true one, once the trajectory is aligned with the truth by a rigid transform.

    Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems*, IROS 2012; their ATE is the root of the mean square. Where
    positions alone fix no alignment (a straight way, a standing camera) orientations help.

    Raises:
        TrajectoryError: different lengths, no pose, or values that are not finite.
    """
    try:
        true_from_estimated = align_trajectories(true_world_from_cams, world_from_cams)
    except TrajectoryError:
        true_from_estimated = align_poses(true_world_from_cams, world_from_cams)
    positions = true_from_estimated.apply(np.array([pose.translation for pose in world_from_cams]))
    return np.linalg.norm(positions - np.array([pose.translation for pose in true_world_from_cams]), axis=1)


def relative_drift(
    true_world_from_cams: Sequence[Rigid3], world_from_cams: Sequence[Rigid3], lengths: Sequence[float] | None = None
) -> Drift | None:
    """Mean error over all pieces of these lengths (metres of the true way), from every frame on; None where no piece fits.

    Geiger et al., *Are we ready for autonomous driving?*, CVPR 2012: 100 m to 800 m. Ways below 200 m are measured over 10 m to 50 m.

    Raises:
        TrajectoryError: different lengths.
    """
    if len(true_world_from_cams) != len(world_from_cams):
        raise TrajectoryError(f"trajectories to compare have {len(true_world_from_cams)} and {len(world_from_cams)} poses")
    positions = np.array([pose.translation for pose in true_world_from_cams]).reshape(-1, 3)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    if lengths is None:
        lengths = KITTI_LENGTHS if way[-1] >= _SHORTEST_FOR_KITTI else SHORT_LENGTHS
    translations, rotations = [], []
    for length in lengths:
        for first, last in enumerate(np.searchsorted(way, way + length).tolist()):
            if last >= len(way):
                break
            true_motion = true_world_from_cams[first].inverse() @ true_world_from_cams[last]
            motion = world_from_cams[first].inverse() @ world_from_cams[last]
            error = motion.inverse() @ true_motion
            translations.append(float(np.linalg.norm(error.translation)) / length)
            rotations.append(error.angle() / length)
    return Drift(float(np.mean(translations)), float(np.mean(rotations))) if translations else None
