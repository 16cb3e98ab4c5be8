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

import numpy as np
from jaxtyping import Float

from topoloc.geometry.alignment import compute_path_lengths
from topoloc.geometry.rigid import Rigid3, exp_so3, log_so3, positions_of
from topoloc.localization.result import Localization
from topoloc.slam.bundle.bundle_adjustment import PosePrior, adjust_bundle
from topoloc.slam.keyframes import FramePose, KeyFrame
from topoloc.slam.monocular_odometry import MonocularSubmap

_NUM_ITERATIONS, _MAX_SIGMAS = 4, 3.0


def adjust_trajectory(
    stretch: MonocularSubmap,
    world_from_cams: Mapping[int, Rigid3],
    anchors: Mapping[int, Localization],
) -> dict[int, Rigid3]:
    """Return the adjusted poses of the frames, given the initial poses in the map's world (metres)
    and the trusted localizations.

    The key frames and landmarks of the stretch change, too. Afterwards they are in the map's world,
    in metres.
    """
    # Factor of the sigmas of tracked points. A sliding point does so in all of its key frames.
    points_widened, keyframes = 8.0, _transform_to_map(stretch, world_from_cams)
    moved = set(map(id, keyframes))
    frames = {
        f.frame_idx: f
        for f in stretch.frames
        if id(f.keyframe) in moved and f.frame_idx in world_from_cams
    }
    relative = {
        index: f.view_from_cam
        @ world_from_cams[index].inverse()
        @ f.keyframe.cam_from_world.inverse()
        for index, f in frames.items()
    }
    for keyframe in keyframes:
        keyframe.observations.weights /= points_widened
    map_anchors = [
        _keyframe_anchor(relative[index], frame, anchors[index])
        for index, frame in frames.items()
        if index in anchors
    ]
    limits = {"max_steps": 30, "min_decrease": 1e-5, "cauchy_scale": 0.5}
    adjust_bundle(keyframes, [], stretch.landmarks, map_anchors, **limits)
    adjusted = {
        index: (relative[index] @ frame.keyframe.cam_from_world).inverse() @ frame.view_from_cam
        for index, frame in frames.items()
    }
    return {**world_from_cams, **adjusted}


def _keyframe_anchor(
    cam_from_keyframe: Rigid3, frame: FramePose, answer: Localization
) -> PosePrior:
    """Return the pose prior on a frame's key frame that follows from the frame's localization."""
    keyframe_from_cam = cam_from_keyframe.inverse() @ frame.view_from_cam
    turned = keyframe_from_cam.inverse().adjoint()
    information = turned.T @ np.linalg.inv(answer.camera_covariance) @ turned
    keyframe_from_world = keyframe_from_cam @ answer.world_from_cam.inverse()
    return PosePrior(frame.keyframe, keyframe_from_world, information)


def _transform_to_map(
    stretch: MonocularSubmap, world_from_cams: Mapping[int, Rigid3]
) -> list[KeyFrame]:
    """Move the key frames with a known pose, and their landmarks, into the map's world and metres.
    Return these key frames."""
    views = {f.frame_idx: f.view_from_cam for f in stretch.frames}
    known = views.keys() & world_from_cams.keys()
    keyframes = [k for k in stretch.keyframes if k.frame_idx in known]
    before = [k.cam_from_world for k in keyframes]
    after = [views[k.frame_idx] @ world_from_cams[k.frame_idx].inverse() for k in keyframes]
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
        compute_path_lengths(positions_of(pose.inverse() for pose in poses))
        for poses in (before, after)
    ]
    num_neighbours = 3  # on either side
    first = np.maximum(np.arange(len(before)) - num_neighbours, 0)
    last = np.minimum(np.arange(len(before)) + num_neighbours, len(before) - 1)
    odom, metres = (path_length[last] - path_length[first] for path_length in path_lengths)
    return metres / np.maximum(odom, 1e-12)


def correct_trajectory(
    world_from_cams: Mapping[int, Rigid3], answers: Mapping[int, Localization], d_thresh: float
) -> dict[int, Rigid3]:
    """Return the poses, corrected by the trusted localizations (`answers`, by frame). The
    correction is smoothed over `d_thresh`, D_thresh of the map in metres."""
    poses = list(world_from_cams.values())
    rows = {index: row for row, index in enumerate(world_from_cams)}
    # Beyond three sigmas, the pose or the localization is wrong. A correction cannot decide which.
    answered = {
        rows[index]: answer
        for index, answer in answers.items()
        if index in rows
        and world_from_cams[index].is_same(
            answer.world_from_cam,
            _MAX_SIGMAS * answer.position_sigma_m,
            math.radians(_MAX_SIGMAS * answer.rotation_sigma_deg),
        )
    }
    if not answered:
        return dict(world_from_cams)
    lengths = compute_path_lengths(positions_of(poses))
    at = lengths[list(answered)]
    errors = [  # shifts (metres, world) and rotation vectors (radians, world)
        np.append(
            answer.world_from_cam.translation - poses[row].translation,
            log_so3(answer.world_from_cam.rotation @ poses[row].rotation.T),
        )
        for row, answer in answered.items()
    ]
    corrections = _estimate_corrections(errors, list(answered.values()), at, d_thresh)
    beyond = np.maximum(np.maximum(at[0] - lengths, lengths - at[-1]), 0.0) / d_thresh
    decay = np.exp(-0.5 * beyond**2)
    moved = [decay * np.interp(lengths, at, column) for column in corrections.T]
    return {
        index: Rigid3(exp_so3(step[3:]) @ pose.rotation, pose.translation + step[:3])
        for (index, pose), step in zip(world_from_cams.items(), np.transpose(moved), strict=True)
    }


def _estimate_corrections(
    errors: Sequence[Float[np.ndarray, "6"]],
    answers: Sequence[Localization],
    path_lengths: Float[np.ndarray, " k"],
    d_thresh: float,
) -> Float[np.ndarray, "k 6"]:
    """Estimate the correction at each localization from the localizations around it."""
    # Prior sigma of the correction, in D_thresh. A localization this far from the local mean
    # has half the weight.
    stray = 0.1
    stray_deg = 0.5  # the same for the rotation, in degrees
    shifts, turns = np.split(np.array(errors), 2, axis=1)
    sigmas_m = np.array([answer.position_sigma_m for answer in answers])
    sigmas = np.radians([answer.rotation_sigma_deg for answer in answers])
    near = np.exp(-0.5 * (np.subtract.outer(path_lengths, path_lengths) / d_thresh) ** 2)
    shifts = _robust_mean(near, shifts, sigmas_m, stray * d_thresh)
    return np.hstack([shifts, _robust_mean(near, turns, sigmas, math.radians(stray_deg))])


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
