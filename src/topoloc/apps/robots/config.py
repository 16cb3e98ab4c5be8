"""Settings of the node of ROS 2 that `topoloc follow --ros` is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from topoloc.plugin import AtLeast, Between


@dataclass(frozen=True)
class RobotConfig:
    """Configure the frames, the topics, the transform from map to odom and its health gate."""

    domain: Annotated[int | None, Between(0, 232)] = None
    """ROS domain. None: that of ROS_DOMAIN_ID, else 0."""
    namespace: str = ""
    """Namespace of the topics, such as robot1. /tf, /tf_static, /clock and /diagnostics have
    none."""
    map_frame: str = "map"
    """Frame of the map."""
    odom_frame: str = "odom"
    """Frame of the odometry. "none": there is none, and TF is from the map to the camera."""
    base_frame: str = "base_link"
    """Frame of the robot, whose pose is published."""
    camera_frame: str = "topoloc_camera"
    """Optical frame of the images, if they are of no topic."""
    use_sim_time: bool = False
    """Take the time from /clock."""
    planar: bool = False
    """Publish x, y and yaw only. The robot drives on the plane z = 0 of the map."""
    rate: Annotated[float, Between(1, 1000)] = 20.0
    """Transforms per second, between the images too."""
    transform_tolerance: Annotated[float, Between(0, 10)] = 0.2
    """Seconds by which transforms are stamped ahead."""
    tf_wait: Annotated[float, Between(0, 10)] = 0.1
    """Seconds to wait for the transforms at the time of an image."""
    confirm_images: Annotated[int, Between(1, 1000)] = 3
    """Localized images that must agree by odometry before the first pose or a jump is published."""
    confirm_seconds: Annotated[float, AtLeast(0)] = 1.0
    """Seconds for which images must agree on a jump, five times as long if the robot stands."""
    min_probability: Annotated[float, Between(0, 1)] = 0.8
    """Least probability of a pose that counts as evidence."""
    jump: Literal["at_once", "smooth"] = "at_once"
    """How the transform follows a confirmed jump. Smaller corrections are always smooth."""
    correction_speed: Annotated[float, Between(0.001, 1e6)] = 0.5
    """Metres per second by which smooth corrections move the robot."""
    correction_turn: Annotated[float, Between(0.001, 1e6)] = 0.5
    """Radians per second by which smooth corrections turn the robot."""
    odometry_error: Annotated[float, Between(0, 1)] = 0.05
    """Error of the odometry, as a share of the way and of the rotation (one sigma)."""
    warn_after: Annotated[float, Between(0.001, 1e6)] = 1.0
    """Seconds without evidence after which /diagnostics says WARN."""
    lost_after: Annotated[float, Between(0.001, 1e6)] = 10.0
    """Seconds without evidence after which /diagnostics says ERROR."""
    clock_offset: Annotated[float, Between(0.001, 1e6)] = 0.5
    """Seconds between the stamps of images and this clock that mean another clock."""
    publish_initial_pose: bool = False
    """Publish the first confirmed pose on /initialpose once, instead of reading that topic."""

    @property
    def has_odometry(self) -> bool:
        """Return whether TF has odometry."""
        return self.odom_frame != "none"
