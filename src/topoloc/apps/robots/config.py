"""Settings of the node of ROS 2 that `topoloc follow --ros` is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from topoloc.plugin import Between


@dataclass(frozen=True)
class RobotConfig:
    """Configure the frames and the topics. Each setting but the domain is an option, too."""

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
    publish_initial_pose: bool = False
    """Publish the first confirmed pose on /initialpose once, instead of reading that topic."""

    @property
    def has_odometry(self) -> bool:
        """Return whether TF has odometry."""
        return self.odom_frame != "none"
