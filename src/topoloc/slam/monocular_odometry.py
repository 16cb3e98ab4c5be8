"""Odometry of a single camera: its motion, sub-map by sub-map, each with an unknown scale.

`MonocularOdometry.process` is the entry point. Two images with enough parallax start a sub-map
(five-point method). Their distance is its unit of length. From there on, points are tracked and
give each frame's pose, as in stereo odometry (`step_estimation.py`). Points without depth are
tracked too, and become landmarks once their rays meet at a sufficient angle. The last key frames
are adjusted together. If too few points are left, the sub-map ends and another one starts with its
own unit. The motion between them is not estimated. The scale in metres is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Float32, Int

from topoloc.geometry.relative_pose import estimate_relative_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.points.metric_points import MeasuredView, StereoCamera
from topoloc.points.point_tracking import find_corners, track_points
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.frame_preparation import undistort_frame
from topoloc.slam.bundle.bundle_adjustment import adjust_bundle, adjust_window
from topoloc.slam.keyframes import (
    FramePose,
    KeyFrame,
    KeyFrameObservations,
    Landmarks,
    Motion,
    triangulate_points,
)
from topoloc.slam.step_estimation import FrameTracker, LastFrame, Step, Tracks

_PATCH_HALF_PX = 7


@dataclass(frozen=True, eq=False)
class MonocularSubmap:
    """Hold an uninterrupted motion in its own world and unit: frames, key frames and landmarks. The
    frames' poses are relative to key frames."""

    landmarks: Landmarks
    frames: list[FramePose] = field(default_factory=list)
    keyframes: list[KeyFrame] = field(default_factory=list)

    def submap_from_cams(self) -> dict[int, Rigid3]:
        """Return world_from_cam of its frames by frame index, in its own world and unit."""
        return {pose.frame_idx: pose.world_from_cam() for pose in self.frames}


@dataclass(frozen=True, eq=False)
class _Image:
    """Hold a frame, prepared for measurements."""

    frame_idx: int
    t_ns: int
    measured: MeasuredView


