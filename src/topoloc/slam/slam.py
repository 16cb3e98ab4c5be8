"""Stereo visual SLAM: estimate the poses of all frames of several recordings in one world.

Odometry turns each recording into chains of key frames (sub-maps). Loops join them at places that
are seen again, within a recording or between two. If no loop does, the consensus of many weaker
pairs joins them. A pose graph and a global bundle adjustment make all poses consistent. Of sub-maps
that stay apart, the group with the most frames is kept. The world is the camera frame of its first
frame.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.errors import RecordingError
from topoloc.geometry.alignment import (
    absolute_trajectory_errors,
    compute_path_lengths,
    relative_drift,
)
from topoloc.geometry.rigid import Rigid3, positions_of
from topoloc.geometry.transform_consensus import diagonal_covariance
from topoloc.json_data import OneLine
from topoloc.points.metric_points import MeasuredView, measured_view
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.recording import keep_frames, with_poses
from topoloc.slam.bundle.bundle_adjustment import adjust_bundle
from topoloc.slam.calibration_checks import find_image_faults
from topoloc.slam.input_checks import check_stereo
from topoloc.slam.keyframes import FramePose, KeyFrame, KeyFrameObservations, Landmarks, Motion
from topoloc.slam.loop_closure import Link, find_links
from topoloc.slam.odometry import Odometry
from topoloc.slam.place_matching import extract_place_features
from topoloc.slam.pose_graph import PoseGraphEdge, compute_normalized_residuals, optimize_pose_graph
from topoloc.slam.submap_joins import find_joins, group_submaps


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


Progress = Callable[[str, int, int], None]
"""Called with a stage's name, the steps done and the total steps."""


@dataclass(frozen=True, eq=False, repr=False)
class SlamResult(OneLine):
    """Hold the poses of all frames and statistics.

    Attributes:
        poses: `poses[r][i]` is world_from_cam of frame i of recording r, None if unknown.
        apart: `apart[r]` holds the poses of each sub-map outside the common world, in its own world
            and as odometry estimated them. Each list is as `poses[r]`.
        num_submaps: number of sub-maps.
        num_joined: number of sub-maps in the common world, the largest by frames of the first
            recording.
        num_lost: number of frames without tracking.
        disparity_bias_px: disparity bias of the first recording.
        right_residuals_px: distances between measured and predicted landmarks in the right images.
    """

    poses: list[list[Rigid3 | None]]
    apart: list[list[list[Rigid3 | None]]]
    num_keyframes: int
    num_loops: int
    num_submaps: int
    num_joined: int
    num_lost: int
    disparity_bias_px: list[float]
    right_residuals_px: Float[np.ndarray, " n"]

    def apply(self, sequences: Sequence[StereoSequence]) -> list[StereoSequence]:
        """Return the recordings that were given to `run_slam` with the estimated poses, and with
        those of stretches that stayed apart.

        Raises:
            RecordingError: one of them shares no place with the others.
        """
        for sequence, poses in zip(sequences, self.poses, strict=True):
            if not any(poses):
                raise RecordingError(
                    f"{sequence.name}: no place of it was recognised in {sequences[0].name}; map it"
                    " alone"
                )
        return [
            with_poses(sequence, poses, tuple(apart))
            for sequence, poses, apart in zip(sequences, self.poses, self.apart, strict=True)
        ]

    def to_json(self, sequence: StereoSequence) -> dict[str, Any]:
        """Return statistics of the first recording, and its errors if it has ground truth."""
        poses = self.poses[0]
        known = [pose for pose in poses if pose is not None]
        length_m = compute_path_lengths(positions_of(known))[-1] if known else 0.0
        residuals = self.right_residuals_px[np.isfinite(self.right_residuals_px)]
        facts: dict[str, Any] = {
            "num_frames": len(poses),
            "num_tracked": len(known),
            "num_keyframes": self.num_keyframes,
            "num_loops": self.num_loops,
            "num_submaps": self.num_submaps,
            "num_joined": self.num_joined,
            "length_m": round(float(length_m), 3),
            "disparity_bias_px": round(self.disparity_bias_px[0], 3),
            "right_residual_px": round(float(np.median(residuals)), 3) if len(residuals) else None,
        }
        both = [
            (true, pose)
            for true, pose in zip(sequence.poses, poses, strict=True)
            if true is not None and pose is not None
        ]
        if both:
            truth, found = [true for true, _ in both], [pose for _, pose in both]
            errors, drift = absolute_trajectory_errors(truth, found), relative_drift(truth, found)
            facts["ate_m"] = float(np.sqrt(np.mean(errors**2)))
            facts["max_error_m"] = float(errors.max())
            facts["drift_percent"] = 100.0 * drift.translation if drift else None
            facts["drift_deg_per_m"] = float(np.rad2deg(drift.rotation)) if drift else None
        return facts


