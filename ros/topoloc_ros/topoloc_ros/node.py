"""The localizer as a node of rclpy, for middlewares other than DDS and for launch files with
parameters. `topoloc follow --ros` does the same without ROS."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import closing, suppress
from types import SimpleNamespace
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from topoloc import Localizer, TopolocError, Tracker
from topoloc.apps.cli.features_option import parse_camera
from topoloc.apps.robots.robot_localizer import RobotLocalizer
from topoloc.apps.robots.ros_images import RosImages
from topoloc.apps.robots.ros_node import RosNode, TopicReader
from topoloc_ros.parameters import OWN, by_position, robot_config, setting_names

_MADE = (
    Time, Header, Point, Vector3, Quaternion, Pose, PoseWithCovariance, PoseWithCovarianceStamped,
    Transform, TransformStamped, TFMessage, KeyValue, DiagnosticStatus, DiagnosticArray,
)  # fmt: skip
_READ = (Clock, Image, CompressedImage, CameraInfo)


class _Made:
    """A class of messages whose fields are given by position."""

    def __init__(self, kind: Any) -> None:
        self.kind, self._make = kind, by_position(kind)

    def __call__(self, *values: Any) -> Any:
        return self._make(*values)


class _Queue(TopicReader):
    """The last messages of a topic."""

    def __init__(self) -> None:
        self.arrived: deque[Any] = deque(maxlen=5)

    def take(self, num: int) -> list[Any]:
        return [self.arrived.popleft() for _ in range(min(num, len(self.arrived)))]


class RclpyNode(RosNode):
    """The topics of a node of rclpy, which a thread of `start` spins."""

    def __init__(self, node: Any) -> None:
        self._node, self.domain = node, node.context.get_domain_id()
        kinds = {kind.__name__: _Made(kind) for kind in _MADE}
        self.messages = SimpleNamespace(**kinds, **{kind.__name__: kind for kind in _READ})
        self._thread = threading.Thread(target=self._spin_node, name="ros", daemon=True)

    def create_writer(self, name: str, kind: Any) -> Callable[[Any], None]:
        publisher = self._node.create_publisher(kind.kind, name, 10)
        return publisher.publish

    def create_reader(
        self,
        name: str,
        kind: Any,
        quality: str,
        callback: Callable[[Any], None] | None = None,
    ) -> TopicReader:
        queue = _Queue()
        profile = QoSProfile(depth=5 if quality == "sensor" else 100)
        if quality == "sensor":
            profile.reliability = ReliabilityPolicy.BEST_EFFORT
        if quality == "latched":
            profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
        kind = kind.kind if isinstance(kind, _Made) else kind
        self._node.create_subscription(kind, name, callback or queue.arrived.append, profile)
        return queue

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._node.destroy_node()

    def _spin_node(self) -> None:
        with suppress(ExternalShutdownException):
            rclpy.spin(self._node)


def main() -> None:
    """Run the node until it is told to end."""
    rclpy.init()
    node = rclpy.create_node("topoloc")
    try:
        _follow(node)
    except TopolocError as error:
        node.get_logger().fatal(str(error))
        sys.exit(1)
    finally:
        rclpy.try_shutdown()


def _follow(node: Any) -> None:
    own = {name: node.declare_parameter(name, value).value for name, value in OWN.items()}
    defaults = {name: getattr(robot_config({}), name) for name in setting_names()}
    given = {name: node.declare_parameter(name, value).value for name, value in defaults.items()}
    given["use_sim_time"] = node.get_parameter("use_sim_time").value
    warn, stop = node.get_logger().warning, threading.Event()
    node.context.on_shutdown(stop.set)
    localizer, ros = Localizer(own["map"]), RclpyNode(node)
    of_size = parse_camera(localizer, own["camera"]) if own["camera"] else None
    images = RosImages(ros, f"ros:{own['image']}", of_size is not None, warn)
    with (
        closing(Tracker(localizer)) as tracker,
        closing(RobotLocalizer(ros, robot_config(given), images, warn)) as robot,
    ):
        for frame in images.frames(stop):
            robot.localize(frame, tracker, of_size)


if __name__ == "__main__":
    main()
