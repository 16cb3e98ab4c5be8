"""Visual odometry: where the camera went, frame after frame, and the key frames that remember it.

Read from `Odometry.process`. A frame's points are followed from the frame before, their landmarks give its pose (robust PnP), and where
too few of them are left, or the view has changed, it becomes a key frame: disparities are measured, new corners become
landmarks, and the last key frames are adjusted together. A camera that is lost is sought in the last places; after a while
it starts a sub-map of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32, Int

from topoloc.bounds import Above, AtLeast, Between
from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.stereo import ray_covariances
from topoloc.sequences.frame import StereoFrame
from topoloc.slam.bundle import BundleConfig, adjust_bundle
from topoloc.slam.disparity import DisparityConfig, MeasuredView, measure_disparities, measured_view
from topoloc.slam.frame_state import FramePose, LastFrame, Tracks
from topoloc.slam.input_checks import InputChecks
from topoloc.slam.keyframes import DisparityBias, KeyFrame, Landmarks, Motion, Observations, StereoCamera
from topoloc.slam.place_matching import PlaceMatchingConfig, match_places, place_view
from topoloc.slam.tracking import TrackingConfig, align_with_reference, find_corners, follow


@dataclass(frozen=True)
class OdometryConfig:
    """When a frame is tracked, and when it becomes a key frame."""

    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    disparity: DisparityConfig = field(default_factory=DisparityConfig)
    pose: AbsolutePoseConfig = field(
        default_factory=lambda: AbsolutePoseConfig(max_reprojection_error_px=2.0, sigma_px=0.5, max_iterations=300, min_iterations=20)
    )
    bundle: BundleConfig = field(default_factory=BundleConfig)
    places: PlaceMatchingConfig = field(default_factory=PlaceMatchingConfig)
    sigma_px: Annotated[float, Above(0)] = 0.3
    """Standard deviation of a tracked point."""
    sigma_bias_px: Annotated[float, Above(0)] = 1.0
    """How wrong all disparities together may be before the recording has shown by how much."""
    min_disparity_px: Annotated[float, Above(0)] = 0.5
    """What seems further away than this becomes no landmark."""
    sigma_landmark_px: Annotated[float, Above(0)] = 0.25
    """Uncertainty of a landmark's depth, as a disparity."""
    window: Annotated[int, Between(1, 1000)] = 8
    """Key frames that are adjusted together."""
    held: Annotated[int, Between(0, 1000)] = 5
    """Key frames before these that hold them in place."""
    min_tracked: Annotated[int, AtLeast(4)] = 25
    """Points that agree on a pose; a frame with fewer is lost."""
    min_tracked_share: Annotated[float, Between(0, 1)] = 0.35
    """Share of the points followed that must agree; a frame with fewer is lost."""
    keyframe_share: Annotated[float, Between(0, 1)] = 0.7
    """A key frame is due when so few of the last one's points are left."""
    keyframe_motion: Annotated[float, Above(0)] = 0.03
    """... or when they have moved in the picture by this share of its width (median)."""
    max_lost_tracked: Annotated[int, AtLeast(0)] = 3
    """The points of the last frame that was tracked are sought in so many more."""
    max_lost_frames: Annotated[int, AtLeast(0)] = 10
    """A camera that is lost for longer starts a new sub-map."""
    place_distance: Annotated[float, AtLeast(0)] = 0.1
    """A key frame keeps what it looks like (for loops) when it is this share of the median depth from the last that did ..."""
    place_angle_deg: Annotated[float, AtLeast(0)] = 8.0
    """... or turned by this angle."""


