"""The transform from map to odom as it is published: it follows the agreed one smoothly, or at
once."""

from __future__ import annotations

import math

import numpy as np

from topoloc import Rigid3
from topoloc.apps.robots.config import RobotConfig


class MapToOdom:
    """Hold the published transform, and the one that it moves to."""

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._target: Rigid3 | None = None
        self._published = Rigid3.identity()
        self._odom_from_base, self._last = Rigid3.identity(), 0.0

    def reset(self) -> None:
        """Forget the transform."""
        self._target = None

    def set_target(self, map_from_base: Rigid3, odom_from_base: Rigid3, at_once: bool) -> None:
        """Take the agreed pose of the robot, measured and by odometry at the same time."""
        is_first, self._odom_from_base = self._target is None, odom_from_base
        self._target = map_from_base @ odom_from_base.inverse()
        if is_first or at_once:
            self._published = self._target

    def advance(self, seconds: float) -> Rigid3 | None:
        """Return map_from_odom at `seconds`, of any clock that goes on. None: not known yet."""
        elapsed, self._last = max(seconds - self._last, 0.0), seconds
        if self._target is None:
            return None
        # Corrections turn about the robot, since those about the origin of odom swing it.
        now, then = (one @ self._odom_from_base for one in (self._published, self._target))
        way = float(np.linalg.norm(then.translation - now.translation))
        turn = (now.inverse() @ then).angle()
        need = max(way / self._config.correction_speed, turn / self._config.correction_turn)
        if need <= elapsed:
            self._published = self._target
        else:
            moved = now.interpolate(then, elapsed / need)
            self._published = moved @ self._odom_from_base.inverse()
        return self._published


def project_to_plane(pose: Rigid3) -> Rigid3:
    """Return x, y and yaw of a pose in a frame whose z points up."""
    x, y = pose.translation[:2]
    yaw = math.atan2(pose.rotation[1, 0], pose.rotation[0, 0])
    turn = np.array([0.0, 0.0, 0.0, 0.0, 0.0, yaw])
    return Rigid3(Rigid3.exp(turn).rotation, np.array([x, y, 0.0]))


def tilt(pose: Rigid3) -> float:
    """Return the angle between the z axes of both frames, radians."""
    return math.acos(max(-1.0, min(1.0, float(pose.rotation[2, 2]))))
