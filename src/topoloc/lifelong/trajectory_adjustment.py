"""Adjust the whole trajectory of a single camera to its tracked points and the map's localizations.

Odometry adjusts only the latest key frames, and a pose graph uses only the steps. Neither uses the
scale information that all localizations contain together. This adjustment moves all landmarks and
key frames. The localizations constrain them with their covariances.

`correct_trajectory` then corrects the trajectory towards the localizations.
A bundle adjustment balances a hundred localizations against thousands of tracked points. So a bent
trajectory stays bent, for example after a slightly wrong calibration or with sliding points. The
remaining difference changes slowly along the trajectory. New nodes must agree with the map's nodes
beside them, even if both share an error. So the trajectory takes over the smoothed difference of
the localizations around each position. Outliers are down-weighted. The correction decays before the
first localization and after the last.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.geometry.alignment import compute_path_lengths
from topoloc.geometry.rigid import Rigid3, exp_so3, inverse_covariance, log_so3
from topoloc.localization.result import Localization
from topoloc.slam.bundle.bundle_adjustment import PosePrior, adjust_bundle
from topoloc.slam.keyframes import FramePose, KeyFrame
from topoloc.slam.monocular_odometry import MonocularSubmap

_NUM_ITERATIONS, _MAX_SIGMAS = 4, 3.0


def adjust_trajectory(
    stretch: MonocularSubmap,
    world_from_cams: Sequence[Rigid3 | None],
    anchors: Mapping[int, Localization],
) -> list[Rigid3 | None]:
    """Return the adjusted world_from_cam of each frame. None stays None.

    The stretch's key frames and landmarks change, too. Afterwards they are in the map's world, in
    metres.

    Args:
        stretch: the odometry of the trajectory.
        world_from_cams: the initial poses of the frames, in the map's world and metres.
        anchors: the trusted localizations, by frame.
    """
    # Factor of the sigmas of tracked points. A sliding point does so in all of its key frames.
    points_widened = 8.0
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
    adjust_bundle(
        keyframes,
        [],
        stretch.landmarks,
        map_anchors,
        max_steps=30,
        min_decrease=1e-5,
        cauchy_scale=0.5,
    )
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
    num_neighbours = 3  # on either side
    first = np.maximum(np.arange(len(before)) - num_neighbours, 0)
    last = np.minimum(np.arange(len(before)) + num_neighbours, len(before) - 1)
    odom, metres = (path_length[last] - path_length[first] for path_length in path_lengths)
    return metres / np.maximum(odom, 1e-12)


@dataclass(frozen=True, eq=False)
class _Corrections:
    """Hold shifts (metres, world) and rotation vectors (radians, world) at path lengths
    (metres)."""

    path_lengths: Float[np.ndarray, " k"]
    shifts: Float[np.ndarray, "k 3"]
    rotation_vectors: Float[np.ndarray, "k 3"]

    def at(
        self, path_length: float, reach_m: float
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Interpolate the correction linearly. It decays beyond both ends."""
        beyond = (
            max(self.path_lengths[0] - path_length, path_length - self.path_lengths[-1], 0.0)
            / reach_m
        )
        decay = float(np.exp(-0.5 * beyond**2))
        shift, rotation_vector = (
            np.array([np.interp(path_length, self.path_lengths, column) for column in rows.T])
            for rows in (self.shifts, self.rotation_vectors)
        )
        return decay * shift, decay * rotation_vector


def correct_trajectory(
    world_from_cams: Sequence[Rigid3 | None], answers: Mapping[int, Localization], d_thresh: float
) -> list[Rigid3 | None]:
    """Return the corrected poses. None stays None.

    Args:
        world_from_cams: the poses by frame.
        answers: the trusted localizations, by frame.
        d_thresh: D_thresh of the map, in metres. The correction is smoothed over this distance.
    """
    poses = {index: pose for index, pose in enumerate(world_from_cams) if pose is not None}
    answered = [
        index
        for index, answer in answers.items()
        if index in poses and _is_correctable(poses[index], answer)
    ]
    if not answered:
        return list(world_from_cams)
    path_lengths = dict(
        zip(
            poses,
            compute_path_lengths(np.array([pose.translation for pose in poses.values()])),
            strict=True,
        )
    )
    at = np.array([path_lengths[index] for index in answered])
    corrections = _estimate_corrections(
        [poses[index] for index in answered], [answers[index] for index in answered], at, d_thresh
    )
    moved = {
        index: _apply_correction(pose, *corrections.at(path_lengths[index], d_thresh))
        for index, pose in poses.items()
    }
    return [moved.get(index) for index in range(len(world_from_cams))]


def _apply_correction(
    pose: Rigid3, shift: Float[np.ndarray, "3"], rotation_vector: Float[np.ndarray, "3"]
) -> Rigid3:
    return Rigid3(exp_so3(rotation_vector) @ pose.rotation, pose.translation + shift)


def _is_correctable(pose: Rigid3, answer: Localization) -> bool:
    """Return whether the pose is within three sigmas of the localization. Otherwise one of the two
    is wrong, and a correction cannot decide which."""
    return pose.is_same(
        answer.world_from_cam,
        _MAX_SIGMAS * answer.position_sigma_m,
        math.radians(_MAX_SIGMAS * answer.rotation_sigma_deg),
    )


def _pose_error(
    pose: Rigid3, answer: Localization
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    return answer.world_from_cam.translation - pose.translation, log_so3(
        answer.world_from_cam.rotation @ pose.rotation.T
    )


def _estimate_corrections(
    poses: Sequence[Rigid3],
    answers: Sequence[Localization],
    path_lengths: Float[np.ndarray, " k"],
    d_thresh: float,
) -> _Corrections:
    """Estimate the correction at each localization from the localizations around it."""
    # Prior sigma of the correction, in D_thresh. A localization this far from the local mean
    # has half the weight.
    stray = 0.1
    stray_deg = 0.5  # the same for the rotation, in degrees
    errors = [_pose_error(pose, answer) for pose, answer in zip(poses, answers, strict=True)]
    sigmas_m = np.array([answer.position_sigma_m for answer in answers])
    sigmas = np.radians([answer.rotation_sigma_deg for answer in answers])
    near = np.exp(-0.5 * (np.subtract.outer(path_lengths, path_lengths) / (d_thresh)) ** 2)
    shifts = _robust_mean(
        near, np.array([shift for shift, _ in errors]), sigmas_m, stray * d_thresh
    )
    return _Corrections(
        path_lengths,
        shifts,
        _robust_mean(
            near,
            np.array([rotation_vector for _, rotation_vector in errors]),
            sigmas,
            math.radians(stray_deg),
        ),
    )


def _robust_mean(
    near: Float[np.ndarray, "k k"],
    rows: Float[np.ndarray, "k 3"],
    sigmas: Float[np.ndarray, " k"],
    stray: float,
) -> Float[np.ndarray, "k 3"]:
    """Return the local mean around each row, with zero correction of sigma `stray` as the prior and
    Cauchy weights for outliers."""
    weights = near / np.maximum(sigmas, 1e-9) ** 2
    common, robust = rows, weights
    for _ in range(_NUM_ITERATIONS):
        common = robust @ rows / (robust.sum(axis=1, keepdims=True) + 1.0 / stray**2)
        apart = np.linalg.norm(rows[None] - common[:, None], axis=2) / stray
        robust = weights / (1.0 + apart**2)
    return common
