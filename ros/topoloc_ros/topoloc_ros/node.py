"""The topics of topoloc by a node of rclpy, in place of DDS."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

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
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from topoloc.apps.robots.ros_node import RosNode, TopicReader
from topoloc_ros.parameters import by_position

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
    """The topics of a node of rclpy, which its executor calls back, until they are closed."""

    def __init__(self, node: Any) -> None:
        self._node, self.domain = node, node.context.get_domain_id()
        kinds = {kind.__name__: _Made(kind) for kind in _MADE}
        self.messages = SimpleNamespace(**kinds, **{kind.__name__: kind for kind in _READ})
        self._ends = list[Callable[[], Any]]()

    def create_writer(self, name: str, kind: Any) -> Callable[[Any], None]:
        publisher = self._node.create_publisher(kind.kind, name, 10)
        self._ends.append(lambda: self._node.destroy_publisher(publisher))
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
        kind, take = (
            kind.kind if isinstance(kind, _Made) else kind,
            callback or queue.arrived.append,
        )
        reader = self._node.create_subscription(kind, name, take, profile)
        self._ends.append(lambda: self._node.destroy_subscription(reader))
        return queue

    def close(self) -> None:
        while self._ends:
            self._ends.pop()()
