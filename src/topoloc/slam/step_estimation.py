"""Estimate one step of the camera to the next frame, by point tracking and robust PnP. Hold the
tracking state that stereo and monocular odometry share.

On a repetitive wall, points of one panel are also found on the next one. The estimated step does
not show this. So the estimation is repeated from other start poses to find alternative steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int

from topoloc.compiled import parallel_map
from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.rig import ray_covariances
from topoloc.geometry.rigid import Rigid3
from topoloc.points.metric_points import MeasuredView
from topoloc.points.point_tracking import follow_points
from topoloc.slam.keyframes import DisparityBias, KeyFrame, Landmarks
from topoloc.slam.motion_prediction import MotionHistory, Prediction


@dataclass(eq=False)
class Tracks:
    """Hold the tracked points: pixels in the last frame and the last key frame, and landmark ids.

    `sigmas_px` is the uncertainty of the former, from the appearance difference (pixels).
    """

    landmark_ids: Int[np.ndarray, " n"]
    points_img: Float32[np.ndarray, "n 2"]
    points_ref: Float32[np.ndarray, "n 2"]
    sigmas_px: Float32[np.ndarray, " n"]

    @classmethod
    def from_points(
        cls, landmark_ids: Int[np.ndarray, " n"], points_img: Float32[np.ndarray, "n 2"]
    ) -> Tracks:
        """Start tracks at these points."""
        return cls(landmark_ids, points_img, points_img, np.zeros(len(points_img), np.float32))

    @classmethod
    def empty(cls) -> Tracks:
        """Return no tracks."""
        return cls.from_points(np.zeros(0, np.int64), np.zeros((0, 2), np.float32))

    def median_motion_px(self) -> float:
        """Return the median distance from the last key frame's pixels, 0 without points."""
        moved = np.linalg.norm(self.points_img - self.points_ref, axis=1)
        return float(np.median(moved)) if len(moved) else 0.0

    def select(self, rows: np.ndarray | slice) -> Tracks:
        """Return the given rows."""
        return Tracks(*(column[rows] for column in vars(self).values()))


@dataclass(eq=False)
class LastFrame:
    """Hold the preceding frame."""

    measured: MeasuredView
    cam_from_world: Rigid3


@dataclass(frozen=True, eq=False)
class Step:
    """Hold a pose that enough points agree on.

    `reference` is the last key frame. `inlier_ratio` is the share of inliers among the points that
    should be visible.
    """

    reference: KeyFrame
    cam_from_world: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    tracks: Tracks
    inlier_ratio: float


