"""Poses over DDS: what another participant receives, and the bytes that ROS's IDL asks for."""

from __future__ import annotations

import struct
import time
from typing import Any

import numpy as np
import pytest

from topoloc.apps.robots.ros_publisher import (
    POSE_TOPIC,
    TF_TOPIC,
    RosPublisher,
    camera_covariance_in_world,
)
from topoloc.geometry.rigid import Rigid3

cyclonedds = pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
POSE = Rigid3.exp(np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3]))
T_NS = 1_700_000_000_123_456_789


def test_the_bytes_are_those_of_the_idl():
    """CDR by hand: little endian, 8-byte numbers aligned after the encapsulation, texts with their
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
    names = {
        cls.__idl__.idl_transformed_typename
        for cls in (ros.PoseWithCovarianceStamped, ros.TFMessage)
    }
    assert names == {
        "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_",
        "tf2_msgs::msg::dds_::TFMessage_",
    }


def test_another_participant_receives_them():
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from topoloc.apps.robots import ros_messages as ros

    other = DomainParticipant(77)
    readers = [
        DataReader(other, Topic(other, name, kind))
        for name, kind in ((POSE_TOPIC, ros.PoseWithCovarianceStamped), (TF_TOPIC, ros.TFMessage))
    ]
    publisher = RosPublisher(77)
    received: list[list[object]] = [[], []]
    end = time.monotonic() + 20.0
    while not all(received) and time.monotonic() < end:
        publisher.publish(T_NS, POSE, np.eye(6))
        time.sleep(0.05)
        for reader, of_it in zip(readers, received, strict=True):
            of_it.extend(reader.take(10))
    publisher.close()
    pose, transforms = received[0][0], received[1][0]
    assert isinstance(pose, ros.PoseWithCovarianceStamped)
    assert isinstance(transforms, ros.TFMessage)
    assert (pose.header.stamp.sec, pose.header.stamp.nanosec, pose.header.frame_id) == (
        1_700_000_000,
        123_456_789,
        "map",
    )
    assert [
        pose.pose.pose.position.x,
        pose.pose.pose.position.y,
        pose.pose.pose.position.z,
    ] == POSE.translation.tolist()
    first: Any = transforms.transforms
    assert first[0].transform.rotation.w == POSE.quat_wxyz()[0]


def test_the_covariance_is_that_of_the_camera_itself():
    """Perturbations by hand: draws of the left perturbation move the camera by as much as the
    covariance about it says."""
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(6, 6)) * 1e-3
    draws = [Rigid3.exp(factor @ rng.normal(size=6)) @ POSE for _ in range(4000)]
    moved = np.array([pose.translation - POSE.translation for pose in draws])
    turned = np.array(
        [Rigid3((pose.rotation @ POSE.rotation.T), np.zeros(3)).log()[3:] for pose in draws]
    )
    sample = np.cov(np.hstack([moved, turned]).T)
    expected = camera_covariance_in_world(POSE, factor @ factor.T)
    assert np.abs(sample - expected).max() < 0.1 * np.abs(expected).max()
