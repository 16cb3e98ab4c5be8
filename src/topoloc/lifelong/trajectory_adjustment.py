"""Adjust the whole trajectory of a single camera to its tracked points and the map's localizations.

Odometry adjusts only the latest key frames, and a pose graph uses only the steps. Neither uses the
scale information that all localizations contain together. This adjustment moves all landmarks and
key frames. The localizations constrain them with their covariances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from topoloc.geometry.alignment import compute_path_lengths
from topoloc.geometry.rigid import Rigid3, inverse_covariance
from topoloc.localization.result import Localization
from topoloc.slam.bundle_adjustment import BundleConfig, PosePrior, adjust_bundle
from topoloc.slam.keyframes import FramePose, KeyFrame
from topoloc.slam.monocular_odometry import MonocularSubmap

_NUM_NEIGHBOURS = 3


def adjust_trajectory(
    stretch: MonocularSubmap,
    world_from_cams: Sequence[Rigid3 | None],
    anchors: Mapping[int, Localization],
    points_widened: float,
    config: BundleConfig,
) -> list[Rigid3 | None]:
    """Return the adjusted world_from_cam of each frame. None stays None.

    The stretch's key frames and landmarks change, too. Afterwards they are in the map's world, in
    metres.

    Args:
        stretch: the odometry of the trajectory.
        world_from_cams: the initial poses of the frames, in the map's world and metres.
        anchors: the trusted localizations, by frame.
        points_widened: the factor by which the sigmas of tracked points are larger than in
            odometry.
        config: the settings of the bundle adjustment.
    """
    keyframes = _transform_to_map(stretch, world_from_cams)
    moved = set(map(id, keyframes))
    frames = {
        f.frame_idx: f
        for f in stretch.frames
        if id(f.keyframe) in moved and _has_pose(world_from_cams, f.frame_idx)
    }
    relative = {index: _relative_pose(frame, world_from_cams) for index, frame in frames.items()}
    for keyframe in keyframes:
        keyframe.observations.weights /= points_widened
    map_anchors = [
        _keyframe_anchor(relative[index], frame, anchors[index])
        for index, frame in frames.items()
        if index in anchors
    ]
    adjust_bundle(keyframes, [], stretch.landmarks, config, map_anchors)
    adjusted = list(world_from_cams)
    for index, frame in frames.items():
        adjusted[index] = (
            relative[index] @ frame.keyframe.cam_from_world
        ).inverse() @ frame.view_from_cam
    return adjusted


def _has_pose(world_from_cams: Sequence[Rigid3 | None], index: int) -> bool:
    return index < len(world_from_cams) and world_from_cams[index] is not None


def _relative_pose(frame: FramePose, world_from_cams: Sequence[Rigid3 | None]) -> Rigid3:
    """Return cam_from_keyframe of a frame, in metres."""
    pose = world_from_cams[frame.frame_idx]
    assert pose is not None
    return frame.view_from_cam @ pose.inverse() @ frame.keyframe.cam_from_world.inverse()


def _keyframe_anchor(
    cam_from_keyframe: Rigid3, frame: FramePose, answer: Localization
) -> PosePrior:
    """Return the pose prior on a frame's key frame that follows from the frame's localization."""
    keyframe_from_cam = cam_from_keyframe.inverse() @ frame.view_from_cam
    information = np.linalg.inv(inverse_covariance(answer.world_from_cam, answer.covariance))
    turned = keyframe_from_cam.inverse().adjoint()
    return PosePrior(
        frame.keyframe,
        keyframe_from_cam @ answer.world_from_cam.inverse(),
        turned.T @ information @ turned,
    )


def _transform_to_map(
    stretch: MonocularSubmap, world_from_cams: Sequence[Rigid3 | None]
) -> list[KeyFrame]:
    """Move the key frames with a known pose, and their landmarks, into the map's world and metres.
    Return these key frames."""
    views = {f.frame_idx: f.view_from_cam for f in stretch.frames}
    keyframes = [
        k
        for k in stretch.keyframes
        if _has_pose(world_from_cams, k.frame_idx) and k.frame_idx in views
    ]
    before = [k.cam_from_world for k in keyframes]
    after = [
        views[k.frame_idx] @ pose.inverse()
        for k in keyframes
        if (pose := world_from_cams[k.frame_idx]) is not None
    ]
    moved = np.zeros(stretch.landmarks.num, np.bool_)
    for keyframe, old, new, metres in zip(
        keyframes, before, after, _metres_per_unit(before, after), strict=True
    ):
        ids = keyframe.observations.landmark_ids[keyframe.observations.active]
        ids = ids[~moved[ids]]
        moved[ids] = True
        stretch.landmarks.positions[ids] = new.inverse().apply(
            metres * old.apply(stretch.landmarks.positions[ids])
        )
        keyframe.cam_from_world = new
    return keyframes


def _metres_per_unit(before: Sequence[Rigid3], after: Sequence[Rigid3]) -> Float[np.ndarray, " k"]:
    """Return the scale of the motion at each key frame, in metres per unit, by the path length
    between its neighbours."""
    path_lengths = [
        compute_path_lengths(
            np.array([pose.inverse().translation for pose in poses]).reshape(-1, 3)
        )
        for poses in (before, after)
    ]
    first = np.maximum(np.arange(len(before)) - _NUM_NEIGHBOURS, 0)
    last = np.minimum(np.arange(len(before)) + _NUM_NEIGHBOURS, len(before) - 1)
    odom, metres = (path_length[last] - path_length[first] for path_length in path_lengths)
    return metres / np.maximum(odom, 1e-12)