class Odometry:
    """The state of one recording's odometry. `keyframes` and `landmarks` are those of all recordings, and are added to."""

    def __init__(self, recording: int, keyframes: list[KeyFrame], landmarks: Landmarks, checks: InputChecks, config: OdometryConfig):
        self._recording, self._keyframes, self._landmarks = recording, keyframes, landmarks
        self._checks, self._config = checks, config
        self._last: LastFrame | None = None
        self._reference: KeyFrame | None = None
        self._reference_picture: np.ndarray = np.zeros((0, 0), np.float32)
        self._tracks = Tracks(np.zeros(0, np.int64), np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))
        self._chain: list[KeyFrame] = []  # the key frames since tracking began or began again
        self._num_lost = 0
        self._covariance = np.zeros((6, 6))
        self._bias = DisparityBias()

    def process(self, frame_idx: int, frame: StereoFrame) -> FramePose | None:
        """Where this frame is, or None where that is not known."""
        measured = measured_view(frame)
        if measured.right is not None:
            self._bias.information = 1.0 / self._config.sigma_bias_px**2
        cam_from_world = self._track(frame, measured)
        if cam_from_world is None:
            return self._lost(frame_idx, frame, measured)
        self._num_lost = 0
        self._remember(frame, measured, cam_from_world)
        assert self._reference is not None
        cam_from_keyframe = cam_from_world @ self._reference.cam_from_world.inverse()
        if self._is_keyframe_due(measured):
            self._add_keyframe(frame_idx, cam_from_world, measured, Motion(self._reference, self._covariance))
            cam_from_keyframe = Rigid3.identity()
        return FramePose(frame_idx, self._reference, cam_from_keyframe, measured.view.view_from_cam)

    def _track(self, frame: StereoFrame, measured: MeasuredView) -> Rigid3 | None:
        if self._last is None:
            return None
        pose = None
        for predicted in (self._predict(frame.t_ns), self._last.cam_from_world):
            tracks = self._follow(measured, predicted)
            pose = self._estimate_pose(tracks, measured.stereo, predicted)
            if pose is not None:
                self._tracks = tracks.select(pose.inliers)
                self._covariance = pose.covariance
                return pose.cam_from_world
        return None

    def _predict(self, t_ns: int) -> Rigid3:
        """Constant velocity."""
        last = self._last
        assert last is not None
        if last.motion is None or last.interval_ns <= 0:
            return last.cam_from_world
        share = min((t_ns - last.t_ns) / last.interval_ns, 3.0)
        return Rigid3.exp(share * last.motion.log()) @ last.cam_from_world

    def _follow(self, measured: MeasuredView, predicted: Rigid3) -> Tracks:
        assert self._last is not None
        config, tracks = self._config.tracking, self._tracks
        points_world = self._landmarks.positions[tracks.landmark_ids]
        before, after = (measured.stereo.project(pose.apply(points_world))[:, :2] for pose in (self._last.cam_from_world, predicted))
        limit = np.array([measured.view.camera.width, measured.view.camera.height]) / 2.0
        guesses = (tracks.points_img + np.clip(np.nan_to_num(after - before), -limit, limit)).astype(np.float32)
        found, is_found = follow(self._last.grey, measured.view.grey, tracks.points_img, guesses, config)
        tracks = Tracks(tracks.landmark_ids, found, tracks.points_ref).select(is_found)
        scales = self._patch_scales(tracks.landmark_ids, predicted)
        refined, alike = align_with_reference(self._reference_picture, measured.left, tracks.points_ref, tracks.points_img, scales, config)
        return Tracks(tracks.landmark_ids, refined, tracks.points_ref).select(alike)

    def _patch_scales(self, landmark_ids: Int[np.ndarray, " n"], predicted: Rigid3) -> Float32[np.ndarray, " n"]:
        """How much larger each landmark's surroundings look than in the last key frame: what is approached grows."""
        assert self._reference is not None
        points_world = self._landmarks.positions[landmark_ids]
        before, now = (pose.apply(points_world)[:, 2] for pose in (self._reference.cam_from_world, predicted))
        return np.clip(before / np.maximum(now, 1e-3), 0.5, 2.0).astype(np.float32)

    def _estimate_pose(self, tracks: Tracks, stereo: StereoCamera, predicted: Rigid3) -> AbsolutePose | None:
        config = self._config
        if len(tracks.landmark_ids) < config.min_tracked:
            return None
        points_world = self._landmarks.positions[tracks.landmark_ids]
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

    def _landmark_covariances(self, points_world: Float[np.ndarray, "n 3"], stereo: StereoCamera) -> Float[np.ndarray, "n 3 3"]:
        """In the world's axes, as the last key frame measured them."""
        assert self._reference is not None
        rotation = self._reference.cam_from_world.rotation
        points_cam = self._reference.cam_from_world.apply(points_world)
        sigma_z = self._config.sigma_landmark_px * points_cam[:, 2] ** 2 / stereo.bf
        covariances = ray_covariances(points_cam, sigma_z, stereo.camera, np.full(len(points_cam), 0.1))
        return rotation.T @ covariances @ rotation

    def _remember(self, frame: StereoFrame, measured: MeasuredView, cam_from_world: Rigid3) -> None:
        motion, interval = None, 0
        if self._last is not None:
            motion, interval = cam_from_world @ self._last.cam_from_world.inverse(), frame.t_ns - self._last.t_ns
        self._last = LastFrame(frame.t_ns, measured.view.grey, cam_from_world, motion, interval)

    def _is_keyframe_due(self, measured: MeasuredView) -> bool:
        assert self._reference is not None
        tracks, config = self._tracks, self._config
        if len(tracks.landmark_ids) < config.keyframe_share * np.count_nonzero(self._reference.observations.active):
            return True
        motion = np.median(np.linalg.norm(tracks.points_img - tracks.points_ref, axis=1))
        return bool(motion > config.keyframe_motion * measured.view.camera.width)

    def _add_keyframe(self, frame_idx: int, cam_from_world: Rigid3, measured: MeasuredView, motion: Motion | None) -> None:
        """Make the frame a key frame: measure, add landmarks, adjust the window, and follow its points from here on."""
        config = self._config
        points, landmark_ids = self._tracks.points_img, self._tracks.landmark_ids
        corners = find_corners(measured.view.grey, points, self._config.tracking)
        guesses = measured.stereo.project(cam_from_world.apply(self._landmarks.positions[landmark_ids]))[:, 2]
        all_points = np.concatenate([points, corners])
        bias = self._bias.value_px
        guesses = np.concatenate([guesses, np.full(len(corners), np.nan)]) + bias
        disparities, sigmas = measure_disparities(measured, all_points, guesses, self._config.disparity)
        values = np.column_stack([all_points.astype(np.float64), disparities])
        fresh = np.flatnonzero((disparities - bias)[len(points) :] > config.min_disparity_px) + len(points)
        unbiased = values[fresh] - [0.0, 0.0, bias]
        new_points = cam_from_world.inverse().apply(measured.stereo.points_cam(unbiased))
        rows = np.concatenate([np.arange(len(points)), fresh])
        ids = np.concatenate([landmark_ids, self._landmarks.add(new_points)])
        submap = motion.source.submap if motion is not None else self._next_submap()
        keyframe = KeyFrame(
            self._recording,
            frame_idx,
            submap,
            measured.stereo,
            cam_from_world,
            self._observations(ids, values[rows], sigmas[rows]),
            self._bias,
            motion,
        )
        self._keyframes.append(keyframe)
        self._chain.append(keyframe)
        self._adjust_window()
        self._follow_from(keyframe, measured)
        self._checks.look_at_keyframe(keyframe, self._landmarks, measured)
        if self._is_new_place(keyframe):
            keyframe.place = place_view(measured.view, self._config.places)

    def _observations(self, ids: np.ndarray, values: np.ndarray, sigmas: np.ndarray) -> Observations:
        weights = np.full((len(ids), 3), 1.0 / self._config.sigma_px)
        weights[:, 2] = np.where(np.isfinite(sigmas), 1.0 / sigmas, 0.0)
        return Observations(ids, values, weights, np.ones(len(ids), np.bool_))

    def _next_submap(self) -> int:
        return self._keyframes[-1].submap + 1 if self._keyframes else 0

    def _adjust_window(self) -> None:
        config = self._config
        free = self._chain[-config.window :]
        held = self._chain[: -config.window][-config.held :]
        adjust_bundle(free, held, self._landmarks, config.bundle)
        del self._chain[: -(config.window + config.held)]

    def _follow_from(self, keyframe: KeyFrame, measured: MeasuredView) -> None:
        seen = keyframe.observations
        points = np.ascontiguousarray(seen.measured[seen.active, :2], np.float32)
        self._tracks = Tracks(seen.landmark_ids[seen.active], points, points)
        self._reference, self._reference_picture = keyframe, measured.left
        if self._last is not None:
            self._last.cam_from_world = keyframe.cam_from_world

    def _is_new_place(self, keyframe: KeyFrame) -> bool:
        last = self._last_places(1)
        if not last:
            return True
        motion = keyframe.cam_from_world @ last[0].cam_from_world.inverse()
        seen = keyframe.observations
        depth = keyframe.cam_from_world.apply(self._landmarks.positions[seen.landmark_ids[seen.active]])[:, 2]
        far = np.linalg.norm(motion.translation) > self._config.place_distance * np.median(depth)
        return bool(far or motion.angle() > np.deg2rad(self._config.place_angle_deg))

    def _last_places(self, num: int) -> list[KeyFrame]:
        """The last key frames of this sub-map whose looks are known, newest first."""
        if self._reference is None:
            return []
        candidates = (k for k in reversed(self._keyframes) if k.recording == self._recording and k.submap == self._reference.submap)
        return [keyframe for keyframe in candidates if keyframe.place is not None][:num]

    def _lost(self, frame_idx: int, frame: StereoFrame, measured: MeasuredView) -> FramePose | None:
        """Seek the camera in the last places; after a while begin again."""
        self._num_lost += 1
        if self._num_lost > self._config.max_lost_tracked:
            self._last = None
        if self._reference is not None and self._num_lost <= self._config.max_lost_frames:
            found = self._relocalize(measured)
            if found is None:
                return None
            cam_from_world, motion = found
        else:
            cam_from_world, motion = Rigid3.identity(), None
            corners = find_corners(measured.view.grey, np.zeros((0, 2)), self._config.tracking)
            if not self._checks.can_start(frame, measured, corners, self._config.disparity):
                return None
        self._last, self._chain = None, []
        self._tracks = self._tracks.select(np.zeros(0, np.int64))
        self._add_keyframe(frame_idx, cam_from_world, measured, motion)
        self._remember(frame, measured, cam_from_world)
        self._num_lost = 0
        assert self._reference is not None
        return FramePose(frame_idx, self._reference, Rigid3.identity(), measured.view.view_from_cam)

    def _relocalize(self, measured: MeasuredView) -> tuple[Rigid3, Motion] | None:
        places = self._last_places(3)
        if not places:
            return None
        here = place_view(measured.view, self._config.places)
        for keyframe in places:
            assert keyframe.place is not None
            match = match_places(keyframe.place, here, measured.stereo, self._config.places)
            if match is not None:
                return match.target_from_source @ keyframe.cam_from_world, Motion(keyframe, match.covariance)
        return None
