"""Estimate the poses of a new session in the world of a map.

Localizations of some images anchor the session's own motion. The motion comes from its poses
(given, or from SLAM) in any world. `single_camera_poses.py` handles a single camera without poses.
One rigid transform, up to drift, must explain most localizations. A pose graph with a fixed map
then combines the motion and the localizations. Their weights follow from the session itself
(`scale_estimation.py`).

A session is checked before: its calibration against the points of the map, and that the map does
not contain it yet.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from topoloc.errors import CalibrationError, DuplicateSessionError, TrajectoryError
from topoloc.geometry.camera import UncalibratedCamera
from topoloc.geometry.rigid import Rigid3
from topoloc.lifelong.node_localization import sample_evenly
from topoloc.lifelong.scale_estimation import (
    WIDENED,
    LocalizedStep,
    MotionTolerance,
    NoiseScale,
    find_motion_consensus,
    fit_noise_scale,
)
from topoloc.localization.image_calibration_check import check_camera_calibrations
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.config import MapConfig, Progress
from topoloc.mapping.mapping_frames import encode_place_image
from topoloc.mapping.nodes import select_node_frames
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import SequenceView, StereoSequence
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.recording import find_source_path
from topoloc.recordings.stored_images import decode_stored_image
from topoloc.slam.pose_graph import PoseGraphEdge, optimize_pose_graph

_NUM_QUERIES, _MIN_LOCALIZED = 7, 3
_FOCAL_LENGTH_RANGE = 1.5  # widens the range around the stated focal length, in both directions
_MAX_LOG_RATIO = math.log(1.04)


def check_query_calibration(name: str, results: Sequence[Localization | NotLocalized]) -> None:
    """Raise CalibrationError if the localization results of a session's images together contradict
    its calibration. The error begins with `name`."""
    found = [
        str(verdict) for verdict in check_camera_calibrations(results) if verdict.is_contradicted
    ]
    localized = [result for result in results if isinstance(result, Localization)]
    doubts = [result.calibration_doubt for result in localized if result.calibration_doubt]
    # images of few places together say nothing, but each may contradict it
    if not found and len(doubts) >= 3 and 2 * len(doubts) > len(localized):
        doubts.sort(key=lambda doubt: doubt.focal_length_px)
        middle = doubts[len(doubts) // 2]
        found = [f"{len(doubts)} of {len(localized)} pictures contradict it: {middle}"]
    if found:
        raise CalibrationError(
            f"{name}: its calibration is not that of its camera: {found[0]}; the map stays as it is"
        )


def check_focal_length(
    sequence: StereoSequence, indices: Sequence[int], localizer: Localizer
) -> None:
    """Check if a session is localized better with another focal length than its own.

    The map localizes too few images of such a session. At most seven of the queried frames
    (`indices`) are localized again with the focal length free between 1/1.5 and 1.5 times the
    stated one. The check ends without an error if an image has no camera model.

    Raises:
        CalibrationError: at least three images agree on a focal length that differs by more than 4
            %.
        UnreadableImageError, QueryError: an image of the session cannot be read or localized.
    """
    tried, found, stated = sample_evenly(indices, _NUM_QUERIES), list[float](), 0.0
    for index in tried:
        frame = sequence[index]
        if (camera := frame.camera) is None:
            return
        stated = stated or camera.fx
        bounds = camera.fx / _FOCAL_LENGTH_RANGE, camera.fx * _FOCAL_LENGTH_RANGE
        uncalibrated = UncalibratedCamera(camera.width, camera.height, *bounds)
        result = localizer.localize(frame.image, uncalibrated)
        if isinstance(result, Localization) and result.focal_length_px is not None:
            found.append(math.log(result.focal_length_px / camera.fx))
    if len(found) < _MIN_LOCALIZED:
        return
    middle = float(np.median(found))
    agreeing = sum(abs(one - middle) < _MAX_LOG_RATIO for one in found)
    if abs(middle) > _MAX_LOG_RATIO and agreeing >= _MIN_LOCALIZED:
        lengths = f"{stated * math.exp(middle):.0f} pixels, not {stated:.0f}"
        raise CalibrationError(
            f"{sequence.name}: its calibration is not that of its camera: the map recognises"
            f" {agreeing} of {len(tried)} pictures where the focal length is about {lengths}; the"
            " map stays as it is"
        )


def check_session_is_new(topomap: TopoMetricMap, sequence: StereoSequence) -> None:
    """Check that a session is not in the map already.

    Names and times may also be those of another day. So the check compares images or file paths,
    too. Raises DuplicateSessionError.
    """
    if len(sequence) == 0:
        return
    times, path = (min(sequence.t_ns), max(sequence.t_ns)), find_source_path(sequence)
    for session in topomap.sessions:
        if session.name != sequence.name or session.start_ns is None or session.end_ns is None:
            continue
        if min(times[1], session.end_ns) < max(times[0], session.start_ns):
            continue
        is_same_path = path is not None and path == session.recording
        is_same_file = is_same_path and (session.start_ns, session.end_ns) == times
        if is_same_file or _has_same_images(topomap, session.session_id, sequence, is_same_path):
            raise DuplicateSessionError(
                f"{sequence.name}: it is in the map already, as session {session.session_id}; the"
                " map stays as it is"
            )


def _has_same_images(
    topomap: TopoMetricMap, session_id: int, sequence: StereoSequence, is_same_path: bool
) -> bool:
    """Return whether images of the same name are identical, according to the small images in the
    map.

    Of the same folder (`is_same_path`), other images of the same time span count as the same
    session, too. This covers selections such as every second frame, then the frames between.
    """
    rows = {name: index for index, name in enumerate(sequence.names)}
    kept = [image for image in topomap.place_images if image.session_id == session_id]
    common = [image for image in kept if image.name in rows]
    if not common:
        return is_same_path and bool(kept)
    for image in sample_evenly(common, 3):
        side_px = min(decode_stored_image(image.jpeg).shape[:2])
        picture = prepare_frame(sequence[rows[image.name]], False).picture
        if encode_place_image(picture, side_px) == image.jpeg:
            return True
    return False


MIN_AGREEING = 5  # localized images that agree with the motion
# Constant part of the tolerance of two agreeing localizations: position, in D_thresh, and rotation.
SLACK, SLACK_DEG = 0.3, 2.0


@dataclass(frozen=True, eq=False)
class SessionPoses:
    """Hold the poses of a session in the world of the map.

    `world_from_cams` holds the known poses by frame.
    `answers` holds the localizations of the queried frames, None if a frame is not localized.
    `inlier_idx` lists the frames whose localizations anchor the session.
    """

    world_from_cams: dict[int, Rigid3]
    answers: Mapping[int, Localization | None]
    inlier_idx: list[int]
    propagated_idx: Sequence[int] = ()
    """Of a single camera, the frames whose pose comes from odometry and not from the map."""


def estimate_poses_by_motion(
    sequence: StereoSequence, localizer: Localizer, map_config: MapConfig, progress: Progress
) -> SessionPoses:
    """Estimate the poses of a session that has its own poses, in any metric world, or in several,
    one per stretch. Frames are queried about as far apart as nodes.

    Raises TrajectoryError if the map recognises too little of it or contradicts its poses,
    CalibrationError if the images contradict their calibration, UnreadableImageError and
    QueryError.
    """
    stretches = (sequence.poses, *(sequence.apart if isinstance(sequence, SequenceView) else ()))
    motions = [odom for poses in stretches if (odom := number_poses(poses))]
    if not motions:
        raise TrajectoryError(f"{sequence.name}: none of its frames has a pose; no map is changed")
    queried = [select_queried_frames(odom, map_config) for odom in motions]
    indices = sorted({index for of_motion in queried for index in of_motion})
    results = list[Localization | NotLocalized]()
    for done, index in enumerate(indices):
        frame = sequence[index]
        results.append(localizer.localize(frame.image, frame.camera))
        progress(f"localizing {sequence.name}", done + 1, len(indices))
    check_query_calibration(sequence.name, results)
    if sum(result.localized for result in results) < MIN_AGREEING and len(indices) >= MIN_AGREEING:
        check_focal_length(sequence, indices, localizer)
    answers = {
        index: result if isinstance(result, Localization) else None
        for index, result in zip(indices, results, strict=True)
    }
    aligned, refused = list[SessionPoses](), list[TrajectoryError]()
    for odom, frames in zip(motions, queried, strict=True):
        own = {index: answers[index] for index in frames}
        try:
            aligned.append(align_motion_to_map(sequence.name, odom, own, map_config.d_thresh))
        except TrajectoryError as error:
            refused.append(error)
    if not aligned:
        raise refused[0]
    poses = {index: pose for one in aligned for index, pose in one.world_from_cams.items()}
    inlier_idx = sorted(index for one in aligned for index in one.inlier_idx)
    return SessionPoses(poses, answers, inlier_idx)


def number_poses(poses: Sequence[Rigid3 | None], first: int = 0) -> dict[int, Rigid3]:
    """Return the known poses of successive frames by frame. `first` is that of the first one."""
    return {first + index: pose for index, pose in enumerate(poses) if pose is not None}


def select_queried_frames(poses: Mapping[int, Rigid3], config: MapConfig) -> list[int]:
    """Return the frames, of poses by frame, that are about as far apart as nodes."""
    frames, own = list(poses), list(poses.values())
    return [frames[row] for row in select_node_frames(own, config.d_thresh, config.lambda_rot)]


def align_motion_to_map(
    name: str,
    odom: Mapping[int, Rigid3],
    answers: Mapping[int, Localization | None],
    d_thresh: float,
    noise_scale: NoiseScale | None = None,
) -> SessionPoses:
    """Align a motion in its own world with the map, by localizations of some of its frames.

    `odom` holds the poses of the motion, and `answers` the localizations of the queried frames, by
    frame. `d_thresh` is that of the map, in metres. The noise scales of motion and localizations
    are estimated if `noise_scale` is None. Raises TrajectoryError if the map recognises too little
    of the session `name`, or contradicts the motion.
    """
    localized = {index: result for index, result in answers.items() if result is not None}
    inlier_idx = _find_consensus(name, odom, localized, len(answers), d_thresh)
    anchors = {k: localized[k] for k in inlier_idx}
    poses = _optimize_motion(odom, anchors, noise_scale or _estimate_noise(odom, anchors))
    return SessionPoses(poses, answers, inlier_idx)


def _find_consensus(
    name: str,
    odom: Mapping[int, Rigid3],
    localized: Mapping[int, Localization],
    num_queried: int,
    d_thresh: float,
) -> list[int]:
    """Return the largest set of localized frames that one transform of the motion explains. Raises
    TrajectoryError."""
    # Minimum share of the localized images that agree. The session is refused if the share is
    # smaller.
    min_share = 0.5
    if num_queried < MIN_AGREEING:
        many = f"{num_queried} of its pictures are"
        some = many if num_queried > 1 else "one of its pictures is"
        raise TrajectoryError(
            f"{name}: {some} as far apart as nodes of the map, too few to join: it takes"
            f" {MIN_AGREEING}; no map is changed"
        )
    if len(localized) < MIN_AGREEING:
        raise TrajectoryError(
            f"{name}: the map recognises {len(localized)} of {num_queried} pictures asked: another"
            " place, or changed; no map is changed"
        )
    precise = {k: one for k, one in localized.items() if one.position_sigma_m <= SLACK * d_thresh}
    if len(precise) >= MIN_AGREEING:
        localized = precise  # the others, such as those far ahead of the map, say nothing of places
    _check_scale(name, odom, localized)
    # Drift of the motion between two agreeing localizations: a share of the distance travelled, and
    # degrees per metre.
    tolerance = MotionTolerance(SLACK * d_thresh, SLACK_DEG, drift=0.03, drift_deg=0.3)
    inlier_idx = find_motion_consensus(odom, localized, tolerance, is_metric=True)
    if len(inlier_idx) < max(MIN_AGREEING, min_share * len(localized)):
        raise TrajectoryError(
            f"{name}: of {len(localized)} pictures that the map localizes {len(inlier_idx)} agree"
            " with its poses; no map is changed"
        )
    return inlier_idx


def _check_scale(
    name: str, odom: Mapping[int, Rigid3], localized: Mapping[int, Localization]
) -> None:
    """Check by distances between localized frames that the motion is in metres of the map. Raises
    TrajectoryError."""
    # Maximum relative difference between the motion's scale and the map's. Three sigmas of
    # the measured scale are added, and the ratio of one localization sigma to the longest
    # distance.
    max_scale, a = 0.03, np.array([odom[k].translation for k in localized])
    b = np.array([answer.world_from_cam.translation for answer in localized.values()])
    rows, columns = np.triu_indices(len(a), 1)
    odom_lengths, lengths = (np.linalg.norm(p[rows] - p[columns], axis=1) for p in (a, b))
    far = lengths > 0.5 * lengths.max()
    if (odom_lengths[far] == 0.0).any():
        return
    ratios = lengths[far] / odom_lengths[far]
    scale = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(ratios - scale)))
    # Localizations share errors, which their spread does not show. For a short motion this is the
    # largest part.
    sigma_m = float(np.median([answer.position_sigma_m for answer in localized.values()]))
    uncertainty = 3.0 * spread / np.sqrt(len(a)) + sigma_m / lengths.max()
    if abs(scale - 1.0) > max_scale + uncertainty:
        raise TrajectoryError(
            f"{name}: a metre of its poses is {scale:.3g} m of the map; no map is changed"
        )


def _optimize_motion(
    odom: Mapping[int, Rigid3], anchors: Mapping[int, Localization], noise_scale: NoiseScale
) -> dict[int, Rigid3]:
    """Optimize the motion with its anchors as a pose graph. The first node is the world of the map
    and is fixed."""
    indices, first = list(odom), min(anchors)
    world_from_odom = anchors[first].world_from_cam @ odom[first].inverse()
    cam_from_worlds = [Rigid3.identity(), *((world_from_odom @ odom[k]).inverse() for k in indices)]
    steps = [_relative_motion(odom[a], odom[b]) for a, b in pairwise(indices)]
    edges = [
        PoseGraphEdge(row, row + 1, step, noise_scale.motion**2 * spread, is_loop=False)
        for row, (step, spread) in enumerate(steps, 1)
    ]
    row_of = {index: row for row, index in enumerate(indices, 1)}
    for index, answer in anchors.items():
        covariance = (noise_scale.answers * WIDENED) ** 2 * answer.camera_covariance
        cam_from_world = answer.world_from_cam.inverse()
        edges.append(PoseGraphEdge(0, row_of[index], cam_from_world, covariance, is_loop=True))
    optimised = optimize_pose_graph(cam_from_worlds, edges)[1:]
    return {index: pose.inverse() for index, pose in zip(indices, optimised, strict=True)}


def _estimate_noise(odom: Mapping[int, Rigid3], anchors: Mapping[int, Localization]) -> NoiseScale:
    """Estimate the noise scales of the motion between anchors and of the anchors. The anchors'
    sigmas are not widened, because shared errors do not scatter."""
    # Candidate factors for the sigmas of the motion (stereo, RGB-D and given poses). The most
    # likely pair of a motion factor and an answer factor is selected.
    motion_factors = (0.5, 1.0, 3.0, 10.0)
    # Candidate factors for the sigmas of the localizations, applied in addition to `widened`.
    answer_factors = (1.0 / 3.0, 1.0)
    seen, moved, spread = list[LocalizedStep](), Rigid3.identity(), np.zeros((6, 6))
    before = None
    for index, pose in odom.items():
        if before is not None:
            step, of_step = _relative_motion(before, pose)
            moved, spread = step @ moved, step.transform_covariance(spread) + of_step
        before = pose
        if index in anchors:
            answer = anchors[index]
            cam_from_world, of_answer = answer.world_from_cam.inverse(), answer.camera_covariance
            seen.append(LocalizedStep(moved, spread, cam_from_world, of_answer))
            moved, spread = Rigid3.identity(), np.zeros((6, 6))
    return fit_noise_scale(seen, motion_factors, answer_factors)


def _relative_motion(
    odom_from_a: Rigid3, odom_from_b: Rigid3
) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
    """Return b_from_a and the covariance of its left perturbation."""
    # Sigma of the motion between images, as a share of the distance. A millimetre is added.
    drift = 0.01
    # Sigma of the rotation between images, in radians per metre and per radian of rotation.
    # Half a milliradian is added.
    turn_drift, b_from_a = 0.002, odom_from_b.inverse() @ odom_from_a
    path_length = float(np.linalg.norm(b_from_a.translation))
    sigma_m = 0.001 + drift * path_length
    sigma_rad = 0.0005 + turn_drift * (path_length + b_from_a.angle())
    return b_from_a, np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)
