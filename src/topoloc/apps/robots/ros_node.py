"""A node of ROS 2 by DDS alone: topics with ROS's names and qualities of service, a thread that
calls back for each message, and what a robot's localizer publishes."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from topoloc import MissingExtraError, Rigid3, TopolocError
from topoloc.apps.robots.config import RobotConfig

Quality = Literal["sensor", "reliable", "latched"]
INITIAL_POSE_TOPIC = "initialpose"
Uncertain = tuple[Rigid3, Float[np.ndarray, "6 6"]]
"""A pose and the covariance of its left perturbation."""


class TopicReader:
    """The messages of a topic that have arrived. `reader` is that of DDS."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def take(self, num: int) -> list[Any]:
        """Return the messages that have arrived, at most `num`. Damaged ones are left out."""
        messages = list[Any]()
        for _ in range(num):
            try:
                taken = self._reader.take(1)
            except Exception:  # decoders raise many classes for damaged bytes
                continue
            if not taken:
                break
            messages += [one for one in taken if one.sample_info.valid_data]
        return messages


class RosNode:
    """A participant of a ROS 2 domain until it is closed.

    Raises MissingExtraError: cyclonedds is not installed; TopolocError: there is no such domain, or
    no network for DDS.
    """

    def __init__(self, config: RobotConfig) -> None:
        with MissingExtraError.on_import("ROS needs cyclonedds", "ros"):
            from cyclonedds import core, domain

            from topoloc.apps.robots import ros_messages
            from topoloc.apps.robots.ros_announcement import Announcement
        self.messages: Any = ros_messages
        self._core, self._namespace = core, config.namespace.strip("/")
        self.domain = _find_domain(config)
        try:
            user_data = core.Policy.Userdata(b"enclave=/;")  # ROS lists no participant without it
            self._participant = domain.DomainParticipant(self.domain, core.Qos(user_data))
        except core.DDSException:
            raise TopolocError(
                f"ROS domain {self.domain}: DDS has no network here; connect one, or name an"
                " interface in CYCLONEDDS_URI"
            ) from None
        self._callbacks: list[tuple[TopicReader, Callable[[Any], None]]] = []
        self._waitset = core.WaitSet(self._participant)
        self._is_closed = threading.Event()
        self._announcement = Announcement(self._participant, self._namespace)
        self._call_back(self._announcement.reader, self._announcement.hear)
        self._thread = threading.Thread(target=self._spin, name="ros", daemon=True)
        self._thread.start()

    def topic_name(self, name: str) -> str:
        """Return the DDS name of a topic. A name without leading slash is in the namespace."""
        inside = f"{self._namespace}/{name}" if self._namespace else name
        return f"rt/{name[1:] if name.startswith('/') else inside}"

    def create_writer(self, name: str, kind: Any) -> Callable[[Any], None]:
        """Return a function that publishes a message, reliably, but for readers that hang."""
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        qos = self._quality("reliable")
        topic = Topic(self._participant, self.topic_name(name), kind, qos=qos)
        writer = DataWriter(self._participant, topic, qos=qos)
        self._announcement.add_writer(writer)

        def write(message: Any) -> None:
            with suppress(self._core.DDSException):
                writer.write(message)

        return write

    def create_reader(
        self, name: str, kind: Any, quality: Quality, callback: Callable[[Any], None] | None = None
    ) -> TopicReader:
        """Return a reader. `callback` gets each message, in a thread of the node."""
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        qos = self._quality(quality)
        topic = Topic(self._participant, self.topic_name(name), kind, qos=qos)
        reader = DataReader(self._participant, topic, qos=qos)
        self._announcement.add_reader(reader)
        if callback is not None:
            self._call_back(reader, callback)
        return TopicReader(reader)

    def _call_back(self, reader: Any, callback: Callable[[Any], None]) -> None:
        core = self._core
        states = core.ViewState.Any | core.InstanceState.Alive | core.SampleState.NotRead
        self._waitset.attach(core.ReadCondition(reader, states))
        self._callbacks.append((TopicReader(reader), callback))

    def close(self) -> None:
        """End the thread and leave the domain."""
        self._is_closed.set()
        self._thread.join(1.0)
        self._callbacks.clear()
        del self._announcement, self._waitset, self._participant

    def _spin(self) -> None:
        while not self._is_closed.is_set():
            self._waitset.wait(50_000_000)
            for reader, callback in self._callbacks:
                for message in reader.take(100):
                    with suppress(ValueError, TypeError, OverflowError, TopolocError):
                        callback(message)  # of a message whose numbers mean nothing

    def _quality(self, quality: Quality) -> Any:
        """Return the QoS: that of sensor data, that of most topics, or that of /tf_static."""
        from cyclonedds.core import Policy, Qos
        from cyclonedds.util import duration

        if quality == "sensor":
            return Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(5))
        reliable = Policy.Reliability.Reliable(duration(milliseconds=100))
        history = Policy.History.KeepLast(100)
        if quality == "latched":
            return Qos(reliable, history, Policy.Durability.TransientLocal)
        return Qos(reliable, history)


