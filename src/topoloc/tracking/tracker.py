"""Localizing a stream of pictures: read from `Tracker.process`.

Where a picture was taken is predicted from the motion so far, or from external odometry. Points of
the map that the last localized picture showed are followed into it; that alone gives its pose, in a
few milliseconds. Every so often, and whenever too few points are left, it is localized in full,
around the predicted pose instead of by the coarse search. What that answers is weighed against what
is believed so far (`pose_hypotheses.py`): a pose that the motion does not allow for is refused
(reason `jump`), until several agree that the camera is elsewhere indeed, and between the
alternatives of ambiguous pictures the motion decides. While several are left, the answer is
`ambiguous`. Localized pictures are adjusted together in a sliding window; what comes out of it is
the smoothed pose.

`mode="paper"` is the rule of section III-B instead: each picture is localized alone, and where its
pose lies further than `max_jump` from the one before, that one is copied. Here the copy is said to
be one.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from topoloc.bounds import Above, AtLeast, Between, check_bounds
from topoloc.errors import QueryError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.query import StageClock, check_image_size
from topoloc.localization.result import Localization, NotLocalized, with_time
from topoloc.recordings.frame_checks import find_time_problem
from topoloc.recordings.image_io import to_grey
from topoloc.retrieval.coarse import Image
from topoloc.tracking.motion import MotionState, update_motion
from topoloc.tracking.point_tracker import PointTracker, PointTrackerConfig, TrackedMotion
from topoloc.tracking.pose_errors import compute_correlated_change, noise_floor
from topoloc.tracking.pose_hypotheses import HypothesesConfig, PoseHypotheses
from topoloc.tracking.pose_window import PoseWindow, PoseWindowConfig
from topoloc.tracking.stream_localizer import (
    ExpectedPose,
    LocalizedPose,
    StreamLocalizer,
    reject_jump,
)
from topoloc.tracking.stream_result import StreamedPose
from topoloc.tracking.tracker_state import (
    ReferenceImage,
    StreamFrame,
    compute_direction_uncertainty,
    compute_motion_covariance,
    compute_smoothed_covariance,
    downscale_image,
)


@dataclass(frozen=True)
class TrackerConfig:
    """When a picture is localized in full, and what is believed."""

    mode: Literal["motion", "paper"] = "motion"
    """`paper`: each picture is localized alone, and a pose too far from the one before is refused,
    which is copied."""
    max_jump: Annotated[float, Above(0)] = 1.0
    """mode "paper": metres from one pose to the next beyond which the new one is refused (the
    paper: 1 to 5, by the size of the place)."""
    hypotheses: HypothesesConfig = field(default_factory=HypothesesConfig)
    following: PointTrackerConfig = field(default_factory=PointTrackerConfig)
    window: PoseWindowConfig = field(default_factory=PoseWindowConfig)
    max_side_px: Annotated[int, Between(64, 16_384)] = 800
    """Points are followed in pictures reduced to this width or height."""
    localize_every: Annotated[float, AtLeast(0)] = 0.25
    """Seconds after which a picture that could be tracked is localized in full all the same ..."""
    min_share_left: Annotated[float, Between(0, 1)] = 0.6
    """... as it is where fewer of the followed points are left ..."""
    max_shift: Annotated[float, Above(0)] = 0.04
    """... or where these have moved by this share of the picture's width."""
    retry_after: Annotated[float, AtLeast(0)] = 0.1
    """Seconds to the next attempt where that failed and the points are still there."""
    max_doubt: Annotated[float, Above(0)] = 0.3
    """Where the prediction leaves open by more than this where points are seen (three sigma,
    radians), the coarse search is asked."""
    floor_share: Annotated[float, AtLeast(0)] = 0.001
    """Sigma of a localization's noise is at least this share of the points' depth, and so many
    radians."""
    reach: Annotated[float, Above(0)] = 2.0
    """How far (way in depths of the points, plus radians) what the map is wrong by lasts (to
    1/e)."""
    blend_time: Annotated[float, Above(0)] = 0.2
    """Seconds (to 1/e) in which what a new localization corrects is worked into the smoothed pose,
    so that it does not jump."""
    followed_share: Annotated[float, AtLeast(0)] = 0.05
    """Sigma of a followed motion, as a share of its way and turn, beside what the points say."""


