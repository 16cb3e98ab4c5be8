"""Test messages over DDS: their bytes follow ROS's IDL, by hand and by another implementation."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from topoloc.apps.robots.config import RobotConfig
from topoloc.apps.robots.ros_node import RosNode
from topoloc.errors import TopolocError

pytest.importorskip("cyclonedds", reason="the extra ros is not installed")


def test_the_bytes_are_those_of_the_idl():
    """CDR by hand: little endian, 8-byte numbers aligned after the encapsulation, strings with
    length and a zero."""
    from topoloc.apps.robots import ros_messages as ros

    header = ros.Header(ros.Time(7, 9), "map")
    pose = ros.Pose(ros.Point(1.0, 2.0, 3.0), ros.Quaternion(0.0, 0.0, 0.0, 1.0))
    covariance: Any = [float(number) for number in range(36)]
    data = ros.PoseWithCovarianceStamped(
        header, ros.PoseWithCovariance(pose, covariance)
    ).serialize()
    by_hand = (
        struct.pack("<iI", 7, 9)
        + struct.pack("<I4s", 4, b"map\0")
        + struct.pack("<7d", 1, 2, 3, 0, 0, 0, 1)
        + struct.pack("<36d", *covariance)
    )
    assert data[4 : 4 + len(by_hand)] == by_hand


def _messages(ros: Any) -> dict[str, Any]:
    header = ros.Header(ros.Time(7, 9), "camera")
    matrix = [float(number) for number in range(12)]
    roi = ros.RegionOfInterest(1, 2, 3, 4, True)
    status = ros.DiagnosticStatus(1, "name", "text", "id", [ros.KeyValue("a", "b")] * 3)
    turn = ros.Quaternion(0.0, 0.6, 0.0, 0.8)
    moved = ros.Transform(ros.Vector3(1.0, 2.0, 3.0), turn)
    info = (4, 3, "plumb_bob", [0.1] * 5, matrix[:9], matrix[:9], matrix, 1, 2, roi)
    return {
        "sensor_msgs/msg/Image": ros.Image(header, 2, 3, "mono8", 0, 4, bytes(range(8))),
        "sensor_msgs/msg/CompressedImage": ros.CompressedImage(header, "jpeg", b"\xff\xd8\xff"),
        "sensor_msgs/msg/CameraInfo": ros.CameraInfo(header, *info),
        "diagnostic_msgs/msg/DiagnosticArray": ros.DiagnosticArray(header, [status, status]),
        "tf2_msgs/msg/TFMessage": ros.TFMessage([ros.TransformStamped(header, "c", moved)] * 2),
        "rosgraph_msgs/msg/Clock": ros.Clock(ros.Time(5, 6)),
    }


@pytest.mark.parametrize(
    "kind",
    [
        "sensor_msgs/msg/Image",
        "sensor_msgs/msg/CompressedImage",
        "sensor_msgs/msg/CameraInfo",
        "diagnostic_msgs/msg/DiagnosticArray",
        "tf2_msgs/msg/TFMessage",
        "rosgraph_msgs/msg/Clock",
    ],
)
def test_another_implementation_reads_and_writes_the_same_bytes(kind: str):
    """rosbags has the definitions of ROS. It reads a message and writes it again unchanged."""
    typesys = pytest.importorskip("rosbags.typesys", reason="the extra bags is not installed")
    from topoloc.apps.robots import ros_messages as ros

    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    message = _messages(ros)[kind]
    data = message.serialize()
    again = bytes(store.serialize_cdr(store.deserialize_cdr(data, kind), kind))
    assert again.rstrip(b"\0") == bytes(data).rstrip(b"\0")
    package, _, name = kind.split("/")
    dds_name = type(message).__idl__.idl_transformed_typename
    assert dds_name == f"{package}::msg::dds_::{name}_"
    assert type(message).deserialize(again).serialize() == data


def test_names_of_topics_are_those_of_rmw():
    node = RosNode(RobotConfig(domain=77, namespace="/robot1/"))
    assert node.topic_name("/tf") == "rt/tf"
    assert node.topic_name("topoloc/pose") == "rt/robot1/topoloc/pose"
    node.close()


def test_a_domain_that_there_is_not_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "seven")
    with pytest.raises(TopolocError, match="ROS_DOMAIN_ID='seven'"):
        RosNode(RobotConfig())
    monkeypatch.setenv("ROS_DOMAIN_ID", "78")
    node = RosNode(RobotConfig())
    assert node.domain == 78
    node.close()


def test_without_a_network_the_error_is_one_sentence(monkeypatch: pytest.MonkeyPatch):
    interface = '<Interfaces><NetworkInterface name="nope0"/></Interfaces>'
    monkeypatch.setenv(
        "CYCLONEDDS_URI",
        f"<CycloneDDS><Domain><General>{interface}</General></Domain></CycloneDDS>",
    )
    with pytest.raises(TopolocError, match="DDS has no network here"):
        RosNode(RobotConfig(domain=79))


def test_a_damaged_message_costs_only_itself():
    """Another participant sends another type under the same name, so that the text of a short
    message is read as the length of image data."""
    from topoloc.apps.robots.ros_node import TopicReader

    class Reader:
        def __init__(self) -> None:
            self.left: list[Any] = [
                struct.error("unpack"),
                _Valid(3),
                UnicodeDecodeError,
                _Valid(4),
            ]

        def take(self, num: int) -> list[Any]:
            if not self.left:
                return []
            one = self.left.pop(0)
            if isinstance(one, _Valid):
                return [one]
            raise one if isinstance(one, Exception) else struct.error

    assert [one.number for one in TopicReader(Reader()).take(10)] == [3, 4]


class _Valid:
    def __init__(self, number: int) -> None:
        self.number = number
        self.sample_info = type("Info", (), {"valid_data": True})()


def test_a_reader_that_hangs_ends_no_writer(monkeypatch: pytest.MonkeyPatch):
    from cyclonedds.core import DDSException
    from cyclonedds.pub import DataWriter

    calls = list[Any]()

    def write(self: Any, sample: Any) -> None:
        calls.append(sample)
        raise DDSException(DDSException.DDS_RETCODE_TIMEOUT)

    node = RosNode(RobotConfig(domain=77))
    publish = node.create_writer("/clock", node.messages.Clock)
    monkeypatch.setattr(DataWriter, "write", write)
    publish("now")
    assert calls == ["now"]
    node.close()


def test_covariances_are_about_the_robot():
    """Random left perturbations move the robot by as much as the covariance about it states."""
    from topoloc.apps.robots.ros_node import covariance_about
    from topoloc.geometry.rigid import Rigid3

    pose = Rigid3.exp(np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3]))
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(6, 6)) * 1e-3
    draws = [Rigid3.exp(factor @ rng.normal(size=6)) @ pose for _ in range(4000)]
    moved = np.array([one.translation - pose.translation for one in draws])
    turned = np.array(
        [Rigid3((one.rotation @ pose.rotation.T), np.zeros(3)).log() for one in draws]
    )
    sample = np.cov(np.hstack([moved, turned[:, 3:]]).T)
    expected = covariance_about(pose, factor @ factor.T)
    assert np.abs(sample - expected).max() < 0.1 * np.abs(expected).max()