def _find_domain(config: RobotConfig) -> int:
    if config.domain is not None:
        return config.domain
    text = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not (text.isascii() and text.isdigit() and int(text) <= 232):
        raise TopolocError(f"ROS_DOMAIN_ID={text[:40]!r}: a number from 0 to 232 is expected")
    return int(text)


class RobotPublisher:
    """Publish TF, poses with covariance and diagnostics in the frame of the map. The covariance of
    a pose is ROS's: translation and rotation of the robot at its position, in axes of the map."""

    def __init__(self, node: RosNode, config: RobotConfig) -> None:
        ros = self._ros = node.messages
        self._map_frame = config.map_frame
        self._write_pose = node.create_writer("topoloc/pose", ros.PoseWithCovarianceStamped)
        self._write_tf = node.create_writer("/tf", ros.TFMessage)
        self._write_diagnostics = node.create_writer("/diagnostics", ros.DiagnosticArray)
        self._write_initial_pose = None
        if config.publish_initial_pose:
            kind = ros.PoseWithCovarianceStamped
            self._write_initial_pose = node.create_writer(INITIAL_POSE_TOPIC, kind)

    def send_pose(self, t_ns: int, pose: Rigid3, covariance: Float[np.ndarray, "6 6"]) -> None:
        """Publish a pose. The covariance is that of its left perturbation. The first pose may be
        the initial pose of others."""
        ros, transform = self._ros, self._make_transform(pose)
        place = transform.translation
        inner = ros.Pose(ros.Point(place.x, place.y, place.z), transform.rotation)
        about = covariance_about(pose, covariance).ravel().tolist()
        uncertain = ros.PoseWithCovariance(inner, about)
        message = ros.PoseWithCovarianceStamped(self._make_header(t_ns), uncertain)
        self._write_pose(message)
        if self._write_initial_pose is not None:
            self._write_initial_pose(message)
            self._write_initial_pose = None

    def send_transform(self, t_ns: int, child: str, map_from_child: Rigid3) -> None:
        """Publish a transform on /tf."""
        ros, transform = self._ros, self._make_transform(map_from_child)
        stamped = ros.TransformStamped(self._make_header(t_ns), child, transform)
        self._write_tf(ros.TFMessage([stamped]))

    def send_status(self, t_ns: int, level: int, text: str, values: dict[str, str]) -> None:
        """Publish a status on /diagnostics."""
        ros = self._ros
        pairs = [ros.KeyValue(key, value) for key, value in values.items()]
        status = ros.DiagnosticStatus(level, "topoloc: localization", text, "topoloc", pairs)
        self._write_diagnostics(ros.DiagnosticArray(self._make_header(t_ns), [status]))

    def _make_header(self, t_ns: int) -> Any:
        return self._ros.Header(self._ros.Time(*divmod(t_ns, 1_000_000_000)), self._map_frame)

    def _make_transform(self, pose: Rigid3) -> Any:
        ros, (w, i, j, k) = self._ros, pose.quat_wxyz().tolist()
        return ros.Transform(ros.Vector3(*pose.translation.tolist()), ros.Quaternion(i, j, k, w))


def covariance_about(
    pose: Rigid3, covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of the position of `pose` and of its rotation about that position, in
    axes of the world. `covariance` is that of the left perturbation about the origin."""
    return Rigid3(np.eye(3), -pose.translation).transform_covariance(covariance)