class MonocularOdometry(FrameTracker):
    """Hold the state of one recording's odometry. `submaps` holds the sub-maps so far."""

    def __init__(self) -> None:
        super().__init__(Landmarks(), min_tracked=15, patch_half_px=_PATCH_HALF_PX)
        self.submaps: list[MonocularSubmap] = []
        # The images since the first one of a sub-map that has not started yet, each with its
        # remaining points of the first image.
        self._initial_images: list[tuple[_Image, Tracks]] = []
        self._untriangulated = Tracks.empty()

    def process(self, frame_idx: int, frame: StereoFrame) -> None:
        """Process the next frame."""
        # Number of frames after a loss into which the last tracked points are still tracked.
        max_lost_tracked = 3
        max_side_px = 800  # images are reduced to this width or height for point tracking
        view = undistort_frame(frame, max_side_px)
        stereo = StereoCamera(view.camera, view.camera.fx)  # the unit replaces the baseline
        measured = MeasuredView(view, stereo, view.grey.astype(np.float32), None)
        image = _Image(frame_idx, frame.t_ns, measured)
        if self._reference is not None:
            self._num_lost = 0 if self._track_image(image) else self._num_lost + 1
            if self._num_lost <= max_lost_tracked:
                return
            self._reference, self._last_frame, self._num_lost = None, None, 0
            self._history.reset()
        self._initialize(image)

    def _initialize(self, image: _Image) -> None:
        """Track the corners of a first image until two images show enough motion."""
        # If fewer than this share of its points are left, the first image is replaced by a later
        # one. It is also replaced after this many frames, as a camera at rest gives no depth.
        min_share, max_frames = 0.2, 60
        min_motion = 0.03  # median of the points to start a sub-map, as a share of the image width
        if self._initial_images:
            tracks = self._track_bidirectional(image.measured)
            left = len(tracks.landmark_ids) / max(len(self._initial_images[0][1].landmark_ids), 1)
            self._initial_images.append((image, tracks))
            if left >= min_share and len(self._initial_images) <= max_frames:
                if tracks.median_motion_px() > min_motion * image.measured.view.camera.width:
                    self._start_submap()
                return
        corners = _find_corners(image.measured, np.zeros((0, 2)))
        self._initial_images = [(image, Tracks.from_points(np.arange(len(corners)), corners))]

    def _track_bidirectional(self, measured: MeasuredView) -> Tracks:
        """Return the points found in the next image that are tracked back to their start."""
        max_error_px = 0.7  # maximum error of a point tracked forwards and backwards, pixels
        last, tracks = self._initial_images[-1]
        before, now = last.measured.view.grey, measured.view.grey
        found, there = track_points(before, now, tracks.points_img, tracks.points_img)
        back, again = track_points(now, before, found, tracks.points_img)
        returned = np.linalg.norm(back - tracks.points_img, axis=1) < max_error_px
        return replace(tracks, points_img=found).select(np.flatnonzero(there & again & returned))

    def _start_submap(self) -> None:
        """Start a sub-map if the relative pose of the first and the last image can be estimated."""
        min_points = 50  # minimum number of triangulated points to start a sub-map
        (first, all_tracks), *_, (last, tracks) = self._initial_images
        motion = estimate_relative_pose(
            tracks.points_ref.astype(np.float64),
            first.measured.view.camera,
            tracks.points_img.astype(np.float64),
            last.measured.view.camera,
        )
        if motion is None or np.count_nonzero(motion.inliers) < min_points:
            return
        self._landmarks = Landmarks()
        self._landmarks.add(np.full((len(all_tracks.landmark_ids), 3), np.nan))
        agreeing = tracks.select(motion.inliers)
        ids = agreeing.landmark_ids
        self._recent_keyframes = [
            self._make_keyframe(
                image, pose, self._make_observations(Tracks.empty(), Tracks.from_points(ids, px))
            )
            for image, pose, px in (
                (first, Rigid3.identity(), agreeing.points_ref),
                (last, motion.second_from_first, agreeing.points_img),
            )
        ]
        known = self._triangulate_tracks(ids)
        if len(known) < min_points:
            self._recent_keyframes = []
            return
        adjust_bundle(self._recent_keyframes, [], self._landmarks, max_steps=12)
        self.submaps.append(
            MonocularSubmap(self._landmarks, keyframes=list(self._recent_keyframes))
        )
        images, self._initial_images, self._last_frame = self._initial_images[:-1], [], None
        self._history.reset()
        for image, of_image in images:
            self._register_image(image, of_image.select(np.isin(of_image.landmark_ids, known)))
        keyframe = self._recent_keyframes[-1]
        self._set_reference_keyframe(keyframe, last.measured, agreeing.select(~np.isin(ids, known)))
        self._update_last_frame(last.t_ns, last.measured, keyframe.cam_from_world)
        self._add_pose(last, keyframe, Rigid3.identity())

    def _register_image(self, image: _Image, tracks: Tracks) -> None:
        """Estimate the pose of an image before the start, from the triangulated points."""
        first = self._recent_keyframes[0]
        pose = Rigid3.identity()
        if image.frame_idx != first.frame_idx:
            last = LastFrame(image.measured, first.cam_from_world)
            found = self._step_estimator(last, first, tracks, image.measured).estimate_pose(tracks)
            if found is None:
                return
            pose = found.cam_from_world
        self._update_last_frame(image.t_ns, image.measured, pose)
        self._add_pose(image, first, pose @ first.cam_from_world.inverse())

    def _add_pose(self, image: _Image, keyframe: KeyFrame, cam_from_keyframe: Rigid3) -> None:
        view_from_cam = image.measured.view.view_from_cam
        self.submaps[-1].frames.append(
            FramePose(image.frame_idx, keyframe, cam_from_keyframe, view_from_cam)
        )

    def _track_image(self, image: _Image) -> bool:
        """Track the points into the image and add its pose. Return False if it fails."""
        last, reference, measured = self._last_frame, self._reference, image.measured
        prediction = self._history.predict(image.t_ns)
        if last is None or reference is None or prediction is None:
            return False
        step = self._step_estimator(last, reference, self._tracks, measured).estimate_step(
            prediction.cam_from_world, last.cam_from_world
        )
        if step is None:
            return False
        self._tracks = step.tracks
        self._untriangulated = self._step_estimator(
            last, reference, self._untriangulated, measured
        ).track_points(step.cam_from_world)
        self._update_last_frame(image.t_ns, measured, step.cam_from_world)
        if self._is_keyframe_due(reference, measured):
            self._add_pose(image, self._add_keyframe(image, step), Rigid3.identity())
        else:
            relative = step.cam_from_world @ reference.cam_from_world.inverse()
            self._add_pose(image, reference, relative)
        return True

    def _add_keyframe(self, image: _Image, step: Step) -> KeyFrame:
        """Add the image as a key frame and return it. Triangulated points become landmarks, new
        corners are added as untriangulated points, and the window is adjusted."""
        tracks, untriangulated, measured = self._tracks, self._untriangulated, image.measured
        occupied = np.concatenate([tracks.points_img, untriangulated.points_img])
        corners = _find_corners(measured, occupied)
        fresh = Tracks.from_points(
            self._landmarks.add(self._predict_positions(corners, measured, step.cam_from_world)),
            corners,
        )
        seen = self._make_observations(tracks, untriangulated, fresh)
        keyframe = self._make_keyframe(image, step.cam_from_world, seen)
        keyframe.motion = Motion(step.reference, step.covariance)
        self._recent_keyframes.append(keyframe)
        self.submaps[-1].keyframes.append(keyframe)
        known = self._triangulate_tracks(np.sort(untriangulated.landmark_ids))
        # The window is longer than that of stereo odometry, because it alone preserves the scale.
        adjust_window(self._recent_keyframes, self._landmarks, 20, 10, max_steps=12)
        ids = untriangulated.landmark_ids
        is_finite = np.isfinite(self._landmarks.positions[ids]).all(axis=1)
        still = untriangulated.select(~np.isin(ids, known) & is_finite)
        self._set_reference_keyframe(keyframe, measured, _concatenate_tracks(still, fresh))
        return keyframe

    def _triangulate_tracks(self, ids: Int[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
        """Triangulate the points with these ids (ascending), and return the ids of new landmarks.
        The positions of points whose rays do not meet are set to NaN."""
        min_rays = 2  # minimum number of key frames that see a landmark
        min_parallax_deg = 1.0  # minimum angle between the rays of a landmark, degrees
        max_error_px = 1.5  # maximum reprojection error of a new landmark in all its key frames
        if len(ids) == 0:
            return ids
        points, num_rays, parallax, errors_px = triangulate_points(self._recent_keyframes, ids)
        with np.errstate(invalid="ignore"):
            is_clear = errors_px <= max_error_px
        is_enough = (num_rays >= min_rays) & (parallax >= np.deg2rad(min_parallax_deg))
        new = ids[is_enough & is_clear]
        self._landmarks.positions[new] = points[is_enough & is_clear]
        self._landmarks.positions[ids[is_enough & ~is_clear]] = np.nan
        for keyframe in self._recent_keyframes:
            seen = keyframe.observations
            seen.active[np.isin(seen.landmark_ids, new)] = True
        return new

    def _predict_positions(
        self, corners: Float32[np.ndarray, "n 2"], measured: MeasuredView, cam_from_world: Rigid3
    ) -> Float[np.ndarray, "n 3"]:
        """Predict the positions of corners at the depth of nearby landmarks in the image. This is
        accurate enough to track them."""
        nearest = 5
        depths = cam_from_world.apply(self._landmarks.positions[self._tracks.landmark_ids])[:, 2]
        apart = np.linalg.norm(corners[:, None] - self._tracks.points_img[None], axis=2)
        rows = np.argsort(apart, axis=1, kind="stable")[:, :nearest]
        z = np.median(depths[rows], axis=1) if len(corners) else np.zeros(0)
        normalized = measured.view.camera.normalized_from_img(corners.astype(np.float64))
        return cam_from_world.inverse().apply(np.column_stack([normalized * z[:, None], z]))

    def _make_observations(
        self, landmarks: Tracks, *untriangulated: Tracks
    ) -> KeyFrameObservations:
        """Return the observations of a key frame. Untriangulated points are not active.

        The standard deviation of a pixel grows with the square of the tracking uncertainty (from
        the appearance difference taken as noise), because points that slide along an edge differ
        more than noise suggests. A newly tracked point has the default.
        """
        sigma_px = 0.3  # standard deviation of a point with a tracking uncertainty of `clear_px`
        clear_px = 0.05
        tracks = _concatenate_tracks(landmarks, *untriangulated)
        num = len(tracks.landmark_ids)
        unclear = np.clip((tracks.sigmas_px.astype(np.float64) / clear_px) ** 2, 0.5, 10.0)
        sigmas = sigma_px * np.where(tracks.sigmas_px > 0.0, unclear, 1.0)
        weights = np.column_stack([1.0 / sigmas, 1.0 / sigmas, np.zeros(num)])
        measured = np.column_stack([tracks.points_img.astype(np.float64), np.full(num, np.nan)])
        is_active = np.arange(num) < len(landmarks.landmark_ids)
        return KeyFrameObservations(tracks.landmark_ids, measured, weights, is_active)

    def _make_keyframe(
        self, image: _Image, cam_from_world: Rigid3, seen: KeyFrameObservations
    ) -> KeyFrame:
        t_ns, stereo, submap = image.t_ns, image.measured.stereo, len(self.submaps)
        return KeyFrame(0, image.frame_idx, t_ns, submap, stereo, cam_from_world, seen, self._bias)

    def _set_reference_keyframe(
        self, keyframe: KeyFrame, measured: MeasuredView, untriangulated: Tracks
    ) -> None:
        self._set_reference(keyframe, measured)
        self._untriangulated = Tracks.from_points(
            untriangulated.landmark_ids, untriangulated.points_img
        )


def _find_corners(measured: MeasuredView, existing_img: np.ndarray) -> Float32[np.ndarray, "m 2"]:
    """Return new corners: more than with a stereo camera, because few of them survive until they
    are triangulated."""
    return find_corners(
        measured.view.grey, existing_img, num_corners=1500, patch_half_px=_PATCH_HALF_PX
    )


def _concatenate_tracks(*tracks: Tracks) -> Tracks:
    columns = zip(*(vars(each).values() for each in tracks), strict=True)
    return Tracks(*map(np.concatenate, columns))
