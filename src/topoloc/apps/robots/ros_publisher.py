"""Poses for robots on the network: PoseWithCovarianceStamped and TF over DDS, without ROS
installed.

The pose is that of the camera, x right, y down, z forward (ROS calls such a frame optical), in the
map's world. ROS writes a covariance for rotations about the axes of the pose's own frame of
reference, at the camera's own place: translation and rotation of the camera, in axes of the world.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc import MissingExtraError, Rigid3

POSE_TOPIC, TF_TOPIC = "rt/topoloc/pose", "rt/tf"
MAP_FRAME, CAMERA_FRAME = "map", "topoloc_camera"


class RosPublisher:
    """Publishes from when it is made until it is closed.

    Args:
        domain: ROS_DOMAIN_ID of the robots.

    Raises:
        MissingExtraError: cyclonedds is not installed.
    """

    def __init__(self, domain: int = 0) -> None:
        try:
            from cyclonedds.core import Policy, Qos
            from cyclonedds.domain import DomainParticipant
            from cyclonedds.pub import DataWriter
            from cyclonedds.topic import Topic
            from cyclonedds.util import duration

            from topoloc.apps.robots import ros_messages
        except ImportError as error:
            raise MissingExtraError(
                "publishing to ROS needs cyclonedds: pip install 'topoloc[ros]'"
            ) from error
        self._messages: Any = ros_messages
        self._participant = DomainParticipant(domain)
        qos = Qos(
            Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(10)
        )
        pose, tf = ros_messages.PoseWithCovarianceStamped, ros_messages.TFMessage
        self._poses: Any = DataWriter(
            self._participant, Topic(self._participant, POSE_TOPIC, pose, qos=qos), qos=qos
        )
        self._transforms: Any = DataWriter(
            self._participant, Topic(self._participant, TF_TOPIC, tf, qos=qos), qos=qos
        )

    def publish(
        self, t_ns: int, world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]
    ) -> None:
        """One pose.

        Args:
            covariance: of the left perturbation of world_from_cam (translation, rotation), as
                `Localization.covariance`.
        """
        ros = self._messages
        header = ros.Header(ros.Time(t_ns // 1_000_000_000, t_ns % 1_000_000_000), MAP_FRAME)
        x, y, z = world_from_cam.translation.tolist()
        w, i, j, k = world_from_cam.quat_wxyz().tolist()
        turn = ros.Quaternion(i, j, k, w)
        about_camera = camera_covariance_in_world(world_from_cam, covariance).ravel().tolist()
        pose = ros.PoseWithCovariance(ros.Pose(ros.Point(x, y, z), turn), about_camera)
        self._poses.write(ros.PoseWithCovarianceStamped(header, pose))
        transform = ros.TransformStamped(
            header, CAMERA_FRAME, ros.Transform(ros.Vector3(x, y, z), turn)
        )
        self._transforms.write(ros.TFMessage([transform]))

    def close(self) -> None:
        del self._poses, self._transforms, self._participant


def camera_covariance_in_world(
    world_from_cam: Rigid3, covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "6 6"]:
    """Of the camera's place and turn, about the camera, in axes of the world: the left perturbation
    moved from the origin to the camera."""
    at_camera = Rigid3(np.eye(3), -world_from_cam.translation).adjoint()
    return at_camera @ covariance @ at_camera.T
