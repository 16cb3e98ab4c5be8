"""Recordings without a metric scale, moved and scaled to fit a trajectory in metres."""

from __future__ import annotations

from pathlib import Path

from topoloc.errors import TrajectoryError
from topoloc.geometry.alignment import align_scaled_poses
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.recording import SequenceView
from topoloc.recordings.trajectory import Trajectory


def align_to_trajectory(sequence: StereoSequence, path: Path) -> StereoSequence:
    """Return the recording in the world of a trajectory file, in metres: its own poses, moved and
    scaled to fit best.

    Raises:
        TrajectoryError: the file is malformed, fits no frame, or its positions fix no scale.
    """
    theirs = Trajectory.read(path).match_frames(sequence.t_ns, path)
    pairs = [
        (ours, other)
        for ours, other in zip(sequence.poses, theirs, strict=True)
        if ours is not None and other is not None
    ]
    if not pairs:
        raise TrajectoryError(f"{path}: no frame has a pose in it and in {sequence.name}")
    try:
        scale, world_from_model = align_scaled_poses(
            [other for _, other in pairs], [ours for ours, _ in pairs]
        )
    except TrajectoryError as error:
        raise TrajectoryError(f"{path}: {error}") from None
    poses = [
        None if p is None else world_from_model @ Rigid3(p.rotation, scale * p.translation)
        for p in sequence.poses
    ]
    return SequenceView(sequence, list(range(len(sequence))), poses)
