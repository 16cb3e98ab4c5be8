"""Optimise the whole map: join sub-maps by links, optimise the pose graph, then adjust the
bundle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.transform_consensus import diagonal_covariance
from topoloc.slam.bundle.bundle_adjustment import adjust_bundle
from topoloc.slam.keyframes import KeyFrame, KeyFrameObservations, Landmarks, Motion
from topoloc.slam.loop_closure import Link
from topoloc.slam.pose_graph import PoseGraphEdge, compute_normalized_residuals, optimize_pose_graph


def join_submaps(
    keyframes: Sequence[KeyFrame], links: Sequence[Link], landmarks: Landmarks, first: int
) -> list[int]:
    """Move every linked sub-map into the world of sub-map `first`.

    Return the joined sub-maps, including `first`.
    """
    joined = [first]

    def is_joined(row: int) -> bool:
        return keyframes[row].submap in joined

    while True:
        crossing = next((k for k in links if is_joined(k.source) != is_joined(k.target)), None)
        if crossing is None:
            return joined
        known, new = keyframes[crossing.source], keyframes[crossing.target]
        known_from_new = crossing.match.target_from_source.inverse()
        if new.submap in joined:
            known, new, known_from_new = new, known, crossing.match.target_from_source
        world_from_new = known.cam_from_world.inverse() @ known_from_new @ new.cam_from_world
        moved = [k for k in keyframes if k.submap == new.submap]
        ids = np.unique(np.concatenate([k.observations.landmark_ids for k in moved]))
        landmarks.positions[ids] = world_from_new.apply(landmarks.positions[ids])
        for keyframe in moved:
            keyframe.cam_from_world = keyframe.cam_from_world @ world_from_new.inverse()
        joined.append(new.submap)


def close_loops(
    keyframes: Sequence[KeyFrame], links: Sequence[Link], landmarks: Landmarks
) -> list[Link]:
    """Optimise the pose graph of joined key frames, and move the landmarks with them.

    Return the links that agree with the result.
    """
    if not links:
        return []
    max_residual = 8.0  # of a link that is kept, in standard deviations
    index = {id(keyframe): i for i, keyframe in enumerate(keyframes)}
    motions = [_motion_edge(k, k.motion, index) for k in keyframes if k.motion is not None]
    kept, poses = list(links), [keyframe.cam_from_world for keyframe in keyframes]
    for _ in range(2):  # the second round omits the links that the first rejected
        edges = motions + [_link_edge(link) for link in kept]
        poses = optimize_pose_graph([keyframe.cam_from_world for keyframe in keyframes], edges)
        lengths = compute_normalized_residuals(poses, edges)[len(motions) :]
        agreeing = [
            link for link, length in zip(kept, lengths, strict=True) if length <= max_residual
        ]
        if len(agreeing) == len(kept):
            break
        kept = agreeing
    _move_keyframes(keyframes, poses, landmarks)
    return kept


def _motion_edge(keyframe: KeyFrame, given: Motion, index: dict[int, int]) -> PoseGraphEdge:
    sigma_share = 0.004  # sigma of a motion between two key frames, as a share of its length
    # Sigma of a motion between two key frames, degrees, in addition to that of tracking.
    sigma_deg = 0.02
    motion = keyframe.cam_from_world @ given.source.cam_from_world.inverse()
    metres = sigma_share * float(np.linalg.norm(motion.translation)) + 1e-3
    covariance = given.covariance + diagonal_covariance(metres, sigma_deg)
    return PoseGraphEdge(
        index[id(given.source)], index[id(keyframe)], motion, covariance, is_loop=False
    )


def _link_edge(link: Link) -> PoseGraphEdge:
    # Factor of the PnP covariance of a link, because matched features of one view have correlated
    # errors.
    covariance_scale = 4.0
    covariance = covariance_scale * link.match.covariance + diagonal_covariance(0.01, 0.1)
    return PoseGraphEdge(
        link.source, link.target, link.match.target_from_source, covariance, is_loop=True
    )


def _move_keyframes(
    keyframes: Sequence[KeyFrame], poses: Sequence[Rigid3], landmarks: Landmarks
) -> None:
    """Set new poses. Each landmark moves with the first key frame that sees it."""
    moved = np.zeros(landmarks.num, np.bool_)
    for keyframe, pose in zip(keyframes, poses, strict=True):
        ids = keyframe.observations.landmark_ids
        ids = ids[~moved[ids]]
        moved[ids] = True
        landmarks.positions[ids] = (pose.inverse() @ keyframe.cam_from_world).apply(
            landmarks.positions[ids]
        )
        keyframe.cam_from_world = pose


def adjust_global_bundle(
    keyframes: Sequence[KeyFrame], links: Sequence[Link], landmarks: Landmarks
) -> None:
    """Adjust all key frames and landmarks. Matches of links become landmarks seen by both key
    frames."""
    landmark_of: dict[tuple[int, int], int] = {}
    for link in links:
        _add_link_landmarks(link, keyframes, landmarks, landmark_of)
    adjust_bundle(keyframes, [], landmarks, max_steps=12, min_decrease=1e-4)


def _add_link_landmarks(
    link: Link,
    keyframes: Sequence[KeyFrame],
    landmarks: Landmarks,
    landmark_of: dict[tuple[int, int], int],
) -> None:
    source = keyframes[link.source]
    points_cam = source.place.points.points_cam
    for rows in zip(link.match.source_rows.tolist(), link.match.target_rows.tolist(), strict=True):
        known = landmark_of.get((link.source, rows[0]))
        if known is None:
            point = source.cam_from_world.inverse().apply(points_cam[rows[0]][None])
            known = int(landmarks.add(point)[0])
        for end, row in zip((link.source, link.target), rows, strict=True):
            if (end, row) not in landmark_of:
                landmark_of[end, row] = known
                keyframe = keyframes[end]
                keyframe.observations.append(_feature_observation(keyframe, row, known))


def _feature_observation(keyframe: KeyFrame, row: int, landmark_id: int) -> KeyFrameObservations:
    """Return a local feature as an observation: its pixel, and its disparity if it has a depth."""
    sigma_px = 0.8  # standard deviation of a feature's pixel in the global bundle adjustment
    place, stereo = keyframe.place, keyframe.stereo
    measured = np.array([[*place.features.points_img[row].astype(np.float64), np.nan]])
    weights = np.array([[1.0 / sigma_px, 1.0 / sigma_px, 0.0]])
    if place.points.valid[row]:
        depth = place.points.points_cam[row, 2]
        measured[0, 2] = stereo.bf / depth
        weights[0, 2] = depth**2 / (stereo.bf * np.sqrt(place.points.covariances[row, 2, 2]))
    return KeyFrameObservations(np.array([landmark_id]), measured, weights, np.ones(1, np.bool_))
