"""Localize a robot by its camera and its odometry: TF from map to odom (REP 105), the pose of the
robot, and diagnostics. Camera frames are optical (x right, y down, z forward)."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from topoloc import Localization, NotLocalized, Rigid3, StreamedPose, Tracker
from topoloc.apps.cli.queries.query_answers import QueryAnswer, QueryFrame
from topoloc.apps.formats.bags.bag_poses import pose_of_transform
from topoloc.apps.formats.bags.messages import frame_id, stamp_ns, stamped_transform
from topoloc.apps.query_camera import CameraOfSize
from topoloc.apps.robots.config import RobotConfig
from topoloc.apps.robots.map_to_odom import (
    ContinuityGate,
    HealthGate,
    MapToOdom,
    MeasuredPose,
    StreamPose,
    project_to_plane,
    tilt,
)
from topoloc.apps.robots.robot_health import Health, RobotClock
from topoloc.apps.robots.ros_images import RosImages
from topoloc.apps.robots.ros_node import (
    INITIAL_POSE_TOPIC,
    RobotPublisher,
    RosNode,
    Uncertain,
    covariance_about,
)
from topoloc.apps.robots.transform_buffer import TransformBuffer, TransformError


@dataclass(frozen=True, eq=False)
class OdometryPose:
    """Hold the pose of the camera in odom and on the robot at the time of an image, and the way and
    the rotation so far."""

    odom_from_cam: Rigid3
    base_from_cam: Rigid3
    travelled: np.ndarray


class RobotLocalizer:
    """Localize the images of a robot and publish what they say, until it is closed.

    Args:
        node: its participant, not yet started.
        images: the topic of the images, if they have one.
        warn: gets one line for each new fault.
        map_from_world: the robot's map in which the poses are; z points up in it.
    """

    rate: ClassVar[float] = 20.0
    """Transforms per second, between the images too."""
    transform_tolerance: ClassVar[float] = 0.2
    """Seconds by which transforms are stamped ahead."""
    patience: ClassVar[float] = 2.0
    """Seconds for which TF, or /clock at the start, may be missing without a complaint."""

    def __init__(
        self,
        node: RosNode,
        config: RobotConfig,
        images: RosImages | None,
        warn: Callable[[str], None],
        map_from_world: Rigid3 | None = None,
    ) -> None:
        self._config, self._images, self._warn = config, images, warn
        self._map_from_world = map_from_world or Rigid3.identity()
        self._clock = RobotClock(config.use_sim_time)
        self._transforms, self._gate = TransformBuffer(), HealthGate()
        self._camera_gate = ContinuityGate()  # without odometry
        self._map_to_odom, self._health = MapToOdom(), Health()
        self._odometry: OdometryPose | None = None  # of the last image that had one
        self._user_pose: Any = None
        self._last_ns = self._last_stamp_ns = 0
        self._started_at: float | None = None  # the first image
        self._had_tf_at = 0.0  # that image, or the last one with TF
        self._rival_at = -math.inf  # when another node published map to odom
        self._sent_ns = deque[int](maxlen=200)  # the stamps of its own transforms
        self._warned = set[str]()
        self._lock, self._is_closed = threading.RLock(), threading.Event()
        self._publisher = RobotPublisher(node, config)
        self._create_readers(node)
        self._timer = threading.Thread(target=self._repeat, name="tf", daemon=True)
        self._timer.start()

    def close(self) -> None:
        """Stop publishing."""
        self._is_closed.set()
        self._timer.join(1.0)

    def localize(
        self, frame: QueryFrame, tracker: Tracker, camera_of_size: CameraOfSize | None
    ) -> QueryAnswer:
        """Localize the next image and publish its pose. Raises as `QueryFrame.localize`; MapError:
        the map has no scale."""
        if frame.t_ns < self._last_ns:
            self._reset(frame.t_ns)
            tracker.reset()
        self._last_ns = frame.t_ns
        if self._started_at is None:
            self._started_at = self._had_tf_at = time.monotonic()
        self._report("load", self._images and self._images.describe_load())
        odometry = self._find_odometry(frame.t_ns)
        if odometry is not None:
            frame = replace(frame, odom_from_cam=odometry.odom_from_cam)
            if (prior := self._take_prior(frame.t_ns, odometry)) is not None:
                tracker.expect(*prior, frame.t_ns, odometry.odom_from_cam)
        answer = frame.localize(tracker.cameras, tracker, camera_of_size)
        if answer.streamed is not None:
            answer.streamed.result.provenance.require_scale("a robot")
            self._report("image", _describe_image(answer.streamed))
            self._publish(answer.streamed, odometry)
        return answer

    def _create_readers(self, node: RosNode) -> None:
        ros, config = node.messages, self._config
        if not config.publish_initial_pose:
            kind = ros.PoseWithCovarianceStamped
            node.create_reader(INITIAL_POSE_TOPIC, kind, "reliable", self._take_user_pose)
        if config.has_odometry:
            node.create_reader("/tf", ros.TFMessage, "reliable", self._take_transforms)
            node.create_reader("/tf_static", ros.TFMessage, "latched", self._take_static)
        if config.use_sim_time:
            node.create_reader("/clock", ros.Clock, "sensor", self._take_time)

    def _take_transforms(self, message: Any) -> None:
        transforms = [stamped_transform(one) for one in message.transforms]
        odom_frame = self._config.odom_frame
        with self._lock:
            sent = set(self._sent_ns)
        if any(one.child == odom_frame and one.t_ns not in sent for one in transforms):
            self._rival_at = time.monotonic()
        self._transforms.add(transforms, is_static=False)

    def _take_static(self, message: Any) -> None:
        self._transforms.add(map(stamped_transform, message.transforms), is_static=True)

    def _take_time(self, message: Any) -> None:
        self._clock.set_simulated(stamp_ns(message.clock))

    def _take_user_pose(self, message: Any) -> None:
        name, expected = frame_id(message), self._config.map_frame
        if name != expected:
            self._warn(
                f"a pose on /{INITIAL_POSE_TOPIC} is ignored: it is in {name}, not {expected}"
            )
            return
        self._user_pose = message

    def _reset(self, t_ns: int) -> None:
        """Start again, because the clock was set back."""
        with self._lock:
            self._gate.reset()
            self._camera_gate = ContinuityGate()
            self._map_to_odom.reset()
            self._transforms.forget_after(t_ns)
            self._clock.reset()
            self._odometry, self._last_stamp_ns, self._started_at = None, 0, None

    def _find_odometry(self, t_ns: int) -> OdometryPose | None:
        """Return the odometry at the time of an image, None if there is none."""
        config, before = self._config, self._odometry
        if not config.has_odometry:
            return None
        self._clock.observe(t_ns)
        now = time.monotonic()
        is_early = now - (self._started_at or 0.0) < self.patience and self._clock.is_waiting
        self._report("clock", None if is_early else self._clock.describe_fault())
        text = f"another node publishes TF to {config.odom_frame}; stop it, or name the frames"
        seconds = 2.0  # it is reported for so long
        is_rival = now - self._rival_at < seconds
        self._report("rival", text if is_rival else None)
        camera = (self._images and self._images.frame_id) or config.camera_frame
        patience = 0.1  # seconds for the transforms at the time of the image
        try:
            odom_from_cam, base_from_cam = (
                self._transforms.look_up(target, camera, t_ns, patience)
                for target in (config.odom_frame, config.base_frame)
            )
        except TransformError as error:
            self._report("tf", None if now - self._had_tf_at < self.patience else str(error))
            return None
        self._report("tf", None)
        self._had_tf_at = now
        travelled = np.zeros(2)
        if before is not None:
            motion = before.odom_from_cam.inverse() @ odom_from_cam
            step = np.array([np.linalg.norm(motion.translation), motion.angle()])
            travelled = before.travelled + step
        self._odometry = OdometryPose(odom_from_cam, base_from_cam, travelled)
        return self._odometry

    def _take_prior(self, t_ns: int, odometry: OdometryPose) -> Uncertain | None:
        """Return world_from_cam that a user gave since the last image, if any."""
        message, self._user_pose = self._user_pose, None
        if message is None:
            return None
        map_from_base = pose_of_transform(stamped_transform(message))
        least = 0.1  # metres and radians; RViz gives no height, roll and pitch
        variances = np.clip(np.nan_to_num(message.pose.covariance[::7]), 0.0, 1e4)
        about = np.diag(variances + least**2)
        covariance = Rigid3(np.eye(3), map_from_base.translation).transform_covariance(about)
        pose, world_from_map = (
            map_from_base @ odometry.base_from_cam,
            self._map_from_world.inverse(),
        )
        self._gate.expect(_make_evidence(t_ns, (pose, covariance), odometry))
        return world_from_map @ pose, world_from_map.transform_covariance(covariance)

    def _publish(self, answer: StreamedPose, odometry: OdometryPose | None) -> None:
        """Publish the pose of an image if it is evidence and the gate agrees."""
        health = self._health
        pose, health.probability = self._measured_pose(answer)
        health.state = answer.state
        health.num_dropped = 0 if self._images is None else self._images.num_dropped
        self._camera_gate.observe(answer)
        if pose is not None and health.probability >= self._gate.min_probability:
            if not self._config.has_odometry:
                sigma = float(np.sqrt(np.trace(covariance_about(*pose)[:3, :3])))
                seen = StreamPose(answer.t_ns, pose[0], sigma, answer.track)
                if self._camera_gate.judge(seen) != "doubted":
                    self._publish_camera(answer.t_ns, *pose)
            elif odometry is not None:
                is_localized = answer.state == "localized"
                self._judge(_make_evidence(answer.t_ns, pose, odometry, is_localized), odometry)
        gate = self._gate if self._config.has_odometry else self._camera_gate
        health.is_contradicted = gate.is_contradicted
        health.latency_ms = (self._clock.now_ns() - answer.t_ns) / 1e6
        health.answer_at = time.monotonic()

    def _measured_pose(self, answer: StreamedPose) -> tuple[Uncertain | None, float]:
        """Return map_from_cam and its probability. None of a pose that is only predicted, or of an
        image that a camera repeats while it hangs."""
        result = answer.result
        if not (isinstance(result, Localization) and answer.is_measured):
            return None, 0.0
        pose, covariance = result.world_from_cam, result.covariance
        if answer.smoothed is not None and answer.smoothed_covariance is not None:
            pose, covariance = answer.smoothed, answer.smoothed_covariance
        moved = self._map_from_world.transform_covariance(covariance)
        return (self._map_from_world @ pose, moved), result.probability

    def _publish_camera(self, t_ns: int, map_from_cam: Rigid3, covariance: np.ndarray) -> None:
        """Publish the pose of a camera without odometry."""
        self._health.evidence_at = time.monotonic()
        self._publisher.send_transform(t_ns, self._config.camera_frame, map_from_cam)
        self._publisher.send_pose(t_ns, map_from_cam, covariance)

    def _judge(self, evidence: MeasuredPose, odometry: OdometryPose) -> None:
        """Ask the gate about a pose, and publish it if it agrees."""
        is_first, verdict = self._gate.agreed is None, self._gate.judge(evidence)
        if verdict == "doubted":
            return
        self._health.evidence_at = time.monotonic()
        self._health.num_jumps += verdict == "jumped" and not is_first
        cam_from_base = odometry.base_from_cam.inverse()
        map_from_base = evidence.map_from_cam @ cam_from_base
        odom_from_base = odometry.odom_from_cam @ cam_from_base
        if self._config.planar:
            self._check_tilt(map_from_base)
            map_from_base = project_to_plane(map_from_base)
            odom_from_base = project_to_plane(odom_from_base)
        with self._lock:
            self._map_to_odom.set_target(map_from_base, odom_from_base, verdict == "jumped")
        self._send_map_to_odom()
        self._publisher.send_pose(evidence.t_ns, map_from_base, evidence.covariance)

    def _check_tilt(self, map_from_base: Rigid3) -> None:
        angle, limit = tilt(map_from_base), 0.35  # radians, steeper than any ramp
        text = (
            f"the robot is tilted by {math.degrees(angle):.0f} degrees in the map; --planar needs a"
            " map whose z axis points up"
        )
        self._report("tilt", text if angle > limit else None)

    def _send_map_to_odom(self) -> None:
        """Publish the transform, stamped ahead. Its stamps increase, unless the clock is set."""
        ahead_ns, set_ns = round(1e9 * self.transform_tolerance), 1_000_000_000
        with self._lock:
            map_from_odom = self._map_to_odom.advance(time.monotonic())
            stamp_ns = self._clock.now_ns() + ahead_ns
            is_later = not 0 <= self._last_stamp_ns - stamp_ns < set_ns
            if map_from_odom is not None and is_later:
                self._last_stamp_ns = stamp_ns
                self._sent_ns.append(stamp_ns)
                self._publisher.send_transform(stamp_ns, self._config.odom_frame, map_from_odom)

    def _repeat(self) -> None:
        """Publish the transform and the diagnostics again and again; runs in the thread."""
        interval, due, before = 1.0, 0.0, None  # seconds between diagnostics of one level
        while not self._is_closed.wait(1.0 / self.rate):
            self._send_map_to_odom()
            if self._images is not None:
                self._take_faults(self._images)
            now = time.monotonic()
            level, text = self._health.judge(now)
            if now >= due or level != before:
                due, before = now + interval, level
                values = self._health.values(now, self._clock.offset)
                self._publisher.send_status(self._clock.now_ns(), level, text, values)

    def _take_faults(self, images: RosImages) -> None:
        """Take what the topic of the images says, also while it gives none."""
        faults = self._health.faults
        if images.fault is None:
            faults.pop("topic", None)
        else:
            faults["topic"] = images.fault
        self._health.notes = images.notes

    def _report(self, kind: str, text: str | None) -> None:
        """Take or remove a fault of a kind. The first of a kind is a warning as well."""
        if text is None:
            self._health.faults.pop(kind, None)
            return
        self._health.faults[kind] = text
        if kind not in self._warned:
            self._warned.add(kind)
            self._warn(text)


def _describe_image(answer: StreamedPose) -> str | None:
    """Return why an image cannot be used: it is damaged, of an unknown encoding, or sent again and
    again. A driver may send one twice."""
    result = answer.result
    is_twice = answer.is_repeated and answer.state != "lost"
    if isinstance(result, NotLocalized) and result.reason == "unreadable" and not is_twice:
        return result.detail
    return None


def _make_evidence(
    t_ns: int, pose: Uncertain, odometry: OdometryPose, is_localized: bool = False
) -> MeasuredPose:
    return MeasuredPose(t_ns, *pose, odometry.odom_from_cam, odometry.travelled, is_localized)
