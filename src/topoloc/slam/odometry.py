"""Visual odometry: the camera pose of each frame, and the key frames.

`Odometry.process` is the entry point. A frame's points are tracked from the preceding frame, and
their landmarks give its pose (robust PnP). If too few points are left, or the view has changed, the
frame becomes a key frame. Disparities are then measured, new corners become landmarks, and the last
key frames are adjusted together.

A lost camera is relocalized in the last places. After a while it starts a new sub-map, with the
frames that could not be relocalized. It does so at once if a repetitive wall admits several steps
and the motion does not select one.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import numpy as np
from jaxtyping import Float

from topoloc.compiled import mark_worker_thread
from topoloc.disk_list import DiskList
from topoloc.geometry.rigid import Rigid3
from topoloc.points.metric_points import MeasuredView, measure_disparities, measured_view
from topoloc.points.point_tracking import find_corners
from topoloc.recordings.frame import StereoFrame
from topoloc.slam.bundle.bundle_adjustment import adjust_window
from topoloc.slam.input_checks import measure_right_residuals
from topoloc.slam.keyframes import (
    FramePose,
    KeyFrame,
    KeyFrameObservations,
    Landmarks,
    Motion,
    PlaceFeatures,
)
from topoloc.slam.motion_prediction import select_expected_pose
from topoloc.slam.place_matching import RepetitionCheck, extract_place_features, match_places
from topoloc.slam.step_estimation import FrameTracker, Step, Tracks

# bytes of about 80 places in memory, because matching two takes ten times as long as reading one
_MAX_PLACE_BYTES = 16_000_000


class Odometry(FrameTracker):
    """Hold the state of one recording's odometry.

    `keyframes` and `landmarks` are shared by all recordings, and this class adds to them.
    """

    def __init__(self, recording: int, keyframes: list[KeyFrame], landmarks: Landmarks):
        super().__init__(landmarks, min_tracked=25, patch_half_px=5)
        self._recording, self._keyframes = recording, keyframes
        # Residuals of each key frame in the right image, pixels.
        self.right_residuals_px: list[Float[np.ndarray, " n"]] = []
        # Frames since the camera was lost, which may start a sub-map.
        self._lost_frames: list[tuple[int, StereoFrame]] = []
        self._repeated_motions: list[Rigid3] = []  # of the last frame before the camera was lost
        self._place_features = DiskList[PlaceFeatures](max_bytes=_MAX_PLACE_BYTES)
        self._place_executor = ThreadPoolExecutor(1, initializer=mark_worker_thread)
        self._pending_keyframe: KeyFrame | None = None
        self._repetitions = RepetitionCheck()

    def process(
        self, frame_idx: int, frame: StereoFrame, measured: MeasuredView
    ) -> list[FramePose]:
        """Process the next frame.

        Return its pose and those of earlier frames that are known only now. The list is empty if
        the pose is unknown. `measured` must be `measured_view(frame)`.
        """
        if measured.right is not None:
            # Prior: the common disparity bias of a recording has a standard deviation of 1 px.
            self._bias.information = 1.0
        pose = self._track_frame(frame_idx, frame, measured)
        return [pose] if pose is not None else self._handle_lost_frame(frame_idx, frame, measured)

    def finish(self) -> list[FramePose]:
        """Finish the recording and return the poses of frames that are still pending."""
        poses = self._restart_submap() if len(self._lost_frames) > 1 else []
        self._place_executor.shutdown()
        return poses

    def _track_frame(
        self, frame_idx: int, frame: StereoFrame, measured: MeasuredView
    ) -> FramePose | None:
        """Return the pose of the frame by its step from the last one, None if it fails."""
        step = self._estimate_step(frame, measured)
        if step is None:
            return None
        self._num_lost, self._lost_frames = 0, []
        self._tracks = step.tracks
        self._update_last_frame(frame.t_ns, measured, step.cam_from_world)
        reference, cam_from_keyframe = step.reference, Rigid3.identity()
        if self._is_keyframe_due(reference, measured):
            motion = Motion(reference, step.covariance)
            reference = self._add_keyframe(frame, frame_idx, step.cam_from_world, measured, motion)
        else:
            cam_from_keyframe = step.cam_from_world @ reference.cam_from_world.inverse()
        return FramePose(frame_idx, reference, cam_from_keyframe, measured.view.view_from_cam)

    def _estimate_step(self, frame: StereoFrame, measured: MeasuredView) -> Step | None:
        """Estimate the step from the last frame. None if there is none, or the motion cannot select
        one of several."""
        # Minimum share of the points found again for an unexpected step after a gap.
        min_gap_share = 0.5
        prediction = self._history.predict(frame.t_ns, self._num_lost > 0)
        if self._last_frame is None or self._reference is None or prediction is None:
            return None
        estimator = self._step_estimator(self._last_frame, self._reference, self._tracks, measured)
        step = estimator.estimate_step(prediction.cam_from_world, self._last_frame.cam_from_world)
        is_near = step and prediction.is_near(step.cam_from_world)
        is_next = bool(is_near) and not prediction.is_gap
        if step is not None and is_next and not self._repetitions.is_likely(prediction, step):
            return step
        if self._num_lost == 0 and not is_next:
            self._repeated_motions = estimator.find_repeated_motions(prediction)
        if step is None or (
            prediction.is_gap and not is_near and step.inlier_ratio < min_gap_share
        ):
            return None
        repeated = [] if is_next else self._repeat(step.cam_from_world)
        poses = estimator.find_similar_steps(step, prediction, repeated)
        expected = select_expected_pose(prediction, poses)
        if expected is not None and not estimator.is_close(expected, step.cam_from_world):
            step = estimator.estimate_step(expected)
        if expected and step and estimator.is_close(expected, step.cam_from_world):
            return step
        self._reference = None  # relocalization in the last places would be ambiguous, too
        return None

    def _repeat(self, cam_from_world: Rigid3) -> list[Rigid3]:
        """Return a pose and those at which the last image would look the same."""
        return [cam_from_world, *(move @ cam_from_world for move in self._repeated_motions)]

    def _add_keyframe(
        self,
        frame: StereoFrame,
        frame_idx: int,
        cam_from_world: Rigid3,
        measured: MeasuredView,
        motion: Motion | None,
    ) -> KeyFrame:
        """Add the frame as a key frame with new landmarks and return it. The window is adjusted.
        Tracking then continues from this frame."""
        min_disparity_px = 0.5  # minimum disparity of a new landmark, pixels
        sigma_px = 0.3  # standard deviation of a tracked point, pixels
        points, landmark_ids = self._tracks.points_img, self._tracks.landmark_ids
        corners, bias = find_corners(measured.view.grey, points), self._bias.value_px
        points_cam = cam_from_world.apply(self._landmarks.positions[landmark_ids])
        guesses = measured.stereo.project(points_cam)[:, 2]
        all_points = np.concatenate([points, corners])
        guesses = np.concatenate([guesses, np.full(len(corners), np.nan)]) + bias
        disparities, sigmas = measure_disparities(measured, all_points, guesses)
        values = np.column_stack([all_points.astype(np.float64), disparities])
        fresh = np.flatnonzero((disparities - bias)[len(points) :] > min_disparity_px) + len(points)
        unbiased = values[fresh] - [0.0, 0.0, bias]
        new_points = cam_from_world.inverse().apply(measured.stereo.points_cam(unbiased))
        rows = np.concatenate([np.arange(len(points)), fresh])
        ids = np.concatenate([landmark_ids, self._landmarks.add(new_points)])
        weights = np.full((len(ids), 3), 1.0 / sigma_px)
        weights[:, 2] = np.where(np.isfinite(sigmas[rows]), 1.0 / sigmas[rows], 0.0)
        last_submap = self._keyframes[-1].submap if self._keyframes else -1
        submap = last_submap + 1 if motion is None else motion.source.submap
        keyframe = KeyFrame(
            self._recording,
            frame_idx,
            frame.t_ns,
            submap,
            measured.stereo,
            cam_from_world,
            KeyFrameObservations(ids, values[rows], weights, np.ones(len(ids), np.bool_)),
            self._bias,
            motion,
            self._place_features,
        )
        self._keyframes.append(keyframe)
        self._recent_keyframes.append(keyframe)
        adjust_window(self._recent_keyframes, self._landmarks, 8, 5, max_steps=6)
        self._set_reference(keyframe, measured)
        self.right_residuals_px += [measure_right_residuals(keyframe, self._landmarks, measured)]
        if self._is_new_place(keyframe):
            # One extraction is pending in a background thread, so that few images are in memory.
            if self._pending_keyframe is not None:
                _ = self._pending_keyframe.place  # waits
            coming = self._place_executor.submit(extract_place_features, measured.view)
            keyframe.pending_place, self._pending_keyframe = coming, keyframe
            self._repetitions.add(self._place_executor, coming, measured.stereo)
        return keyframe

    def _is_new_place(self, keyframe: KeyFrame) -> bool:
        # Minimum distance between key frames with place features (for loops), as a share of the
        # median depth, or the rotation (degrees) between them.
        min_distance, min_angle_deg = 0.1, 8.0
        last = self._last_places(1)
        if not last:
            return True
        motion = keyframe.cam_from_world @ last[0].cam_from_world.inverse()
        points = self._landmarks.positions[keyframe.observations.active_ids]
        metres = min_distance * float(np.median(keyframe.cam_from_world.apply(points)[:, 2]))
        return not motion.is_same(Rigid3.identity(), metres, np.deg2rad(min_angle_deg))

    def _last_places(self, num: int) -> list[KeyFrame]:
        """Return the last key frames of this sub-map with place features, newest first."""
        if self._reference is None:
            return []
        ends = self._recording, self._reference.submap
        places = (
            k for k in reversed(self._keyframes) if (k.recording, k.submap) == ends and k.has_place
        )
        return list(islice(places, num))

    def _handle_lost_frame(
        self, frame_idx: int, frame: StereoFrame, measured: MeasuredView
    ) -> list[FramePose]:
        """Relocalize the camera in the last places, or start a new sub-map after a while."""
        # Number of frames after a loss into which the last tracked points are still tracked, and
        # after which a new sub-map starts. It begins at the first of them that the others follow.
        max_lost_tracked, max_lost_frames = 3, 10
        self._num_lost += 1
        self._lost_frames.append((frame_idx, frame))
        if self._num_lost > max_lost_tracked:
            self._last_frame = None
        if self._reference is not None and self._num_lost <= max_lost_frames:
            found = self._relocalize(frame, measured)
            if found is not None:
                return [self._start_tracking(frame_idx, frame, measured, *found)]
            if self._reference is not None:
                return []
        return self._restart_submap()

    def _restart_submap(self) -> list[FramePose]:
        """Start a sub-map from the lost frames, at the first one from which all later ones can be
        tracked."""
        min_start_points = 40  # minimum number of corners with a disparity to start tracking
        missed, self._lost_frames, self._reference = self._lost_frames, [], None
        num_keyframes, num_landmarks = len(self._keyframes), self._landmarks.num
        num_lost = self._num_lost
        poses: list[FramePose] = []
        for frame_idx, frame in missed:
            measured = measured_view(frame)
            pose = self._track_frame(frame_idx, frame, measured) if poses else None
            if pose is None:  # the preceding frames cannot be continued
                poses, self._reference = [], None
                del self._keyframes[num_keyframes:]
                self._landmarks.num = num_landmarks
                corners = find_corners(measured.view.grey, np.zeros((0, 2)))
                disparities, _ = measure_disparities(
                    measured, corners, np.full(len(corners), np.nan)
                )
                if np.count_nonzero(np.isfinite(disparities)) >= min_start_points:
                    pose = self._start_tracking(frame_idx, frame, measured, Rigid3.identity(), None)
            if pose is not None:
                poses.append(pose)
        self._num_lost = 0 if poses else num_lost
        return poses

    def _start_tracking(
        self,
        frame_idx: int,
        frame: StereoFrame,
        measured: MeasuredView,
        cam_from_world: Rigid3,
        motion: Motion | None,
    ) -> FramePose:
        """Start tracking with this frame as a key frame."""
        self._last_frame, self._recent_keyframes = None, []
        self._history.reset()
        self._tracks = Tracks.empty()
        keyframe = self._add_keyframe(frame, frame_idx, cam_from_world, measured, motion)
        self._update_last_frame(frame.t_ns, measured, cam_from_world)
        self._num_lost, self._lost_frames = 0, []
        return FramePose(frame_idx, keyframe, Rigid3.identity(), measured.view.view_from_cam)

    def _relocalize(
        self, frame: StereoFrame, measured: MeasuredView
    ) -> tuple[Rigid3, Motion] | None:
        """Relocalize the camera in one of the last places. If the place is repetitive and the
        motion cannot select a pose, the search ends."""
        num_places = 6  # number of last places in which a lost camera is relocalized
        max_apart = 0.3, np.deg2rad(10.0)  # metres and radians between estimates of one pose
        here = extract_place_features(measured.view)
        places = self._last_places(num_places)
        matched = [(k, match_places(k.place, here, measured.stereo)) for k in places]
        found = [(k, match) for k, match in matched if match is not None]
        if not found:
            return None
        prediction = self._history.predict(frame.t_ns, self._num_lost > 0)
        estimates = [match.target_from_source @ k.cam_from_world for k, match in found]
        poses, (nearest, match) = self._repeat(estimates[0]), found[0]
        if repetitions := self._repetitions.find_motions():
            poses += [one for one in estimates if not one.is_same(estimates[0], *max_apart)]
            poses += [repetitions[0] @ estimates[0], repetitions[0].inverse() @ estimates[0]]
        is_near = prediction is not None and prediction.is_near(estimates[0])
        selected = select_expected_pose(prediction, poses)
        if selected is estimates[0] and (is_near or not repetitions):
            return estimates[0], Motion(nearest, match.covariance)
        self._reference = None
        return None
