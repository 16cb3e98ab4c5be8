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
from topoloc.points.disparity import MeasuredView, StereoCamera
from topoloc.points.point_tracking import find_corners, track_points
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.frame_preparation import undistort_frame
from topoloc.slam.bundle.bundle_adjustment import adjust_bundle, adjust_window
from topoloc.slam.frame_tracker import FrameTracker
from topoloc.slam.keyframes import (
    FramePose,
    KeyFrame,
    Landmarks,
    Motion,
    Observations,
)
from topoloc.slam.step_estimation import LastFrame, Step, Tracks
from topoloc.slam.triangulation import is_well_triangulated, triangulate_points

_PATCH_HALF_PX = 7


@dataclass(frozen=True, eq=False)
class MonocularSubmap:
    """Hold an uninterrupted motion in its own world and unit: frames, key frames and landmarks.

    The frames' poses are relative to key frames.
    """

    landmarks: Landmarks
    frames: list[FramePose] = field(default_factory=list)
    keyframes: list[KeyFrame] = field(default_factory=list)

    def submap_from_cams(self) -> dict[int, Rigid3]:
        """Return world_from_cam of its frames by frame index, in its own world and unit."""
        return {pose.frame_idx: pose.world_from_cam() for pose in self.frames}


@dataclass(eq=False)
class _Initialization:
    """Hold the first image of a sub-map that has not started yet, and the frames since.

    `tracks` are the points of the first image. Each frame comes with its remaining points.
    """

    frames: list[tuple[int, StereoFrame, MeasuredView, Tracks]]
    tracks: Tracks


