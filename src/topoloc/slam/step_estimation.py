"""Estimate one step of the camera to the next frame, by point tracking and robust PnP.

On a repetitive wall, points of one panel are also found on the next one. The estimated step does
not show this. So the estimation is repeated from other start poses to find alternative steps.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32, Int

from topoloc.bounds import Above, AtLeast, Between
from topoloc.features.parallel import parallel_map
from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.stereo import ray_covariances
from topoloc.points.disparity import DisparityConfig, MeasuredView, StereoCamera
from topoloc.points.point_tracking import TrackingConfig, align_with_reference, track_points
from topoloc.slam.bundle_adjustment import BundleConfig
from topoloc.slam.keyframes import KeyFrame, Landmarks
from topoloc.slam.motion_prediction import Prediction, PredictionConfig
from topoloc.slam.place_matching import PlaceMatchingConfig


@dataclass(frozen=True)
class OdometryConfig:
    """Configure the tracking of frames and the selection of key frames."""

    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    prediction: PredictionConfig = field(default_factory=PredictionConfig)
    disparity: DisparityConfig = field(default_factory=DisparityConfig)
    pose: AbsolutePoseConfig = field(
        default_factory=lambda: AbsolutePoseConfig(
            max_reprojection_error_px=2.0, sigma_px=0.5, max_iterations=300, min_iterations=20
        )
    )
    bundle: BundleConfig = field(default_factory=BundleConfig)
    places: PlaceMatchingConfig = field(default_factory=PlaceMatchingConfig)
    sigma_px: Annotated[float, Above(0)] = 0.3
    """Standard deviation of a tracked point, pixels."""
    sigma_bias_px: Annotated[float, Above(0)] = 1.0
    """Prior standard deviation of the common disparity bias of a recording, pixels."""
    min_disparity_px: Annotated[float, Above(0)] = 0.5
    """Minimum disparity of a new landmark, pixels."""
    sigma_landmark_px: Annotated[float, Above(0)] = 0.25
    """Depth uncertainty of a landmark, as a disparity in pixels."""
    window: Annotated[int, Between(1, 1000)] = 8
    """Number of key frames that are adjusted together."""
    held: Annotated[int, Between(0, 1000)] = 5
    """Number of fixed key frames before the window."""
    min_tracked: Annotated[int, AtLeast(4)] = 25
    """Minimum number of points that agree on a pose. A frame with fewer is lost."""
    min_tracked_share: Annotated[float, Between(0, 1)] = 0.35
    """Minimum share of the tracked points that agree on a pose. A frame with fewer is lost."""
    keyframe_share: Annotated[float, Between(0, 1)] = 0.7
    """A frame becomes a key frame if fewer than this share of the last key frame's points are
    left."""
    keyframe_motion: Annotated[float, Above(0)] = 0.03
    """A frame also becomes a key frame if the points moved by this share of the image width
    (median)."""
    min_gap_share: Annotated[float, Between(0, 1)] = 0.5
    """Minimum share of the points found again for an unexpected step after a gap."""
    start_spacing_px: Annotated[float, Above(0)] = 25.0
    """Spacing of the start poses in the search for repetitions, pixels (median over the points)."""
    max_starts: Annotated[int, Between(0, 1000)] = 16
    """Maximum number of start poses in each direction along the motion."""
    repeat_depth: Annotated[float, AtLeast(0)] = 1.0
    """Extent of the start poses, as a share of the median depth. It is at least the predicted step
    and the uncertainty of the prediction."""
    repeat_share: Annotated[float, Between(0, 1)] = 0.3
    """Minimum share of the visible points that agree at a repetition."""
    max_repeats: Annotated[int, Between(0, 1000)] = 8
    """Maximum number of repetition periods by which a step may be off."""
    same_step: Annotated[float, Above(0)] = 0.04
    """Two steps are the same if they differ by less than this share of the median depth, and this
    many radians."""
    max_lost_tracked: Annotated[int, AtLeast(0)] = 3
    """Number of frames after a loss into which the last tracked points are still tracked."""
    max_lost_frames: Annotated[int, AtLeast(0)] = 10
    """Number of lost frames after which a new sub-map starts. It begins at the first of them that
    the others follow."""
    places_asked: Annotated[int, Between(0, 1000)] = 6
    """Number of last places in which a lost camera is relocalized."""
    place_distance: Annotated[float, AtLeast(0)] = 0.1
    """Minimum distance between key frames with place features (for loops), as a share of the median
    depth."""
    place_angle_deg: Annotated[float, AtLeast(0)] = 8.0
    """The rotation (degrees) after which a key frame also gets place features."""


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

    def select(self, rows: np.ndarray) -> Tracks:
        """Return the given rows."""
        return Tracks(
            self.landmark_ids[rows],
            self.points_img[rows],
            self.points_ref[rows],
            self.sigmas_px[rows],
        )


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
    """Estimate the step from the last frame to the next one, `measured`."""

    last: LastFrame
    reference: KeyFrame
    reference_image: Float32[np.ndarray, "h w"]
    tracks: Tracks
    landmarks: Landmarks
    measured: MeasuredView
    config: OdometryConfig

    def estimate_step(self, predicted: Rigid3) -> Step | None:
        """Estimate the step from a predicted cam_from_world. None if too few points agree."""
        tracks = self.track_points(predicted)
        pose = self.estimate_pose(tracks)
        if pose is None:
            return None
        should = max(int(np.count_nonzero(self._is_in_image(pose.cam_from_world))), 1)
        inlier_ratio = min(np.count_nonzero(pose.inliers) / should, 1.0)
        kept = tracks.select(pose.inliers)
        return Step(self.reference, pose.cam_from_world, pose.covariance, kept, inlier_ratio)

    def find_repeated_motions(self, prediction: Prediction) -> list[Rigid3]:
        """Return the motions after which the last image would look the same.

        The list is empty if the scene is not repetitive.
        """
        itself, last = replace(self, measured=self.last.measured), self.last.cam_from_world
        steps = parallel_map(itself.estimate_step, self._sample_start_poses(last, prediction))
        shifts = [
            step.cam_from_world @ last.inverse()
            for step in steps
            if step is not None and step.inlier_ratio > self.config.repeat_share
        ]
        shifts = [shift for shift in shifts if not self.is_close(shift, Rigid3.identity())]
        if not shifts:
            return []
        least = min(shifts, key=lambda shift: float(np.linalg.norm(shift.translation))).log()
        return [
            Rigid3.exp(k * least)
            for k in range(-self.config.max_repeats, self.config.max_repeats + 1)
            if k
        ]

    def _sample_start_poses(self, centre: Rigid3, prediction: Prediction) -> list[Rigid3]:
        """Return start poses around one along the predicted motion, as far apart as tracking
        converges."""
        config = self.config
        direction = prediction.step.log()
        way = float(np.linalg.norm(direction[:3]))
        if way < 1e-6:
            direction, way = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), 1.0
        direction = np.concatenate([direction[:3] / way, np.zeros(3)])
        apart = self._compute_start_spacing(centre, direction)
        sigma = prediction.sigma if np.isfinite(prediction.sigma) else 0.0
        moved = float(np.linalg.norm(prediction.step.translation))
        reach = max(
            config.prediction.max_sigmas * sigma, moved, config.repeat_depth * self._median_depth()
        )
        num = min(int(np.ceil(reach / apart)), config.max_starts)
        return [Rigid3.exp(k * apart * direction) @ centre for k in range(-num, num + 1) if k]

    def _compute_start_spacing(
        self, cam_from_world: Rigid3, direction: Float[np.ndarray, "6"]
    ) -> float:
        """Return the distance along a direction that moves the points by `start_spacing_px`."""
        points = self.landmarks.positions[self.tracks.landmark_ids]
        little = 0.01 * self._median_depth()
        poses = (cam_from_world, Rigid3.exp(little * direction) @ cam_from_world)
        here, there = (self.measured.stereo.project(pose.apply(points))[:, :2] for pose in poses)
        moved = np.linalg.norm(there - here, axis=1)
        moved = moved[np.isfinite(moved)]
        pixels = float(np.median(moved)) if len(moved) else 0.0
        return little * self.config.start_spacing_px / max(pixels, 1e-3)

    def _median_depth(self) -> float:
        """Return the median depth of the points in the last frame."""
        points = self.last.cam_from_world.apply(self.landmarks.positions[self.tracks.landmark_ids])
        return float(np.median(points[:, 2])) if len(points) else 1.0

    def is_close(self, a: Rigid3, b: Rigid3) -> bool:
        """Return whether two cam_from_world are the same within `same_step`."""
        same_step = self.config.same_step
        return a.inverse().is_same(b.inverse(), same_step * self._median_depth(), same_step)

    def _is_in_image(self, cam_from_world: Rigid3) -> np.ndarray:
        camera = self.measured.stereo.camera
        points = self.measured.stereo.project(
            cam_from_world.apply(self.landmarks.positions[self.tracks.landmark_ids])
        )
        with np.errstate(invalid="ignore"):
            return np.all(
                (points[:, :2] > 8.0) & (points[:, :2] < [camera.width - 9.0, camera.height - 9.0]),
                axis=1,
            )

    def track_points(self, predicted: Rigid3) -> Tracks:
        """Track the points from a predicted cam_from_world and align them with the last key
        frame."""
        config, tracks, measured = self.config.tracking, self.tracks, self.measured
        points_world = self.landmarks.positions[tracks.landmark_ids]
        before, after = (
            measured.stereo.project(pose.apply(points_world))[:, :2]
            for pose in (self.last.cam_from_world, predicted)
        )
        limit = np.array([measured.view.camera.width, measured.view.camera.height]) / 2.0
        guesses = (
            tracks.points_img + np.clip(np.nan_to_num(after - before), -limit, limit)
        ).astype(np.float32)
        found, is_found = track_points(
            self.last.measured.view.grey, measured.view.grey, tracks.points_img, guesses, config
        )
        tracks = replace(tracks, points_img=found).select(is_found)
        scales = self._patch_scales(tracks.landmark_ids, predicted)
        found = align_with_reference(
            self.reference_image,
            measured.left,
            tracks.points_ref,
            tracks.points_img,
            scales,
            config,
        )
        return replace(tracks, points_img=found.points_img, sigmas_px=found.sigmas_px).select(
            found.is_matched
        )

    def _patch_scales(
        self, landmark_ids: Int[np.ndarray, " n"], predicted: Rigid3
    ) -> Float32[np.ndarray, " n"]:
        """Return the scale of each landmark's patch relative to the last key frame, from the
        depths."""
        points_world = self.landmarks.positions[landmark_ids]
        before, now = (
            pose.apply(points_world)[:, 2] for pose in (self.reference.cam_from_world, predicted)
        )
        return np.clip(before / np.maximum(now, 1e-3), 0.5, 2.0).astype(np.float32)

    def estimate_pose(self, tracks: Tracks) -> AbsolutePose | None:
        """Estimate the pose that enough points agree on. None if there is none."""
        config, stereo = self.config, self.measured.stereo
        if len(tracks.landmark_ids) < config.min_tracked:
            return None
        points_world = self.landmarks.positions[tracks.landmark_ids]
        pose = estimate_absolute_pose(
            tracks.points_img.astype(np.float64),
            points_world,
            stereo.camera,
            config.pose,
            point_covariances=self._landmark_covariances(points_world, stereo),
        )
        if pose is None:
            return None
        num_inliers = int(np.count_nonzero(pose.inliers))
        enough = max(config.min_tracked, config.min_tracked_share * len(tracks.landmark_ids))
        return pose if num_inliers >= enough else None

    def _landmark_covariances(
        self, points_world: Float[np.ndarray, "n 3"], stereo: StereoCamera
    ) -> Float[np.ndarray, "n 3 3"]:
        """Return the landmark covariances in world axes, as measured by the last key frame."""
        rotation = self.reference.cam_from_world.rotation
        points_cam = self.reference.cam_from_world.apply(points_world)
        sigma_z = self.config.sigma_landmark_px * points_cam[:, 2] ** 2 / stereo.bf
        covariances = ray_covariances(
            points_cam, sigma_z, stereo.camera, np.full(len(points_cam), 0.1)
        )
        return rotation.T @ covariances @ rotation
