"""Track a stream in one map. `MapStream.process` is the entry point.

The pose of an image is predicted from the motion so far, or from external odometry. The map points
of the last localized image are tracked into it, which gives its pose in a few milliseconds. At
intervals, and if too few points are left, the image is localized in full. The search then runs
around the predicted pose instead of coarse retrieval.

The result updates the pose hypotheses (`pose_hypotheses.py`). A pose that the motion does not allow
is rejected (reason `jump`), until several agree that the camera is elsewhere. The motion also
selects between the alternatives of ambiguous images. While several remain, the result is
`ambiguous`. Localized images are adjusted together in a sliding window, which gives the smoothed
pose.

`mode="paper"` applies the rule of section III-B instead. Each image is localized alone. If its pose
is farther than `max_jump` from the preceding one, that one is copied. The copy has the state
"predicted".
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.query import Deadline, StageClock
from topoloc.localization.result import Localization, NotLocalized
from topoloc.recordings.frame import to_grey
from topoloc.recordings.frame_preparation import downscale_image
from topoloc.retrieval.coarse import Image
from topoloc.tracking.config import TrackerConfig
from topoloc.tracking.gyroscope import Gyroscope
from topoloc.tracking.motion import MotionHypothesis, MotionState, update_motion
from topoloc.tracking.point_tracker import PointTracker
from topoloc.tracking.pose_hypotheses import PoseHypotheses
from topoloc.tracking.stream_localizer import (
    ExpectedPose,
    LocalizedPose,
    StreamLocalizer,
    reject_jump,
)
from topoloc.tracking.stream_result import StreamedPose
from topoloc.tracking.tracker_state import (
    FloorEvidence,
    PoseWindow,
    ReferenceImage,
    StreamFrame,
    TrackedImage,
    compute_correlated_change,
    compute_motion_covariance,
    compute_smoothed_covariance,
    fade_offset,
    noise_floor,
)


class MapStream:
    """Hold the state of one stream in one map, to which `localizer` is restricted. `prior` is a
    hypothesis that no image has confirmed."""

    def __init__(
        self,
        localizer: Localizer,
        config: TrackerConfig,
        prior: MotionHypothesis | None = None,
        gyroscope: Gyroscope | None = None,
    ) -> None:
        self.localizer, self.config, self._window = localizer, config, PoseWindow()
        self._hypotheses = PoseHypotheses(config.hypotheses.motion, prior, gyroscope)
        self._stream_localizer = StreamLocalizer(localizer, self._hypotheses)
        self._last_smoothed: Rigid3 | None = None
        self._reference: ReferenceImage | None = None
        self._last_attempt_ns = 0
        self._floor = FloorEvidence(localizer.topomap.config.look_alike_floors)

    def process(
        self, image: Image, camera: Camera, t_ns: int, odom_from_cam: Rigid3 | None, limit: Deadline
    ) -> StreamedPose:
        """Localize the next image of the stream, see `Tracker.process`."""
        max_side_px = 800  # images are reduced to this width or height for point tracking
        if self.config.mode == "paper":
            alone = self.localizer.localize(image, camera, max_ms=limit)
            answer = self._process_paper_mode(alone, t_ns)
        else:
            grey = downscale_image(to_grey(image), camera, max_side_px)
            frame = StreamFrame(image, camera, t_ns, odom_from_cam, *grey, limit)
            answer = self._process_motion_mode(frame)
        self._last_smoothed = answer.smoothed
        return self._complete_result(answer, camera)

    def process_missing(
        self, t_ns: int, result: NotLocalized, odom_from_cam: Rigid3 | None
    ) -> StreamedPose:
        """Return the result for an image that could not be read, see `Tracker.process_missing`."""
        if self.config.mode == "paper":
            return self._complete_result(self._copy_previous_pose(result, t_ns))
        self._hypotheses.predict(t_ns, odom_from_cam)
        self._drop_stale_reference()
        return self._complete_result(self._make_predicted_pose(result, t_ns))

    def hold(self, t_ns: int, odom_from_cam: Rigid3 | None) -> None:
        """Take an image that shows that the camera stands since the last one, where odometry was
        `odom_from_cam`. It measures nothing anew: poses and covariances stay."""
        self._hypotheses.hold(t_ns, odom_from_cam)

    def _complete_result(self, answer: StreamedPose, camera: Camera | None = None) -> StreamedPose:
        result = self.localizer.with_provenance(answer.result, camera, answer.t_ns)
        return replace(answer, result=result, track=self._hypotheses.track)

    def _process_paper_mode(self, result: Localization | NotLocalized, t_ns: int) -> StreamedPose:
        """Apply section III-B to one result: "when such a jump is found, we copy the previous pose
        from the trajectory"."""
        if not isinstance(result, Localization):
            return self._copy_previous_pose(result, t_ns)
        pose, previous = result.world_from_cam, self._last_smoothed
        if previous is not None:
            way = np.linalg.norm(pose.translation - previous.translation)
            if way > self.config.max_jump:
                return self._copy_previous_pose(reject_jump(result), t_ns)
        return StreamedPose(t_ns, "localized", result, pose, result.covariance)

    def _copy_previous_pose(self, result: NotLocalized, t_ns: int) -> StreamedPose:
        previous = self._last_smoothed
        return StreamedPose(t_ns, "lost" if previous is None else "predicted", result, previous)

    def _process_motion_mode(self, frame: StreamFrame) -> StreamedPose:
        clock = StageClock()
        seconds = self._hypotheses.seconds_since(frame.t_ns)
        predicted = self._hypotheses.predict(frame.t_ns, frame.odom_from_cam)
        self._drop_stale_reference()
        with clock.stage("tracking"):
            tracked = self._track_points(frame, predicted)
        if tracked is not None:
            pose, covariance = tracked.smoothed.inverse(), tracked.motion.covariance
            self._hypotheses.apply_motion(pose, covariance, frame.odom_from_cam)
        if tracked is None or self._is_localization_due(tracked, frame):
            self._last_attempt_ns = frame.t_ns
            found = self._stream_localizer.localize(frame, self._predict_pose(predicted, tracked))
            self._drop_stale_reference()
            self._floor.add(found.result if isinstance(found, LocalizedPose) else found)
            if isinstance(found, LocalizedPose):
                known = predicted, tracked, seconds
                return self._mark_if_ambiguous(self._update_with_localization(frame, found, *known))
            if tracked is None or self._reference is None:
                return self._make_predicted_pose(found, frame.t_ns)
        return self._mark_if_ambiguous(self._make_tracked_pose(frame, tracked, clock))

    def _drop_stale_reference(self) -> None:
        """Drop the reference image unless its hypothesis is still the best."""
        if not self._hypotheses.is_track_continued:
            self._reference = None
            self._window.clear()

    def _mark_if_ambiguous(self, answer: StreamedPose) -> StreamedPose:
        """Return the result unchanged if one hypothesis leads, and an ambiguous one otherwise."""
        if self._hypotheses.is_unambiguous and self._floor.is_sure:
            return answer
        alternatives = self._hypotheses.alternatives()
        detail = "too little speaks for this pose so far"
        if not self._floor.is_sure:
            detail = "the colours so far leave open whether this is another floor of the building"
        if len(alternatives) > 1:
            detail = "the pictures so far leave open which of these"
        times_ms, provenance = answer.result.times_ms, answer.result.provenance
        result = NotLocalized("ambiguous", [], 0, 0, times_ms, detail, alternatives, provenance)
        return StreamedPose(answer.t_ns, "ambiguous", result)

    def _track_points(
        self, frame: StreamFrame, predicted: MotionState | None
    ) -> TrackedImage | None:
        """Track the points into this image.

        None if they are lost or give a pose that the motion does not allow.
        """
        reference = self._reference
        if reference is None or predicted is None or reference.follower.camera != frame.grey_camera:
            return None
        motion = reference.follower.track_points(frame.grey, predicted.world_from_cam.inverse())
        if motion is None:
            return None
        offset = fade_offset(reference.offset, (frame.t_ns - reference.t_ns) / 1e9)
        smoothed = offset @ motion.cam_from_ref @ reference.smoothed
        covariance = motion.covariance + noise_floor(reference.errors.depth)
        if not self._hypotheses.is_consistent(predicted, smoothed.inverse(), covariance):
            return None
        return TrackedImage(reference, motion, smoothed)

    def _is_localization_due(self, tracked: TrackedImage, frame: StreamFrame) -> bool:
        """Return whether the image must be localized in full."""
        retry_interval = 0.1  # least seconds between full localizations if points are tracked
        interval = 0.25  # interval of full localizations, seconds
        # or if the share of points still tracked is below this
        min_share_left = 0.6
        # or if the points moved by more than this share of the image width
        max_shift = 0.04
        if not self._hypotheses.is_unambiguous:
            return True
        if frame.t_ns - self._last_attempt_ns < retry_interval * 1e9:
            return False
        return (
            frame.t_ns - tracked.reference.t_ns >= interval * 1e9
            or tracked.motion.tracked_ratio < min_share_left
            or tracked.motion.shift_px > max_shift * frame.grey_camera.width
        )

    def _predict_pose(
        self, predicted: MotionState | None, tracked: TrackedImage | None
    ) -> ExpectedPose | None:
        """Return the expected pose of the image, None if there is no prediction.

        The error of a tracked pose includes those of its reference image and of wrong depths.
        """
        # Maximum direction uncertainty (three sigma, radians). Above it, retrieval is used.
        max_doubt = 0.3
        reference, is_alone = self._reference, len(self._hypotheses.alternatives()) == 1
        if reference is None or predicted is None:
            return None
        if tracked is None:
            sigmas = np.sqrt(np.diag(predicted.pose_covariance))
            sigma = float(np.hypot(sigmas[:3].max() / reference.errors.depth, sigmas[3:].max()))
            is_unique = is_alone and 3.0 * sigma <= max_doubt
            return ExpectedPose(predicted.world_from_cam, np.zeros((6, 6)), is_unique)
        scale = self._hypotheses.prediction_scale**2
        return ExpectedPose(
            tracked.cam_from_world.inverse(),
            tracked.moved_errors + scale * compute_motion_covariance(tracked.motion),
            is_alone,
            is_tracked=True,
            is_refutable=reference.found.is_of_nodes,
        )

    def _update_with_localization(
        self,
        frame: StreamFrame,
        found: LocalizedPose,
        predicted: MotionState | None,
        tracked: TrackedImage | None,
        seconds: float,
    ) -> StreamedPose:
        """Return the result of a full localization, `seconds` after the last measured pose."""
        cam_from_world, errors = found.result.world_from_cam.inverse(), found.errors
        offset, before = Rigid3.identity(), self._reference
        if predicted is None or before is None:
            smoothed, pose_covariance = self._window.add(
                cam_from_world, errors.noise, Rigid3.identity(), errors.noise
            )
        else:
            if tracked is not None:
                motion = tracked.motion.cam_from_ref
                motion_covariance = compute_motion_covariance(tracked.motion)
            else:
                motion = predicted.world_from_cam.inverse() @ before.smoothed.inverse()
                motion_covariance = predicted.pose_covariance
            motion_covariance = motion_covariance + compute_correlated_change(errors, motion)
            if tracked is None and np.trace(motion_covariance) >= np.trace(errors.noise):
                self._window.clear()  # the prediction adds no information
            smoothed, pose_covariance = self._window.add(
                cam_from_world, errors.noise, motion, motion_covariance
            )
            if tracked is not None:
                offset = fade_offset(tracked.smoothed @ smoothed.inverse(), seconds)
            measured = errors.noise if tracked is None else tracked.motion.covariance
            state = update_motion(predicted, (offset @ smoothed).inverse(), measured)
            self._hypotheses.set_best_state(state, frame.odom_from_cam)
        points = found.inlier_points.to_image_scale(frame.grey_camera.width / frame.camera.width)
        self._reference = ReferenceImage(
            frame.t_ns,
            found.result,
            cam_from_world,
            errors,
            smoothed,
            pose_covariance + errors.correlated,
            offset,
            PointTracker(frame.grey, points, cam_from_world, frame.grey_camera),
        )
        covariance = compute_smoothed_covariance(self._reference)
        pose = self._hypotheses.leader.world_from_cam
        return StreamedPose(frame.t_ns, "localized", found.result, pose, covariance)

    def _make_tracked_pose(
        self, frame: StreamFrame, tracked: TrackedImage, clock: StageClock
    ) -> StreamedPose:
        world_from_cam, state = tracked.cam_from_world.inverse(), self._hypotheses.leader
        found, noise = tracked.reference.found, tracked.moved_errors + tracked.motion.covariance
        result = Localization(
            world_from_cam=world_from_cam,
            covariance=world_from_cam.transform_covariance(noise),
            probability=min(found.probability, self._hypotheses.alternatives()[0].probability),
            node_id=found.node_id,
            candidates=[],
            num_matches=tracked.motion.num_tracked,
            num_inliers=tracked.motion.num_inliers,
            times_ms=clock.times_ms(),
            provenance=found.provenance,
            appearance=found.appearance,
        )
        covariance = compute_smoothed_covariance(tracked.reference, state)
        return StreamedPose(frame.t_ns, "tracked", result, state.world_from_cam, covariance)

    def _make_predicted_pose(self, result: NotLocalized, t_ns: int) -> StreamedPose:
        """Return the predicted pose, "lost" if there is no hypothesis, or an ambiguous result."""
        predicted = self._hypotheses.best
        if predicted is None:
            return StreamedPose(t_ns, "lost", result)
        covariance = compute_smoothed_covariance(self._reference, predicted)
        return self._mark_if_ambiguous(
            StreamedPose(t_ns, "predicted", result, predicted.world_from_cam, covariance)
        )
