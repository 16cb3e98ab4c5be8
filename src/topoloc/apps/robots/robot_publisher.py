"""Publish TF, poses with covariance and diagnostics in the frame of the map.

The covariance of a pose is ROS's: translation and rotation of the robot at its position, in axes of
the map.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc import Rigid3
from topoloc.apps.robots.config import RobotConfig
from topoloc.apps.robots.ros_node import RosNode

POSE_TOPIC, INITIAL_POSE_TOPIC = "topoloc/pose", "initialpose"
Uncertain = tuple[Rigid3, Float[np.ndarray, "6 6"]]
"""A pose and the covariance of its left perturbation."""


class RobotPublisher:
    """Hold the writers of a node."""

    def __init__(self, node: RosNode, config: RobotConfig) -> None:
        ros = self._ros = node.messages
        self._map_frame = config.map_frame
        self._write_pose = node.create_writer(POSE_TOPIC, ros.PoseWithCovarianceStamped)
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
