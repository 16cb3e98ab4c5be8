"""Measure the camera motion between images of a recording, from the images alone.

A trajectory can be compared with these steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topoloc.features.config import MatchingConfig
from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig
from topoloc.features.features import Features
from topoloc.features.matching import match_features
from topoloc.features.parallel import parallel_map
from topoloc.geometry.absolute_pose import AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.camera import Camera
from topoloc.geometry.relative_pose import estimate_relative_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.points.metric_points import MetricPoints, locate_points
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.recording import read_left_frame


@dataclass(frozen=True, eq=False)
class MeasuredStep:
    """Hold the measured motion between the cameras of two frames.

    `median_depth` (metres) is that of the inliers. For a single camera `has_scale` is False, the
    translation has length 1 and the depth is 0 (unknown).
    """

    first: int
    last: int
    first_from_last: Rigid3
    median_depth: float
    has_scale: bool = True


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
    firsts: dict[int, _ViewFeatures] = {}
    steps: dict[int, MeasuredStep] = {}

    def measure(
        pair: tuple[int, int, StereoFrame | None, StereoFrame],
    ) -> tuple[int, _ViewFeatures, MeasuredStep | None]:
        start, other, frame, other_frame = pair
        first = firsts[start] if frame is None else _extract_view(frame, is_first=True)
        motion = _estimate_motion(first, last := _extract_view(other_frame, is_first=False))
        if motion is None:
            return start, first, None
        first_from_last = first.view_from_cam.inverse() @ motion[0].inverse() @ last.view_from_cam
        return (
            start,
            first,
            MeasuredStep(
                usable_idx[start],
                usable_idx[other],
                first_from_last,
                motion[1],
                has_scale=first.points is not None,
            ),
        )

    for gap in gaps:  # backwards at the end of the recording
        pairs = (
            (start, start + gap if start + gap < len(usable_idx) else start - gap)
            for start in starts
            if start not in steps
        )
        pairs = [pair for pair in pairs if pair[1] >= 0]
        read = (
            (
                a,
                b,
                None if a in firsts else sequence[usable_idx[a]],
                read_left_frame(sequence, usable_idx[b]),
            )
            for a, b in pairs
        )
        for start, first, step in parallel_map(measure, read):
            firsts[start] = first
            if step is not None:
                steps[start] = step
    return [steps[start] for start in starts if start in steps]


@dataclass(frozen=True, eq=False)
class _ViewFeatures:
    camera: Camera
    view_from_cam: Rigid3
    features: Features
    points: MetricPoints | None


def _extract_view(frame: StereoFrame, is_first: bool) -> _ViewFeatures:
    has_depth = is_first and (frame.right is not None or frame.depth is not None)
    view = prepare_frame(frame, with_depth=has_depth)
    features = extract_features(view.grey, FeatureConfig())
    if not has_depth:
        return _ViewFeatures(view.camera, view.view_from_cam, features, None)
    located = locate_points(features, view)
    rows = np.flatnonzero(located.valid)
    points = MetricPoints(located.points_cam[rows], located.covariances[rows], located.valid[rows])
    return _ViewFeatures(view.camera, view.view_from_cam, features.select(rows), points)


def _estimate_motion(first: _ViewFeatures, last: _ViewFeatures) -> tuple[Rigid3, float] | None:
    """Estimate last_from_first of the views, and the median depth of the inliers.

    For a single camera the depth is 0 and the translation has length 1. None if too few points
    match.
    """
    min_inliers = 40  # minimum number of points of the first image that match in the last
    matches = match_features(
        last.features.descriptors, first.features.descriptors, MatchingConfig()
    )
    if len(matches) < min_inliers:
        return None
    points_img = last.features.points_img[matches.query_idx].astype(np.float64)
    if first.points is None:
        first_img = first.features.points_img[matches.train_idx].astype(np.float64)
        moved = estimate_relative_pose(first_img, first.camera, points_img, last.camera)
        is_seen = moved is not None and np.count_nonzero(moved.inliers) >= min_inliers
        return (moved.second_from_first, 0.0) if is_seen and moved is not None else None
    points, covariances = (
        first.points.points_cam[matches.train_idx],
        first.points.covariances[matches.train_idx],
    )
    pose = estimate_absolute_pose(
        points_img, points, last.camera, AbsolutePoseConfig(), point_covariances=covariances
    )
    if pose is None or np.count_nonzero(pose.inliers) < min_inliers:
        return None
    return pose.cam_from_world, float(np.median(points[pose.inliers, 2]))
