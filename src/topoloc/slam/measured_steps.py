"""Measure the camera motion between images of a recording, from the images alone.

A trajectory can be compared with these steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from topoloc.compiled import parallel_map
from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig
from topoloc.features.features import Features, MatchingConfig
from topoloc.features.matching import find_similar_pairs, match_features
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
class SimilarFeatures:
    """Hold pairs of similar features of two views. Unlike a match, a feature may be in several.

    `first` are points in metres or, for a single camera, points on the plane z = 1 of the camera.
    `last` are on that plane of the last camera, `last_idx` are their features.
    """

    first: Float[np.ndarray, "n 3"]
    last: Float[np.ndarray, "n 3"]
    last_idx: Int[np.ndarray, " n"]
    max_error: float  # of `last`
    has_scale: bool

    def num_explained(self, first_from_last: Rigid3) -> int:
        """Return the number of features of the last view with a pair that fits a step. With scale
        the point projects onto the feature. Otherwise it lies in front of both cameras and the
        feature near its epipolar line (Sampson's error)."""
        last_from_first = first_from_last.inverse()
        t, rotated = last_from_first.translation, self.first @ last_from_first.rotation.T
        if self.has_scale:
            points = rotated + t
            errors = np.abs(points - points[:, 2:] * self.last).max(axis=1)
            fits = errors < self.max_error * points[:, 2]
        else:
            lines, normals = np.cross(t, rotated), np.cross(self.last, rotated)
            back = np.cross(self.last, t) @ last_from_first.rotation
            squares = np.square(np.column_stack([lines[:, :2], back[:, :2]])).sum(axis=1)
            fits = np.square(np.sum(self.last * lines, axis=1)) < self.max_error**2 * squares
            for rays in (self.last, rotated):  # the depth in the other camera is positive
                fits &= np.sum(np.cross(t, rays) * normals, axis=1) > 0.0
        return len(np.unique(self.last_idx[fits]))


@dataclass(frozen=True, eq=False)
class MatchedPoints:
    """Hold the points of the first view (metres) that match in the last, as `rays` on the plane z =
    1 of its rectified camera. `focal_baseline` (px m) is depth times disparity, None for measured
    depth."""

    points_cam: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    rays: Float[np.ndarray, "n 2"]
    camera: Camera
    view_from_cam: Rigid3
    focal_baseline: float | None


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
    similar: SimilarFeatures | None = None
    points: MatchedPoints | None = None

    @property
    def translation_tolerance(self) -> float:
        """Return the error of the measured translation, metres."""
        return _TRANSLATION_TOLERANCE + _DEPTH_TOLERANCE * self.median_depth

    def decides_on(self, step: Rigid3) -> bool:
        """Return whether the images decide between this and a step of poses: it is long enough, and
        another one does not explain them nearly as well.

        The direction of a single camera's short step, and a part of its rotation, hardly move the
        points. Where a texture repeats, the measured step may be that from panel to panel.
        """
        if self.has_scale and self.first_from_last.is_same(
            Rigid3.identity(), _MIN_TRANSLATION_RATIO * self.translation_tolerance, _MIN_ROTATION
        ):
            return False
        if self.similar is None or self.normalized_error(step) < 1.0:
            return True
        min_ratio = 0.35  # wrong poses: 0.0 to 0.3 for most steps
        measured = self.similar.num_explained(self.first_from_last)
        return self.similar.num_explained(step) < min_ratio * measured

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


def is_sum_of_short_steps(
    sequence: StereoSequence, step: MeasuredStep, usable_idx: list[int]
) -> bool:
    """Return whether short steps over the frames `usable_idx` between the ends of a step sum up to
    it, or cannot be measured.

    Where panels of a wall repeat, the images of a long step may show it less a panel.
    """
    max_gap = 2  # frames
    ends = usable_idx.index(step.first), usable_idx.index(step.last)
    between = range(*ends, max_gap if ends[1] > ends[0] else -max_gap)
    rows = [usable_idx[k] for k in (*between, ends[1])]
    if len(rows) < 3 or not step.has_scale:  # directions have no sum
        return True
    total, first = Rigid3.identity(), extract_view(sequence[rows[0]])
    for a, b in pairwise(rows):
        frame = sequence[b]
        short = estimate_step(a, b, first, extract_view(frame, is_first=False))
        if short is None:
            return True
        total, first = total @ short.first_from_last, extract_view(frame)
    return step.normalized_error(total) < 1.0


@dataclass(frozen=True, eq=False)
class ViewFeatures:
    """Hold the features of a view. If it has `points`, there is one for each feature."""

    camera: Camera
    view_from_cam: Rigid3
    features: Features
    points: MetricPoints | None
    focal_baseline: float | None = None


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
    scale = view.rig.left.fx * view.rig.baseline if view.rig is not None else None
    return ViewFeatures(view.camera, view.view_from_cam, features, points, scale)


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
    points, matched = None, None
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
        rays = last.camera.normalized_from_img(points_img)
        facts = last.camera, last.view_from_cam, first.focal_baseline
        matched = MatchedPoints(points, covariances, rays, *facts)
    if motion is None or np.count_nonzero(motion[1]) < min_inliers:
        return None
    last_from_first, inliers = motion
    first_from_last = first.view_from_cam.inverse() @ last_from_first.inverse() @ last.view_from_cam
    similar = _find_similar(first, last, matches.distances[inliers])
    depth = 0.0 if points is None else float(np.median(points[inliers, 2]))
    num_inliers, has_scale = int(np.count_nonzero(inliers)), points is not None
    return MeasuredStep(
        first_idx, last_idx, first_from_last, depth, has_scale, num_inliers, similar, matched
    )


def _find_similar(
    first: ViewFeatures, last: ViewFeatures, distances: Float[np.ndarray, " m"]
) -> SimilarFeatures:
    """Return the pairs that are as similar as most inliers, which have these distances of
    descriptors."""
    max_pairs, max_error_px = 20_000, 2.0
    min_similarity = 1.0 - 0.5 * float(np.percentile(distances, 80.0)) ** 2
    pairs = find_similar_pairs(
        last.features.descriptors, first.features.descriptors, max(min_similarity, 0.1)
    )
    last_idx, first_idx = (rows[:: 1 + len(rows) // max_pairs] for rows in pairs)
    firsts, lasts = (
        np.insert(view.camera.normalized_from_img(view.features.points_img[rows]), 2, 1.0, axis=1)
        for view, rows in ((first, first_idx), (last, last_idx))
    )
    if first.points is not None:
        firsts = first.points.points_cam[first_idx]
    firsts, lasts = firsts @ first.view_from_cam.rotation, lasts @ last.view_from_cam.rotation
    has_scale, max_error = first.points is not None, max_error_px / last.camera.fx
    return SimilarFeatures(firsts, lasts / lasts[:, 2:], last_idx, max_error, has_scale)