def run_slam(
    sequences: StereoSequence | Sequence[StereoSequence],
    progress: Progress | None = None,
    warn: Callable[[str], object] | None = None,
) -> SlamResult:
    """Run SLAM on one or several recordings of one place.

    Recordings after the first are joined to it at common places. The same recordings give
    byte-identical poses. If `warn` is given, images are searched for faults of the calibration
    first, and it is called with a note on each.

    Raises:
        RecordingError: no frame could be tracked, left and right are swapped or no pairs, or there
            are only single images.
        CalibrationError: there is no calibration, or the baseline cannot be in metres.
        UnreadableImageError: an image cannot be read.
    """
    progress = progress or (lambda stage, done, total: None)
    several = [sequences] if isinstance(sequences, StereoSequence) else sequences
    sequences = [keep_frames(one) for one in several]
    keyframes: list[KeyFrame] = []
    landmarks = Landmarks()
    tracked: list[list[FramePose | None]] = []
    residuals: list[np.ndarray] = []
    for number, sequence in enumerate(sequences):
        pairs = check_stereo(sequence)
        if warn is not None:
            for note in find_image_faults(sequence, pairs):
                warn(note)
        odometry = Odometry(number, keyframes, landmarks)
        tracked.append(_track_recording(sequence, odometry, progress))
        residuals += odometry.right_residuals_px
    links = find_links(keyframes, progress)
    links += find_joins(
        keyframes,
        links,
        lambda k: extract_place_features(prepare_frame(sequences[k.recording][k.frame_idx])),
    )
    groups = group_submaps(keyframes, links)
    of_frames = Counter(groups[pose.keyframe.submap] for pose in tracked[0] if pose is not None)
    ((largest, _),) = of_frames.most_common(1)  # by frames of the first recording
    joined = join_submaps(keyframes, links, landmarks, largest)
    links = _optimize_map(keyframes, links, joined, landmarks, progress)
    return SlamResult(
        poses=_to_world_poses(tracked, joined),
        apart=[
            [
                _select_poses(one, [submap])
                for submap in sorted({p.keyframe.submap for p in one if p is not None} - {*joined})
            ]
            for one in tracked
        ],
        num_keyframes=len(keyframes),
        num_loops=len(links),
        num_submaps=len({keyframe.submap for keyframe in keyframes}),
        num_joined=len(joined),
        num_lost=sum(pose is None for poses in tracked for pose in poses),
        disparity_bias_px=[keyframes[0].bias.value_px],
        right_residuals_px=np.concatenate(residuals) if residuals else np.zeros(0),
    )


def _track_recording(
    sequence: StereoSequence, odometry: Odometry, progress: Progress
) -> list[FramePose | None]:
    poses: list[FramePose | None] = [None] * len(sequence)
    for i, (frame, measured) in enumerate(_prefetch_frames(sequence)):
        for pose in odometry.process(i, frame, measured):
            poses[pose.frame_idx] = pose
        progress(f"tracking {sequence.name}", i + 1, len(sequence))
    for pose in odometry.finish():
        poses[pose.frame_idx] = pose
    if all(pose is None for pose in poses):
        raise RecordingError(
            f"{sequence.name}: none of the {len(poses)} frames could be tracked: too dark, without"
            " texture, or no stereo"
        )
    return poses


def _prefetch_frames(sequence: StereoSequence) -> Iterator[tuple[StereoFrame, MeasuredView]]:
    """Iterate over the frames. Each one is read and prepared while the preceding one is
    processed."""

    def read(index: int) -> tuple[StereoFrame, MeasuredView]:
        frame = sequence[index]
        return frame, measured_view(frame)

    with ThreadPoolExecutor(max_workers=1) as reader:
        coming = reader.submit(read, 0)
        for i in range(len(sequence)):
            ready = coming.result()
            if i + 1 < len(sequence):
                coming = reader.submit(read, i + 1)
            yield ready


def _optimize_map(
    keyframes: list[KeyFrame],
    links: list[Link],
    joined: list[int],
    landmarks: Landmarks,
    progress: Progress,
) -> list[Link]:
    """Optimise the joined key frames, and return the links that agree with the result."""
    chosen = [i for i, keyframe in enumerate(keyframes) if keyframe.submap in joined]
    row = {i: k for k, i in enumerate(chosen)}
    of_joined = [
        replace(link, source=row[link.source], target=row[link.target])
        for link in links
        if link.source in row and link.target in row
    ]
    ours = [keyframes[i] for i in chosen]
    progress("optimising", 0, 2)
    kept = close_loops(ours, of_joined, landmarks)
    progress("optimising", 1, 2)
    adjust_global_bundle(ours, kept, landmarks)
    progress("optimising", 2, 2)
    return kept


def _to_world_poses(
    tracked: list[list[FramePose | None]], joined: list[int]
) -> list[list[Rigid3 | None]]:
    """Return world_from_cam of every frame. The world is the camera frame of the first one."""
    poses = [_select_poses(one, joined) for one in tracked]
    world_from_any = next(pose for one in poses for pose in one if pose is not None).inverse()
    return [[world_from_any @ pose if pose is not None else None for pose in one] for one in poses]


def _select_poses(tracked: list[FramePose | None], submaps: Sequence[int]) -> list[Rigid3 | None]:
    """Return the poses of some sub-maps, in their own world. Other frames have None."""
    return [
        p.world_from_cam() if p is not None and p.keyframe.submap in submaps else None
        for p in tracked
    ]