class MonocularOdometry(FrameTracker):
    """Hold the state of one recording's odometry. `submaps` holds the sub-maps so far."""

    def __init__(self) -> None:
        super().__init__(Landmarks(), min_tracked=15, patch_half_px=_PATCH_HALF_PX)
        self.submaps: list[MonocularSubmap] = []
        self._initialization: _Initialization | None = None
        self._untriangulated = Tracks.empty()

    def process(self, frame_idx: int, frame: StereoFrame) -> None:
        """Process the next frame."""
        max_side_px = 800  # images are reduced to this width or height for point tracking
        # Number of frames after a loss into which the last tracked points are still
        # tracked.
        max_lost_tracked = 3
        measured = _make_view(frame, max_side_px)
        if self._reference is None:
            self._initialize(frame_idx, frame, measured)
        elif self._track_frame(frame_idx, frame, measured):
            self._num_lost = 0
        else:
            self._num_lost += 1
            if self._num_lost > max_lost_tracked:
                self._reference, self._last_frame, self._num_lost = None, None, 0
                self._history.reset()
                self._initialize(frame_idx, frame, measured)

    def _initialize(self, frame_idx: int, frame: StereoFrame, measured: MeasuredView) -> None:
        """Track the corners of a first image until two images show enough motion."""
        # If fewer than this share of its points are left, the first image is replaced by
        # a later one.
        min_share = 0.2
        # The first image is also replaced after this many frames, because a camera at
        # rest gives no depth.
        max_frames = 60
        # Minimum median displacement of the points to start a sub-map, as a share of the
        # image width.
        min_motion = 0.03
        if self._initialization is not None:
            tracks = self._track_bidirectional(self._initialization, measured)
            left = len(tracks.landmark_ids) / max(len(self._initialization.tracks.landmark_ids), 1)
            self._initialization.frames.append((frame_idx, frame, measured, tracks))
            if left >= min_share and len(self._initialization.frames) <= max_frames:
                if tracks.median_motion_px() > min_motion * measured.view.camera.width:
                    self._start_submap(self._initialization)
                return
        corners = _find_corners(measured, np.zeros((0, 2)))
        tracks = Tracks.from_points(np.arange(len(corners)), corners)
        self._initialization = _Initialization([(frame_idx, frame, measured, tracks)], tracks)

    def _track_bidirectional(
        self, initialization: _Initialization, measured: MeasuredView
    ) -> Tracks:
        """Return the points found in the next image that are tracked back to their start."""
        max_error_px = 0.7  # maximum error of a point tracked forwards and backwards, pixels
        _, _, before, tracks = initialization.frames[-1]
        found, there = track_points(
            before.view.grey, measured.view.grey, tracks.points_img, tracks.points_img
        )
        back, again = track_points(measured.view.grey, before.view.grey, found, tracks.points_img)
        returned = np.linalg.norm(back - tracks.points_img, axis=1) < max_error_px
        return replace(tracks, points_img=found).select(np.flatnonzero(there & again & returned))

    def _start_submap(self, initialization: _Initialization) -> None:
        """Start a sub-map if the relative pose of the first and the last image can be estimated."""
        min_points = 50  # minimum number of triangulated points to start a sub-map
        _, _, first, all_tracks = initialization.frames[0]
        _, _, last, tracks = initialization.frames[-1]
        motion = estimate_relative_pose(
            tracks.points_ref.astype(np.float64),
            first.view.camera,
            tracks.points_img.astype(np.float64),
            last.view.camera,
        )
        if motion is None or np.count_nonzero(motion.inliers) < min_points:
            return
        self._recent_keyframes, self._landmarks = [], Landmarks()
        self._landmarks.add(np.full((len(all_tracks.landmark_ids), 3), np.nan))
        agreeing = tracks.select(motion.inliers)
        poses = (Rigid3.identity(), motion.second_from_first)
        for row, cam_from_world, points_img in (
            (0, poses[0], agreeing.points_ref),
            (-1, poses[1], agreeing.points_img),
        ):
            frame_idx, frame, measured, _ = initialization.frames[row]
            seen = self._make_observations(Tracks.from_points(agreeing.landmark_ids, points_img), 0)
            self._recent_keyframes.append(
                self._make_keyframe(frame_idx, frame.t_ns, measured, cam_from_world, seen)
            )
        known = self._triangulate_tracks(agreeing.landmark_ids, 2)
        if len(known) < min_points:
            self._recent_keyframes = []
            return
        adjust_bundle(self._recent_keyframes, [], self._landmarks, max_steps=12)
        self.submaps.append(
            MonocularSubmap(self._landmarks, keyframes=list(self._recent_keyframes))
        )
        self._initialization, self._last_frame = None, None
        self._history.reset()
        for frame_idx, frame, measured, of_frame in initialization.frames[:-1]:
            self._register_frame(frame_idx, frame, measured, of_frame, known)
        frame_idx, frame, measured, _ = initialization.frames[-1]
        self._set_reference_keyframe(
            self._recent_keyframes[-1],
            measured,
            agreeing.select(~np.isin(agreeing.landmark_ids, known)),
        )
        self._update_last_frame(frame.t_ns, measured, self._recent_keyframes[-1].cam_from_world)
        self.submaps[-1].frames.append(
            FramePose(
                frame_idx,
                self._recent_keyframes[-1],
                Rigid3.identity(),
                measured.view.view_from_cam,
            )
        )

    def _register_frame(
        self,
        frame_idx: int,
        frame: StereoFrame,
        measured: MeasuredView,
        tracks: Tracks,
        known: Int[np.ndarray, " n"],
    ) -> None:
        """Estimate the pose of a frame before the start, from the triangulated points."""
        first = self._recent_keyframes[0]
        if frame_idx == first.frame_idx:
            pose = Rigid3.identity()
        else:
            of_it = tracks.select(np.isin(tracks.landmark_ids, known))
            found = self._step_estimator(
                LastFrame(measured, first.cam_from_world), first, of_it, measured
            ).estimate_pose(of_it)
            if found is None:
                return
            pose = found.cam_from_world
        self._update_last_frame(frame.t_ns, measured, pose)
        self.submaps[-1].frames.append(
            FramePose(
                frame_idx, first, pose @ first.cam_from_world.inverse(), measured.view.view_from_cam
            )
        )

    def _track_frame(self, frame_idx: int, frame: StereoFrame, measured: MeasuredView) -> bool:
        """Track the points into the frame and add its pose. Return False if it fails."""
        last, reference = self._last_frame, self._reference
        prediction = self._history.predict(frame.t_ns)
        if last is None or reference is None or prediction is None:
            return False
        step_estimator = self._step_estimator(last, reference, self._tracks, measured)
        step = step_estimator.estimate_step(
            prediction.cam_from_world
        ) or step_estimator.estimate_step(last.cam_from_world)
        if step is None:
            return False
        self._tracks, self._untriangulated = (
            step.tracks,
            self._step_estimator(last, reference, self._untriangulated, measured).track_points(
                step.cam_from_world
            ),
        )
        self._update_last_frame(frame.t_ns, measured, step.cam_from_world)
        relative = step.cam_from_world @ reference.cam_from_world.inverse()
        if self._is_keyframe_due(reference, measured):
            reference = self._add_keyframe(frame_idx, frame, measured, step)
            relative = Rigid3.identity()
        self.submaps[-1].frames.append(
            FramePose(frame_idx, reference, relative, measured.view.view_from_cam)
        )
        return True

    def _add_keyframe(
        self, frame_idx: int, frame: StereoFrame, measured: MeasuredView, step: Step
    ) -> KeyFrame:
        """Add the frame as a key frame and return it.

        Triangulated points become landmarks, new corners are added as untriangulated points, and
        the window is adjusted.
        """
        min_rays = 2  # minimum number of key frames that see a landmark
        tracks, untriangulated = self._tracks, self._untriangulated
        occupied = np.concatenate([tracks.points_img, untriangulated.points_img])
        corners = _find_corners(measured, occupied)
        fresh = Tracks.from_points(
            self._landmarks.add(self._predict_positions(corners, measured, step.cam_from_world)),
            corners,
        )
        seen = self._make_observations(
            _concatenate_tracks(tracks, untriangulated, fresh), len(tracks.landmark_ids)
        )
        motion = Motion(step.reference, step.covariance)
        keyframe = self._make_keyframe(
            frame_idx, frame.t_ns, measured, step.cam_from_world, seen, motion
        )
        self._recent_keyframes.append(keyframe)
        self.submaps[-1].keyframes.append(keyframe)
        known = self._triangulate_tracks(np.sort(untriangulated.landmark_ids), min_rays)
        # The window is longer than that of stereo odometry, because it alone preserves the scale.
        adjust_window(self._recent_keyframes, self._landmarks, 20, 10, max_steps=12)
        still = untriangulated.select(~np.isin(untriangulated.landmark_ids, known))
        still = still.select(
            np.flatnonzero(np.isfinite(self._landmarks.positions[still.landmark_ids]).all(axis=1))
        )
        self._set_reference_keyframe(keyframe, measured, _concatenate_tracks(still, fresh))
        return keyframe

    def _triangulate_tracks(
        self, ids: Int[np.ndarray, " n"], min_rays: int
    ) -> Int[np.ndarray, " k"]:
        """Triangulate the points with these ids (ascending), and return the ids of new landmarks.

        The positions of points whose rays do not meet are set to NaN.
        """
        min_parallax_deg = 1.0  # minimum angle between the rays of a landmark, degrees
        # Maximum reprojection error of a new landmark in all its key frames, pixels.
        max_error_px = 1.5
        if len(ids) == 0:
            return ids
        found = triangulate_points(self._recent_keyframes, ids)
        clear = is_well_triangulated(found, min_rays, np.deg2rad(min_parallax_deg), max_error_px)
        self._landmarks.positions[ids[clear]] = found.points[clear]
        with np.errstate(invalid="ignore"):
            wrong = (
                (found.num_rays >= min_rays)
                & (found.parallax >= np.deg2rad(min_parallax_deg))
                & ~clear
            )
        self._landmarks.positions[ids[wrong]] = np.nan
        for keyframe in self._recent_keyframes:
            seen = keyframe.observations
            seen.active[np.isin(seen.landmark_ids, ids[clear])] = True
        return ids[clear]

    def _predict_positions(
        self, corners: Float32[np.ndarray, "n 2"], measured: MeasuredView, cam_from_world: Rigid3
    ) -> Float[np.ndarray, "n 3"]:
        """Predict the positions of corners at the depth of nearby landmarks in the image.

        This is accurate enough to track them.
        """
        nearest = 5
        depths = cam_from_world.apply(self._landmarks.positions[self._tracks.landmark_ids])[:, 2]
        apart = np.linalg.norm(corners[:, None] - self._tracks.points_img[None], axis=2)
        rows = np.argsort(apart, axis=1, kind="stable")[:, :nearest]
        z = np.median(depths[rows], axis=1) if len(corners) else np.zeros(0)
        normalized = measured.view.camera.normalized_from_img(corners.astype(np.float64))
        return cam_from_world.inverse().apply(np.column_stack([normalized * z[:, None], z]))

    def _make_observations(self, tracks: Tracks, num_active: int) -> Observations:
        """Return the observations of a key frame. Only the first `num_active` points are landmarks
        yet."""
        num = len(tracks.landmark_ids)
        weights = np.zeros((num, 3))
        weights[:, :2] = 1.0 / self._compute_sigmas(tracks)[:, None]
        measured = np.column_stack([tracks.points_img.astype(np.float64), np.full(num, np.nan)])
        return Observations(tracks.landmark_ids, measured, weights, np.arange(num) < num_active)

    def _compute_sigmas(self, tracks: Tracks) -> Float[np.ndarray, " n"]:
        """Return the standard deviations (pixels). A newly tracked point has the default."""
        # Tracking uncertainty (pixels, from the appearance difference taken as noise) at
        # which a point has an error of `sigma_px`. Otherwise the error scales with the
        # square of the ratio, because points that slide along an edge differ more than
        # noise suggests.
        clear_px = 0.05
        sigma_px = 0.3  # standard deviation of a tracked point, pixels
        unclear = np.clip(
            (tracks.sigmas_px.astype(np.float64) / clear_px) ** 2,
            0.5,
            10.0,
        )
        return sigma_px * np.where(tracks.sigmas_px > 0.0, unclear, 1.0)

    def _make_keyframe(
        self,
        frame_idx: int,
        t_ns: int,
        measured: MeasuredView,
        cam_from_world: Rigid3,
        seen: Observations,
        motion: Motion | None = None,
    ) -> KeyFrame:
        return KeyFrame(
            0,
            frame_idx,
            t_ns,
            len(self.submaps),
            measured.stereo,
            cam_from_world,
            seen,
            self._bias,
            motion,
        )

    def _set_reference_keyframe(
        self, keyframe: KeyFrame, measured: MeasuredView, untriangulated: Tracks
    ) -> None:
        self._set_reference(keyframe, measured)
        self._untriangulated = Tracks.from_points(
            untriangulated.landmark_ids, untriangulated.points_img
        )


def _make_view(frame: StereoFrame, max_side_px: int) -> MeasuredView:
    """Return the view of a single image in the form of stereo odometry. The unit replaces the
    baseline."""
    view = undistort_frame(frame, max_side_px)
    return MeasuredView(
        view, StereoCamera(view.camera, view.camera.fx), view.grey.astype(np.float32), None
    )


def _find_corners(measured: MeasuredView, existing_img: np.ndarray) -> Float32[np.ndarray, "m 2"]:
    """Return new corners: more than with a stereo camera, because few of them survive until they
    are triangulated."""
    return find_corners(
        measured.view.grey, existing_img, num_corners=1500, patch_half_px=_PATCH_HALF_PX
    )


def _concatenate_tracks(*tracks: Tracks) -> Tracks:
    return Tracks(
        *(
            np.concatenate(columns)
            for columns in zip(*(vars(each).values() for each in tracks), strict=True)
        )
    )
