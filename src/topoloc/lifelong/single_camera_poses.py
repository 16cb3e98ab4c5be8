"""Estimate the poses of a session of a single camera without poses.

The images are localized as a stream, and visual odometry runs on the same images
(`slam/monocular_odometry.py`). The localizations give each odometry stretch its scale and its
place. Odometry carries the poses into areas that the map does not cover. Localizations that
contradict the odometry are ignored. If too few localizations support a stretch, its odometry is not
used. Frames of such a stretch have a pose only if their localizations agree with each other. The
stream's poses are used for frames without any odometry.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from itertools import groupby

import numpy as np

from topoloc.errors import CalibrationError, TrajectoryError
from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.lifelong.scale_estimation import (
    WIDENED,
    MotionTolerance,
    NoiseScale,
    find_motion_consensus,
    scale_to_metres,
)
from topoloc.lifelong.session_poses import (
    MIN_AGREEING,
    SLACK,
    SLACK_DEG,
    SessionPoses,
    align_motion_to_map,
    check_focal_length,
    check_query_calibration,
    select_queried_frames,
)
from topoloc.lifelong.trajectory_adjustment import adjust_trajectory, correct_trajectory
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.config import MapConfig, Progress
from topoloc.recordings.frame import StereoSequence
from topoloc.slam.monocular_odometry import MonocularOdometry
from topoloc.tracking.tracker import Tracker

_NUM_FRAMES_AROUND = 3


def estimate_poses_by_map(
    sequence: StereoSequence, tracker: Tracker, map_config: MapConfig, progress: Progress
) -> SessionPoses:
    """Estimate the poses of a session without poses by localizing each of its images. The result's
    `answers` hold frames about as far apart as nodes.

    Raises TrajectoryError if the map recognises too little of it, CalibrationError if a frame has
    no calibration or the images contradict it, UnreadableImageError and QueryError.
    """
    # A frame without odometry takes the map's pose if its position sigma is at most this many
    # D_thresh.
    max_sigma = 0.1
    found, odometry = _localize_stream(sequence, tracker, progress)
    d_thresh = map_config.d_thresh
    limits = SLACK * d_thresh, math.radians(SLACK_DEG)
    localized = {index: answer for index, (_, answer) in found.items()}
    poses = {
        index: pose
        for index, (pose, answer) in found.items()
        if answer.position_sigma_m <= max_sigma * d_thresh
    }
    for stretch in odometry.submaps:
        odom = stretch.submap_from_cams()
        aligned, inlier_idx = align_stretch_to_map(sequence.name, odom, localized, d_thresh)
        if aligned is not None:
            anchors = {index: localized[index] for index in inlier_idx}
            adjusted = adjust_trajectory(stretch, aligned, anchors)
            corrected = correct_trajectory(adjusted, anchors, d_thresh)
            aligned, inlier_idx = _reject_contradicted(corrected, localized, inlier_idx, d_thresh)
        for index in odom:
            is_inlier, pose = index in inlier_idx, poses.pop(index, None)
            answer = localized[index] if is_inlier else localized.pop(index, None)
            if aligned is not None:
                pose = aligned.get(index)
                # A node that differs from the localization would contradict the map's nodes.
                is_kept = answer is None or (pose and pose.is_same(answer.world_from_cam, *limits))
            else:
                is_kept = is_inlier
            if pose is not None and is_kept:
                poses[index] = pose
    if not poses:
        raise TrajectoryError(f"{sequence.name}: {_failure_reason(localized)}; no map is changed")
    known = dict(sorted(poses.items()))
    queried = select_queried_frames(known, map_config)
    answers = {index: localized.get(index) for index in queried}
    inlier_idx = [index for index in queried if index in localized]
    return SessionPoses(poses, answers, inlier_idx, [k for k in known if k not in localized])


def _localize_stream(
    sequence: StereoSequence, tracker: Tracker, progress: Progress
) -> tuple[dict[int, tuple[Rigid3, Localization]], MonocularOdometry]:
    """Return the smoothed pose and the localization of each localized frame, and the odometry of
    all frames. Raises as `estimate_poses_by_map`."""
    localized = dict[int, tuple[Rigid3, Localization]]()
    odometry, results = MonocularOdometry(), list[Localization | NotLocalized]()
    for index, t_ns in enumerate(sequence.t_ns):
        frame = sequence[index]
        if frame.camera is None:
            raise CalibrationError(
                f"{sequence.name}: a session that the map is asked for needs a calibration"
                " (--camera)"
            )
        odometry.process(index, frame)
        found = tracker.process(frame.image, frame.camera, t_ns)
        results.append(found.result)
        if found.smoothed is not None and isinstance(found.result, Localization):
            localized[index] = found.smoothed, found.result
        progress(f"localizing {sequence.name}", index + 1, len(sequence))
    check_query_calibration(sequence.name, results)
    if len(localized) < MIN_AGREEING:
        check_focal_length(sequence, range(len(sequence)), tracker.localizer)
        raise TrajectoryError(
            f"{sequence.name}: the map recognises {len(localized)} of its {len(sequence)} pictures:"
            " too few to join"
        )
    localize_between(sequence, tracker.localizer, localized)
    return localized, odometry


def localize_between(
    sequence: StereoSequence,
    localizer: Localizer,
    localized: dict[int, tuple[Rigid3, Localization]],
) -> None:
    """Add to `localized` each frame between two localized ones that the map finds between them.
    Alone it looked like several places, or like none."""
    for index in range(1, len(sequence) - 1):
        before, after = localized.get(index - 1), localized.get(index + 1)
        if index not in localized and before is not None and after is not None:
            frame, half_way = sequence[index], before[0].interpolate(after[0], 0.5)
            result = localizer.localize(frame.image, frame.camera, half_way)
            gap_m = float(np.linalg.norm(before[0].translation - after[0].translation))
            if isinstance(result, Localization) and result.world_from_cam.is_same(
                half_way, 0.5 * gap_m, math.pi
            ):
                localized[index] = result.world_from_cam, result


def _failure_reason(localized: Mapping[int, Localization]) -> str:
    """Return the reason why no frame has a pose. `localized` holds the localizations that agree
    with the motion."""
    if not localized:
        return "what the map answers to its pictures does not agree with their motion"
    known_to = float(np.median([answer.position_sigma_m for answer in localized.values()]))
    return (
        f"the map knows where its pictures were taken to {known_to:.2f} m only, which is too little"
        " to tell how long its way is"
    )


def align_stretch_to_map(
    name: str, odom: Mapping[int, Rigid3], localized: Mapping[int, Localization], d_thresh: float
) -> tuple[dict[int, Rigid3] | None, list[int]]:
    """Align a stretch of odometry with the map. Return world_from_cam by frame, without frames at
    which map and motion contradict each other, and the frames of the localizations that agree with
    it. The poses are None if too few localizations support the stretch."""
    within_stretch = {index: answer for index, answer in localized.items() if index in odom}
    inlier_idx = _find_consensus(odom, within_stretch, d_thresh)
    num_refits = 3  # each with another scale
    aligned = None
    for _ in range(num_refits):  # each refit uses the inliers found with the previous scale
        metric = (
            scale_to_metres(odom, {index: within_stretch[index] for index in inlier_idx})
            if len(inlier_idx) >= MIN_AGREEING
            else {}
        )
        within = {index: answer for index, answer in within_stretch.items() if index in metric}
        if len(within) < MIN_AGREEING:
            return None, _reject_ambiguous(odom, within_stretch, inlier_idx, d_thresh)
        try:
            # fixed noise scales: the drift of the scale is not a random walk
            aligned = align_motion_to_map(name, metric, within, d_thresh, NoiseScale())
        except TrajectoryError:
            return None, _reject_ambiguous(odom, within_stretch, inlier_idx, d_thresh)
        inlier_idx = aligned.inlier_idx
    if aligned is None or not _reject_ambiguous(odom, within_stretch, inlier_idx, d_thresh):
        return None, []
    return _reject_contradicted(aligned.world_from_cams, within_stretch, inlier_idx, d_thresh)


def _find_consensus(
    odom: Mapping[int, Rigid3], localized: Mapping[int, Localization], d_thresh: float
) -> list[int]:
    """Return the frames of the most localizations that one similarity transform of the motion
    explains. Return none if they are fewer than three, because a similarity explains any two."""
    tolerance = MotionTolerance(SLACK * d_thresh, SLACK_DEG, drift=0.05, drift_deg=1.0)
    inlier_idx = find_motion_consensus(odom, localized, tolerance, is_metric=False)
    return inlier_idx if len(inlier_idx) > 2 else []


def _reject_ambiguous(
    odom: Mapping[int, Rigid3],
    within_stretch: Mapping[int, Localization],
    inlier_idx: list[int],
    d_thresh: float,
) -> list[int]:
    """Return the agreeing localizations, or none if a large rival set agrees on another trajectory.
    A place that looks like another one is localized wrongly for as long as it is in view."""
    # Of a single camera, the agreeing localizations are rejected if a rival set with at least
    # this share of their number agrees on another trajectory.
    rival_share = 0.3
    rest = {index: answer for index, answer in within_stretch.items() if index not in inlier_idx}
    rivals = _find_consensus(odom, rest, d_thresh)
    return [] if len(rivals) >= max(MIN_AGREEING, rival_share * len(inlier_idx)) else inlier_idx


def _reject_contradicted(
    poses: Mapping[int, Rigid3],
    localized: Mapping[int, Localization],
    inlier_idx: Sequence[int],
    d_thresh: float,
) -> tuple[dict[int, Rigid3] | None, list[int]]:
    """Remove poses and localizations of frames for which map and motion contradict each other.
    Return None for the poses if too few localizations are left."""
    # A frame has no pose if map and motion differ by more than this many D_thresh. Three sigmas of
    # the localization, multiplied by `WIDENED`, are added.
    contradiction = 0.1
    within_stretch = {index: answer for index, answer in localized.items() if index in poses}
    apart = {
        index
        for index, answer in within_stretch.items()
        if translation_error(poses[index], answer.world_from_cam)
        >= contradiction * d_thresh + 3.0 * WIDENED * answer.position_sigma_m
    }
    contradicted = _find_contradicted_frames(list(within_stretch), apart)
    left = {index: pose for index, pose in poses.items() if index not in contradicted}
    consistent = [index for index in inlier_idx if index not in apart]
    return (left, consistent) if len(consistent) >= MIN_AGREEING else (None, [])


def _find_contradicted_frames(answered: list[int], apart: Set[int]) -> set[int]:
    """Return the frames around contradictions between the map and the motion.

    A contradiction is a run of several contradicting localizations, or a single one at either end
    of the stretch. A few frames around it are included, up to the next consistent localization. A
    single contradiction between two consistent localizations is ignored, because the motion is
    right there.
    """
    frames = set[int]()
    runs = [
        (is_apart, list(run)) for is_apart, run in groupby(answered, lambda index: index in apart)
    ]
    for k, (is_apart, run) in enumerate(runs):
        if is_apart and (len(run) > 1 or k in (0, len(runs) - 1)):
            after = runs[k - 1][1][-1] if k > 0 else -1
            before = runs[k + 1][1][0] if k + 1 < len(runs) else run[-1] + 1
            frames.update(
                j
                for index in run
                for j in range(index - _NUM_FRAMES_AROUND, index + _NUM_FRAMES_AROUND + 1)
                if after < j < before
            )
    return frames