class Tracker:
    """The state of one stream; `reset` begins another. Raises ConfigError where a value of `config`
    is out of its bounds."""

    def __init__(self, localizer: Localizer, config: TrackerConfig | None = None) -> None:
        self.localizer, self.config = localizer, config or TrackerConfig()
        check_bounds(self.config)
        self._hypotheses, self._window = (
            PoseHypotheses(self.config.hypotheses),
            PoseWindow(self.config.window),
        )
        self._stream_localizer = StreamLocalizer(
            localizer, self._hypotheses, self.config.floor_share
        )
        self.reset()

    def reset(self) -> None:
        """Forget the stream."""
        self._t_ns: int | None = None
        self._image: np.ndarray | None = None
        self._answer: StreamedPose | None = None
        self._reference: ReferenceImage | None = None
        self._last_attempt_ns = 0
        self._hypotheses.clear()
        self._window.clear()

    def process(
        self, image: Image, camera: Camera, t_ns: int, odom_from_cam: Rigid3 | None = None
    ) -> StreamedPose:
        """Where was this picture, the next of the stream, taken?

        Args:
            t_ns: its time, later than that of the picture before; equal only where it is the same
                picture again.
            odom_from_cam: its pose by external odometry, in any frame that does not move; only its
                change from picture to picture counts.

        Raises:
            QueryError: the clock goes backwards, stands still or is not in integer nanoseconds; the
                image is no picture of 8 bits; the camera is of another image size.
        """
        check_image_size(image, camera)
        is_same = self._image is not None and np.array_equal(self._image, image)
        self._check_time(t_ns, is_repeat_allowed=is_same)
        if is_same and self._answer is not None:
            return replace(
                self._answer,
                t_ns=t_ns,
                result=with_time(self._answer.result, t_ns),
                is_repeated=True,
            )
        self._image = image.copy()  # who reads a camera may read into the same memory again
        if self.config.mode == "paper":
            answer = self._process_paper_mode(image, camera, t_ns)
        else:
            grey = downscale_image(to_grey(image), camera, self.config.max_side_px)
            answer = self._process_motion_mode(
                StreamFrame(image, camera, t_ns, odom_from_cam, *grey)
            )
        self._answer = self._complete_result(answer, camera)
        return self._answer

    def process_missing(
        self, t_ns: int, result: NotLocalized, odom_from_cam: Rigid3 | None = None
    ) -> StreamedPose:
        """The answer to a picture that could not be read: predicted, where the motion is known.

        Raises:
            QueryError: the clock goes backwards or stands still.
        """
        self._check_time(t_ns)
        self._image = None
        if self.config.mode == "paper":
            return self._complete_result(self._copy_previous_pose(result, t_ns))
        self._hypotheses.predict(t_ns, odom_from_cam)
        self._drop_stale_reference()
        return self._complete_result(
            self._mark_if_ambiguous(self._make_predicted_pose(result, t_ns))
        )

    def _complete_result(self, answer: StreamedPose, camera: Camera | None = None) -> StreamedPose:
        return replace(
            answer, result=self.localizer.with_provenance(answer.result, camera, answer.t_ns)
        )

    def _check_time(self, t_ns: int, is_repeat_allowed: bool = False) -> None:
        if problem := find_time_problem(t_ns):
            raise QueryError(problem)
        if self._t_ns is not None and (
            t_ns < self._t_ns or (t_ns == self._t_ns and not is_repeat_allowed)
        ):
            what = "stands still" if t_ns == self._t_ns else "goes backwards"
            raise QueryError(
                f"the clock of the stream {what}: {t_ns / 1e9:.6f} s comes after"
                f" {self._t_ns / 1e9:.6f} s"
            )
        self._t_ns = t_ns

    def _process_paper_mode(self, image: Image, camera: Camera, t_ns: int) -> StreamedPose:
        """Section III-B: "when such a jump is found, we copy the previous pose from the
        trajectory"."""
        result = self.localizer.localize(image, camera)
        if not isinstance(result, Localization):
            return self._copy_previous_pose(result, t_ns)
        previous = self._answer.smoothed if self._answer is not None else None
        if (
            previous is not None
            and np.linalg.norm(result.world_from_cam.translation - previous.translation)
            > self.config.max_jump
        ):
            return self._copy_previous_pose(reject_jump(result), t_ns)
        return StreamedPose(t_ns, "localized", result, result.world_from_cam, result.covariance)

    def _copy_previous_pose(self, result: NotLocalized, t_ns: int) -> StreamedPose:
        previous = self._answer.smoothed if self._answer is not None else None
        return StreamedPose(t_ns, "lost" if previous is None else "predicted", result, previous)

    def _process_motion_mode(self, frame: StreamFrame) -> StreamedPose:
        clock = StageClock()
        seconds = self._hypotheses.seconds_since(frame.t_ns)
        predicted = self._hypotheses.predict(frame.t_ns, frame.odom_from_cam)
        self._drop_stale_reference()
        with clock.stage("tracking"):
            tracked_motion = self._track_points(frame, predicted)
        if tracked_motion is not None:
            self._hypotheses.apply_motion(
                self._compute_smoothed_pose(tracked_motion, frame.t_ns).inverse(),
                tracked_motion.covariance,
                frame.odom_from_cam,
            )
        if tracked_motion is None or self._is_localization_due(tracked_motion, frame):
            self._last_attempt_ns = frame.t_ns
            found = self._stream_localizer.localize(
                frame, self._predict_pose(predicted, tracked_motion)
            )
            self._drop_stale_reference()
            if isinstance(found, LocalizedPose):
                return self._mark_if_ambiguous(
                    self._update_with_localization(frame, found, predicted, tracked_motion, seconds)
                )
            if tracked_motion is None or self._reference is None:
                return self._mark_if_ambiguous(self._make_predicted_pose(found, frame.t_ns))
        return self._mark_if_ambiguous(self._make_tracked_pose(frame, tracked_motion, clock))

    def _drop_stale_reference(self) -> None:
        """Only while its hypothesis is the heaviest."""
        if not self._hypotheses.is_track_continued:
            self._reference = None
            self._window.clear()

    def _mark_if_ambiguous(self, answer: StreamedPose) -> StreamedPose:
        """The answer where one hypothesis leads; else that it may be any of them."""
        if self._hypotheses.is_unambiguous:
            return answer
        alternatives = self._hypotheses.alternatives()
        detail = (
            "the pictures so far leave open which of these"
            if len(alternatives) > 1
            else "too little speaks for this pose so far"
        )
        result = NotLocalized(
            "ambiguous",
            [],
            0,
            0,
            answer.result.times_ms,
            detail,
            alternatives,
            answer.result.provenance,
        )
        return StreamedPose(answer.t_ns, "ambiguous", result)

    def _track_points(
        self, frame: StreamFrame, predicted: MotionState | None
    ) -> TrackedMotion | None:
        """The points followed into this picture; None where they are lost or lead where the camera
        cannot be."""
        reference = self._reference
        if reference is None or predicted is None or reference.follower.camera != frame.grey_camera:
            return None
        tracked_motion = reference.follower.track_points(
            frame.grey, predicted.world_from_cam.inverse()
        )
        if tracked_motion is None:
            return None
        world_from_cam = self._compute_smoothed_pose(tracked_motion, frame.t_ns).inverse()
        floor = noise_floor(reference.errors.depth, self.config.floor_share)
        return (
            tracked_motion
            if self._hypotheses.is_consistent(
                predicted, world_from_cam, tracked_motion.covariance + floor
            )
            else None
        )

    def _is_localization_due(self, tracked_motion: TrackedMotion, frame: StreamFrame) -> bool:
        """Whether it is time to localize in full."""
        config, reference = self.config, self._reference
        assert reference is not None
        if not self._hypotheses.is_unambiguous:
            return True
        if frame.t_ns - self._last_attempt_ns < config.retry_after * 1e9:
            return False
        is_old = frame.t_ns - reference.t_ns >= config.localize_every * 1e9
        return (
            is_old
            or tracked_motion.tracked_ratio < config.min_share_left
            or tracked_motion.shift_px > config.max_shift * frame.grey_camera.width
        )

    def _predict_pose(
        self, predicted: MotionState | None, tracked_motion: TrackedMotion | None
    ) -> ExpectedPose | None:
        """About where the picture was taken; a followed pose is wrong by its reference's errors and
        by wrong depths, too."""
        reference, is_alone = self._reference, len(self._hypotheses.alternatives()) == 1
        if reference is None or predicted is None:
            return None
        if tracked_motion is None:
            is_known = (
                compute_direction_uncertainty(predicted, reference.errors.depth)
                <= self.config.max_doubt
            )
            return ExpectedPose(predicted.world_from_cam, np.zeros((6, 6)), is_known and is_alone)
        motion, scale = (
            tracked_motion.cam_from_ref.adjoint(),
            self.config.hypotheses.prediction_scale**2,
        )
        pose_covariance = (
            motion @ reference.errors.total @ motion.T
            + scale * compute_motion_covariance(tracked_motion, self.config.followed_share)
        )
        near = (tracked_motion.cam_from_ref @ reference.cam_from_world).inverse()
        return ExpectedPose(
            near,
            pose_covariance,
            is_alone,
            is_tracked=True,
            is_from_virtual_views=reference.found.is_from_virtual_views,
        )

    def _update_with_localization(
        self,
        frame: StreamFrame,
        found: LocalizedPose,
        predicted: MotionState | None,
        tracked_motion: TrackedMotion | None,
        seconds: float,
    ) -> StreamedPose:
        """The answer that a full localization gives, `seconds` after the pose measured before."""
        cam_from_world, errors = found.result.world_from_cam.inverse(), found.errors
        t_ns, offset = frame.t_ns, Rigid3.identity()
        if predicted is None or self._reference is None:
            smoothed, pose_covariance = self._window.add(
                cam_from_world, errors.noise, Rigid3.identity(), errors.noise
            )
        else:
            motion, motion_covariance = self._compute_motion(predicted, tracked_motion)
            motion_covariance = motion_covariance + compute_correlated_change(
                errors, motion, self.config.reach
            )
            before = (
                self._compute_smoothed_pose(tracked_motion, t_ns)
                if tracked_motion is not None
                else None
            )
            if tracked_motion is None and np.trace(motion_covariance) >= np.trace(errors.noise):
                self._window.clear()  # a guess from the poses before says nothing new of this one
            smoothed, pose_covariance = self._window.add(
                cam_from_world, errors.noise, motion, motion_covariance
            )
            if before is not None:
                offset = self._fade_offset(before @ smoothed.inverse(), seconds)
            measured = errors.noise if tracked_motion is None else tracked_motion.covariance
            self._hypotheses.set_best_state(
                update_motion(predicted, (offset @ smoothed).inverse(), measured),
                frame.odom_from_cam,
            )
        points = found.inlier_points.to_image_scale(frame.grey_camera.width / frame.camera.width)
        follower = PointTracker(
            frame.grey, points, cam_from_world, frame.grey_camera, self.config.following
        )
        self._reference = ReferenceImage(
            t_ns,
            found.result,
            cam_from_world,
            errors,
            smoothed,
            pose_covariance + errors.correlated,
            offset,
            follower,
        )
        best = self._hypotheses.best
        assert best is not None
        return StreamedPose(
            t_ns,
            "localized",
            found.result,
            best.world_from_cam,
            compute_smoothed_covariance(self._reference),
        )

    def _compute_smoothed_pose(self, tracked_motion: TrackedMotion, t_ns: int) -> Rigid3:
        """The smoothed cam_from_world of a followed picture."""
        reference = self._reference
        assert reference is not None
        return (
            self._fade_offset(reference.offset, (t_ns - reference.t_ns) / 1e9)
            @ tracked_motion.cam_from_ref
            @ reference.smoothed
        )

    def _fade_offset(self, offset: Rigid3, seconds: float) -> Rigid3:
        return Rigid3.exp(np.exp(-seconds / self.config.blend_time) * offset.log())

    def _compute_motion(
        self, predicted: MotionState, tracked_motion: TrackedMotion | None
    ) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
        """cam_from_before, from the picture localized last, with the covariance of its left
        perturbation."""
        assert self._reference is not None
        if tracked_motion is not None:
            return tracked_motion.cam_from_ref, compute_motion_covariance(
                tracked_motion, self.config.followed_share
            )
        return (
            predicted.world_from_cam.inverse() @ self._reference.smoothed.inverse(),
            predicted.pose_covariance,
        )

    def _make_tracked_pose(
        self, frame: StreamFrame, tracked_motion: TrackedMotion, clock: StageClock
    ) -> StreamedPose:
        reference, state = self._reference, self._hypotheses.best
        assert reference is not None
        assert state is not None
        world_from_cam = (tracked_motion.cam_from_ref @ reference.cam_from_world).inverse()
        adjoint, motion = world_from_cam.adjoint(), tracked_motion.cam_from_ref.adjoint()
        covariance = (
            adjoint
            @ (motion @ reference.errors.total @ motion.T + tracked_motion.covariance)
            @ adjoint.T
        )
        found = reference.found
        result = Localization(
            world_from_cam=world_from_cam,
            covariance=covariance,
            probability=min(found.probability, self._hypotheses.alternatives()[0].probability),
            node_id=found.node_id,
            candidates=[],
            num_matches=tracked_motion.num_tracked,
            num_inliers=tracked_motion.num_inliers,
            times_ms=clock.times_ms(),
            provenance=found.provenance,
        )
        return StreamedPose(
            frame.t_ns,
            "tracked",
            result,
            state.world_from_cam,
            compute_smoothed_covariance(reference, state),
        )

    def _make_predicted_pose(self, result: NotLocalized, t_ns: int) -> StreamedPose:
        """Predicted for a while, then lost."""
        predicted = self._hypotheses.best
        if predicted is None:
            return StreamedPose(t_ns, "lost", result)
        return StreamedPose(
            t_ns,
            "predicted",
            result,
            predicted.world_from_cam,
            compute_smoothed_covariance(self._reference, predicted),
        )
