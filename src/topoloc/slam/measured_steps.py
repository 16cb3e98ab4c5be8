"""Measure the camera motion between images of a recording, from the images alone.

A trajectory can be compared with these steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from topoloc.features.config import MatchingConfig
from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig
from topoloc.features.features import Features
from topoloc.features.matching import match_features
from topoloc.features.parallel import parallel_map
from topoloc.geometry.absolute_pose import estimate_absolute_pose
from topoloc.geometry.alignment import normalized_pose_error, rotation_error
from topoloc.geometry.camera import Camera
from topoloc.geometry.relative_pose import estimate_relative_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.points.metric_points import MetricPoints, locate_points
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.recording import read_left_frame

_MIN_ROTATION, ROTATION_TOLERANCE = math.radians(5.0), math.radians(1.5)
_TRANSLATION_TOLERANCE, _RELATIVE_TOLERANCE = 0.02, 0.15  # m, share of the step
_DEPTH_TOLERANCE = 0.01  # error of a measured translation, as a share of the depth
_MIN_TRANSLATION_RATIO = 3.0  # times the tolerance
_DIRECTION_TOLERANCE = math.radians(12.0)  # of a translation without scale


@dataclass(frozen=True, eq=False)
class MeasuredStep:
    """Hold the measured motion between the cameras of two frames.

    `median_depth` (metres) is that of the `num_inliers` points. For a single camera `has_scale` is
    False, the translation has length 1 and the depth is 0 (unknown).
    """

    first: int
    last: int
    first_from_last: Rigid3
    median_depth: float
    has_scale: bool = True
    num_inliers: int = 0

    @property
    def translation_tolerance(self) -> float:
        """Return the error of the measured translation, metres."""
        return _TRANSLATION_TOLERANCE + _DEPTH_TOLERANCE * self.median_depth

    def is_informative(self) -> bool:
        """Return whether the step is long enough to be compared with poses."""
        return not self.has_scale or not self.first_from_last.is_same(
            Rigid3.identity(), _MIN_TRANSLATION_RATIO * self.translation_tolerance, _MIN_ROTATION
        )

    def normalized_error(self, step: Rigid3) -> float:
        """Return the error of a step of poses in units of the tolerance. For a single camera only
        the direction of the translation is compared."""
        pose, theirs = self.first_from_last, step.translation
        radians = ROTATION_TOLERANCE + _RELATIVE_TOLERANCE * pose.angle()
        if self.has_scale:
            length = float(np.linalg.norm(pose.translation))
            metres = self.translation_tolerance + _RELATIVE_TOLERANCE * length
            return normalized_pose_error(step, pose, metres, radians)
        length = float(np.linalg.norm(theirs))
        cosine = np.clip(pose.translation @ theirs / length, -1.0, 1.0) if length > 0.0 else -1.0
        return max(math.acos(cosine) / _DIRECTION_TOLERANCE, rotation_error(step, pose) / radians)


def measure_steps(
    sequence: StereoSequence, usable_idx: list[int], num_steps: int = 16
) -> list[MeasuredStep]:
    """Measure steps spread over the frames `usable_idx` (rows, ascending).

    A step uses the left images and the depth of its first frame, or the images alone for a single
    camera. Steps with too few matches are skipped. All steps with one gap are measured before those
    with the next, so that the recording is read in order.

    Args:
        num_steps: number of first images of steps, spread over the recording.

    Raises:
        RecordingError, CalibrationError, UnreadableImageError: the recording cannot be read.
    """
    # Numbers of frames between the two images of a step, tried until one has enough matches.
    gaps = (12, 5, 2, 1)
    starts = np.unique(np.linspace(0, len(usable_idx) - 1, num_steps).astype(int)).tolist()
    firsts: dict[int, ViewFeatures] = {}
    steps: dict[int, MeasuredStep] = {}

    def measure(
        pair: tuple[int, int, StereoFrame | None, StereoFrame],
    ) -> tuple[int, ViewFeatures, MeasuredStep | None]:
        start, other, frame, other_frame = pair
        first = firsts[start] if frame is None else extract_view(frame)
        last = extract_view(other_frame, is_first=False)
        return start, first, estimate_step(usable_idx[start], usable_idx[other], first, last)

    for gap in gaps:  # backwards at the end of the recording
        pairs = [
            (start, start + gap if start + gap < len(usable_idx) else start - gap)
            for start in starts
            if start not in steps
        ]
        read = (
            (
                a,
                b,
                None if a in firsts else sequence[usable_idx[a]],
                read_left_frame(sequence, usable_idx[b]),
            )
            for a, b in pairs
            if b >= 0
        )
        for start, first, step in parallel_map(measure, read):
            firsts[start] = first
            if step is not None:
                steps[start] = step
    return [steps[start] for start in starts if start in steps]


@dataclass(frozen=True, eq=False)
class ViewFeatures:
    """Hold the features of a view. If it has `points`, there is one for each feature."""

    camera: Camera
    view_from_cam: Rigid3
    features: Features
    points: MetricPoints | None


def extract_view(frame: StereoFrame, is_first: bool = True) -> ViewFeatures:
    """Extract the features of a frame. Those of the first frame of a step are the ones with a 3-D
    position, unless it is a single image. Raises CalibrationError: no camera model."""
    has_depth = is_first and (frame.right is not None or frame.depth is not None)
    view = prepare_frame(frame, with_depth=has_depth)
    features, points = extract_features(view.grey, FeatureConfig()), None
    if has_depth:
        located = locate_points(features, view)
        rows = np.flatnonzero(located.valid)
        features = features.select(rows)
        points = MetricPoints(*(column[rows] for column in vars(located).values()))
    return ViewFeatures(view.camera, view.view_from_cam, features, points)


def estimate_step(
    first_idx: int, last_idx: int, first: ViewFeatures, last: ViewFeatures
) -> MeasuredStep | None:
    """Estimate the step between two views, of the frames with these indices. None if too few points
    match."""
    min_inliers = 40  # minimum number of points of the first image that match in the last
    matches = match_features(
        last.features.descriptors, first.features.descriptors, MatchingConfig()
    )
    if len(matches) < min_inliers:
        return None
    points_img = last.features.points_img[matches.query_idx].astype(np.float64)
    points = None
    if first.points is None:
        first_img = first.features.points_img[matches.train_idx].astype(np.float64)
        moved = estimate_relative_pose(first_img, first.camera, points_img, last.camera)
        motion = None if moved is None else (moved.second_from_first, moved.inliers)
    else:
        points = first.points.points_cam[matches.train_idx]
        covariances = first.points.covariances[matches.train_idx]
        pose = estimate_absolute_pose(
            points_img, points, last.camera, point_covariances=covariances
        )
        motion = None if pose is None else (pose.cam_from_world, pose.inliers)
    if motion is None or np.count_nonzero(motion[1]) < min_inliers:
        return None
    last_from_first, inliers = motion
    first_from_last = first.view_from_cam.inverse() @ last_from_first.inverse() @ last.view_from_cam
    depth = 0.0 if points is None else float(np.median(points[inliers, 2]))
    num_inliers, has_scale = int(np.count_nonzero(inliers)), points is not None
    return MeasuredStep(first_idx, last_idx, first_from_last, depth, has_scale, num_inliers)