@dataclass(frozen=True, eq=False)
class StepEstimator:
    """Estimate the step from the last frame to the next one, `measured`.

    A pose needs `min_tracked` points that agree. `patch_half_px` is the half side of the patches
    that are compared with the last key frame.
    """

    last: LastFrame
    reference: KeyFrame
    reference_image: Float32[np.ndarray, "h w"]
    tracks: Tracks
    landmarks: Landmarks
    measured: MeasuredView
    min_tracked: int
    patch_half_px: int

    @property
    def points_world(self) -> Float[np.ndarray, "n 3"]:
        """Return the landmarks of the points."""
        return self.landmarks.positions[self.tracks.landmark_ids]

    def estimate_step(self, *predicted: Rigid3) -> Step | None:
        """Estimate the step from the first predicted cam_from_world from which enough points agree.
        None if there is none."""
        for start in predicted:
            tracks = self.track_points(start)
            pose = self.estimate_pose(tracks)
            if pose is not None:
                stereo, points_world = self.measured.stereo, self.points_world
                pixels = stereo.project(pose.cam_from_world.apply(points_world))[:, :2]
                size = np.array([stereo.camera.width, stereo.camera.height])
                with np.errstate(invalid="ignore"):
                    is_inside = np.all((pixels > 8.0) & (pixels < size - 9.0), axis=1)
                should = max(int(np.count_nonzero(is_inside)), 1)
                inlier_ratio = min(np.count_nonzero(pose.inliers) / should, 1.0)
                kept = tracks.select(pose.inliers)
                return Step(
                    self.reference, pose.cam_from_world, pose.covariance, kept, inlier_ratio
                )
        return None

    def find_repeated_motions(self, prediction: Prediction) -> list[Rigid3]:
        """Return the motions after which the last image would look the same.

        The list is empty if the scene is not repetitive.
        """
        min_share = 0.3  # minimum share of the visible points that agree at a repetition
        max_repeats = 8  # maximum number of repetition periods by which a step may be off
        itself, last = replace(self, measured=self.last.measured), self.last.cam_from_world
        steps = itself._search(self._sample_start_poses(last, prediction), last, min_share)
        shifts = [
            step.cam_from_world @ last.inverse() for step in steps if step.inlier_ratio > min_share
        ]
        shifts = [shift for shift in shifts if not self.is_close(shift, Rigid3.identity())]
        if not shifts:
            return []
        least = min(shifts, key=lambda shift: float(np.linalg.norm(shift.translation))).log()
        return [Rigid3.exp(k * least) for k in range(-max_repeats, max_repeats + 1) if k]

    def find_similar_steps(
        self, step: Step, prediction: Prediction, repeated: Sequence[Rigid3] = ()
    ) -> list[Rigid3]:
        """Return which cam_from_world, of the step and of others along the motion, nearly as many
        of the visible points agree on, after those that are known to look the same."""
        min_share = 0.8  # of the largest inlier ratio
        if np.isinf(prediction.sigma):
            moved = step.cam_from_world @ self.last.cam_from_world.inverse()
            prediction = replace(prediction, step=moved)
        pose = step.cam_from_world
        again, least = self.estimate_step(pose), min_share * step.inlier_ratio
        found = [one for one in [again] if one is not None]
        found += self._search(self._sample_start_poses(pose, prediction), pose, least)
        enough = min_share * max((one.inlier_ratio for one in found), default=0.0)
        poses = list(repeated)
        for pose in (one.cam_from_world for one in found if one.inlier_ratio >= enough):
            if not any(self.is_close(pose, known) for known in poses):
                poses.append(pose)
        return poses

    def _search(
        self, starts: Sequence[Rigid3], known: Rigid3, min_inlier_ratio: float
    ) -> list[Step]:
        """Return the steps from other start poses (cam_from_world) to poses that are not close to a
        known one, those at first sight with too few inliers left out.

        First sight is that of every third point, or of more if the points are few.
        """
        loss = 0.7  # of `min_inlier_ratio` suffices at first sight
        stride = min(max(len(self.tracks.landmark_ids) // (4 * self.min_tracked), 1), 3)
        thinned = replace(self, tracks=self.tracks.select(slice(None, None, stride)))
        sketches = parallel_map(thinned.estimate_step, starts)
        promising = [
            one.cam_from_world
            for one in sketches
            if one is not None
            and one.inlier_ratio > loss * min_inlier_ratio
            and not self.is_close(one.cam_from_world, known)
        ]
        return [one for one in parallel_map(self.estimate_step, promising) if one is not None]

    def _sample_start_poses(self, centre: Rigid3, prediction: Prediction) -> list[Rigid3]:
        """Return start poses around one along the predicted motion, as far apart as tracking
        converges."""
        min_extent = 1.0  # minimum extent of the start poses, as a share of the median depth
        max_starts = 16  # maximum number of start poses in each direction along the motion
        direction = prediction.step.log()
        way = float(np.linalg.norm(direction[:3]))
        if way < 1e-6:
            direction, way = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 1.0
        direction = np.concatenate([direction[:3] / way, np.zeros(3)])
        apart = self._compute_start_spacing(centre, direction)
        sigma = prediction.sigma if np.isfinite(prediction.sigma) else 0.0
        moved = float(np.linalg.norm(prediction.step.translation))
        reach = max(prediction.max_sigmas * sigma, moved, min_extent * self._median_depth())
        num = min(int(np.ceil(reach / apart)), max_starts)
        return [Rigid3.exp(k * apart * direction) @ centre for k in range(-num, num + 1) if k]

    def _compute_start_spacing(
        self, cam_from_world: Rigid3, direction: Float[np.ndarray, "6"]
    ) -> float:
        """Return the distance along a direction that moves the points by `start_spacing_px`."""
        # Spacing of the start poses in the search for repetitions, pixels (median over
        # the points).
        spacing_px = 25.0
        points, little = self.points_world, 0.01 * self._median_depth()
        poses = (cam_from_world, Rigid3.exp(little * direction) @ cam_from_world)
        here, there = (self.measured.stereo.project(pose.apply(points))[:, :2] for pose in poses)
        moved = np.linalg.norm(there - here, axis=1)
        moved = moved[np.isfinite(moved)]
        pixels = float(np.median(moved)) if len(moved) else 0.0
        return little * spacing_px / max(pixels, 1e-3)

    def _median_depth(self) -> float:
        """Return the median depth of the points in the last frame."""
        points = self.last.cam_from_world.apply(self.points_world)
        return float(np.median(points[:, 2])) if len(points) else 1.0

    def is_close(self, a: Rigid3, b: Rigid3) -> bool:
        """Return whether two cam_from_world are nearly the same."""
        limit = 0.04  # maximum difference, as a share of the median depth and in radians
        return a.inverse().is_same(b.inverse(), limit * self._median_depth(), limit)

    def track_points(self, predicted: Rigid3) -> Tracks:
        """Track the points from a predicted cam_from_world and align them with the last key
        frame."""
        tracks, measured = self.tracks, self.measured
        before, after = (
            measured.stereo.project(pose.apply(self.points_world))[:, :2]
            for pose in (self.last.cam_from_world, predicted)
        )
        in_reference, now = (
            pose.apply(self.points_world)[:, 2]
            for pose in (self.reference.cam_from_world, predicted)
        )
        rows, aligned = follow_points(
            self.last.measured.view.grey,
            measured.view.grey,
            tracks.points_img,
            after - before,
            self.reference_image,
            tracks.points_ref,
            (in_reference, now),
            patch_half_px=self.patch_half_px,
        )
        found = {"points_img": aligned.points_img, "sigmas_px": aligned.sigmas_px}
        return replace(tracks.select(rows), **found)

    def estimate_pose(self, tracks: Tracks) -> AbsolutePose | None:
        """Estimate the pose that enough points agree on. None if there is none."""
        # Minimum share of the tracked points that agree on a pose. A frame with fewer is lost.
        min_share = 0.35
        sigma_px = 0.25  # depth uncertainty of a landmark, as a disparity in pixels
        stereo, reference_from_world = self.measured.stereo, self.reference.cam_from_world
        if len(tracks.landmark_ids) < self.min_tracked:
            return None
        points_world = self.landmarks.positions[tracks.landmark_ids]
        # The covariances of the landmarks, as measured by the last key frame.
        points_cam = reference_from_world.apply(points_world)
        rotation = reference_from_world.rotation
        sigma_z = sigma_px * points_cam[:, 2] ** 2 / stereo.bf
        covariances = ray_covariances(
            points_cam, sigma_z, stereo.camera, np.full(len(points_cam), 0.1)
        )
        pose = estimate_absolute_pose(
            tracks.points_img.astype(np.float64),
            points_world,
            stereo.camera,
            AbsolutePoseConfig(
                max_reprojection_error_px=2.0, sigma_px=0.5, max_iterations=300, min_iterations=20
            ),
            point_covariances=rotation.T @ covariances @ rotation,
        )
        if pose is None:
            return None
        num_inliers = int(np.count_nonzero(pose.inliers))
        enough = max(self.min_tracked, min_share * len(tracks.landmark_ids))
        return pose if num_inliers >= enough else None


class FrameTracker:
    """Hold the last frame, the last key frame (reference), the points tracked since, and the key
    frames of the adjusted window."""

    def __init__(self, landmarks: Landmarks, *, min_tracked: int, patch_half_px: int) -> None:
        """Start without a frame. `StepEstimator` explains the numbers."""
        self._landmarks = landmarks
        self._min_tracked, self._patch_half_px = min_tracked, patch_half_px
        self._last_frame: LastFrame | None = None
        self._reference: KeyFrame | None = None
        self._reference_image: Float32[np.ndarray, "h w"] = np.zeros((0, 0), np.float32)
        self._tracks = Tracks.empty()
        self._recent_keyframes: list[KeyFrame] = []  # key frames since tracking last started
        self._num_lost = 0
        self._history = MotionHistory()
        self._bias = DisparityBias()

    def _step_estimator(
        self, last: LastFrame, reference: KeyFrame, tracks: Tracks, measured: MeasuredView
    ) -> StepEstimator:
        return StepEstimator(
            last,
            reference,
            self._reference_image,
            tracks,
            self._landmarks,
            measured,
            self._min_tracked,
            self._patch_half_px,
        )

    def _update_last_frame(self, t_ns: int, measured: MeasuredView, cam_from_world: Rigid3) -> None:
        last = self._last_frame
        moved = None if last is None else cam_from_world @ last.cam_from_world.inverse()
        self._history.add_pose(t_ns, cam_from_world, moved)
        self._last_frame = LastFrame(measured, cam_from_world)

    def _is_keyframe_due(self, reference: KeyFrame, measured: MeasuredView) -> bool:
        """Return whether too few points are left since the reference, or they moved too far."""
        min_share = 0.7  # of the reference's points
        max_motion = 0.03  # median, as a share of the image width
        num_active = np.count_nonzero(reference.observations.active)
        if len(self._tracks.landmark_ids) < min_share * num_active:
            return True
        return self._tracks.median_motion_px() > max_motion * measured.view.camera.width

    def _set_reference(self, keyframe: KeyFrame, measured: MeasuredView) -> None:
        """Continue tracking from a key frame, which is the last frame."""
        seen = keyframe.observations
        points = np.ascontiguousarray(seen.measured[seen.active, :2], np.float32)
        self._tracks = Tracks.from_points(seen.active_ids, points)
        self._reference, self._reference_image = keyframe, measured.left
        if self._last_frame is not None:
            self._last_frame.cam_from_world = keyframe.cam_from_world
            self._history.update_last_pose(keyframe.cam_from_world)
