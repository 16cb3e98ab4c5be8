"""Publish poses over DDS as PoseWithCovarianceStamped and TF. ROS need not be installed.

A pose is that of the camera in the map's world: x right, y down, z forward, an optical frame of
ROS. Its covariance is ROS's: translation and rotation of the camera at its position, in axes of the
world.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc import MissingExtraError, Rigid3

POSE_TOPIC, TF_TOPIC = "rt/topoloc/pose", "rt/tf"
MAP_FRAME, CAMERA_FRAME = "map", "topoloc_camera"


class RosPublisher:
    """A participant of a ROS 2 domain that publishes until it is closed. `domain`: ROS_DOMAIN_ID of
    the robots. Raises MissingExtraError: cyclonedds is not installed."""

    def __init__(self, domain: int = 0) -> None:
        with MissingExtraError.on_import("publishing to ROS needs cyclonedds", "ros"):
            from cyclonedds.core import Policy, Qos
            from cyclonedds.domain import DomainParticipant
            from cyclonedds.pub import DataWriter
            from cyclonedds.topic import Topic
            from cyclonedds.util import duration

            from topoloc.apps.robots import ros_messages
        self._messages: Any = ros_messages
        self._participant = DomainParticipant(domain)
        reliable = Policy.Reliability.Reliable(duration(milliseconds=100))
        qos = Qos(reliable, Policy.History.KeepLast(10))

        def create_writer(topic: str, kind: Any) -> Any:
            named = Topic(self._participant, topic, kind, qos=qos)
            return DataWriter(self._participant, named, qos=qos)

        self._poses = create_writer(POSE_TOPIC, ros_messages.PoseWithCovarianceStamped)
        self._transforms = create_writer(TF_TOPIC, ros_messages.TFMessage)

    def publish(
        self, t_ns: int, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]
    ) -> None:
        """Publish a pose. The covariance is that of `Localization`."""
        ros = self._messages
        header = ros.Header(ros.Time(*divmod(t_ns, 1_000_000_000)), MAP_FRAME)
        x, y, z = world_from_cam.translation.tolist()
        w, i, j, k = world_from_cam.quat_wxyz().tolist()
        turn = ros.Quaternion(i, j, k, w)
        about_camera = camera_covariance_in_world(world_from_cam, covariance).ravel().tolist()
        pose = ros.PoseWithCovariance(ros.Pose(ros.Point(x, y, z), turn), about_camera)
        self._poses.write(ros.PoseWithCovarianceStamped(header, pose))
        moved = ros.Transform(ros.Vector3(x, y, z), turn)
        self._transforms.write(ros.TFMessage([ros.TransformStamped(header, CAMERA_FRAME, moved)]))

    def close(self) -> None:
        del self._poses, self._transforms, self._participant


def camera_covariance_in_world(
    world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance of the camera's position and rotation about the camera, in axes of the
    world. `covariance` is that of the left perturbation about the origin."""
    return Rigid3(np.eye(3), -world_from_cam.translation).transform_covariance(covariance)
