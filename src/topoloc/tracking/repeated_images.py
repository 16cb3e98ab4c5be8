"""Distinguish a camera that stands still from one that hangs, by equal images.

Images of a real camera differ by noise. Equal images have two causes. A simulator without noise
gives them while the camera stands. A driver that hangs sends an old image again. Odometry decides:
equal images are old if it moves, or if the camera is known to have noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import UInt8

from topoloc.geometry.rigid import Rigid3
from topoloc.retrieval.coarse import Image

_REMEDY = (
    "restart its driver, or for a simulator give --simulated of `follow` (setting track.simulated)"
)


@dataclass(frozen=True)
class Repeat:
    """Hold the verdict on an image that equals its predecessor.

    Attributes:
        number: count of equal images before it.
        fault: reason why it is no evidence, one sentence. Empty: the camera stands.
        seconds: time without evidence.
    """

    number: int
    fault: str
    seconds: float


class RepeatedImages:
    """Hold the last image, and the odometry `odom_from_cam` at its first occurrence.

    Args:
        is_simulated: the camera has no noise, so equal images show that it stands.
    """

    max_motion: ClassVar[float] = 0.02
    """Metres and radians by which the odometry of a standing robot may change."""
    max_drift: ClassVar[float] = 0.002
    """The same, for each second that it stands."""
    noise_seconds: ClassVar[float] = 3.0
    """Seconds of differing images of a standing camera that show noise."""

    def __init__(self, is_simulated: bool) -> None:
        self._is_simulated, self._has_noise = is_simulated, False
        self._image: Image | None = None
        self._differs = False  # the last image from the one before, everywhere
        self._number, self._fault = 0, ""
        self._since_ns = self._evidence_ns = 0
        self.odom_from_cam: Rigid3 | None = None
        self._still: tuple[int, Rigid3, Rigid3] | None = None  # odometry and pose of a still camera

    def is_same(self, image: Image) -> bool:
        """Return whether the image equals the last one."""
        return self._image is not None and np.array_equal(self._image, image)

    def forget_image(self) -> None:
        """Forget the last image, because another one could not be read."""
        self._image = None

    def start(self, image: Image, t_ns: int, odom_from_cam: Rigid3 | None) -> None:
        """Take an image that differs from the last one."""
        self._differs = self._image is not None and _differs_everywhere(self._image, image)
        self._image = image.copy()  # the caller may reuse the buffer
        self._number, self._fault, self.odom_from_cam = 0, "", odom_from_cam
        self._since_ns = self._evidence_ns = t_ns

    def learn_noise(
        self, t_ns: int, odom_from_cam: Rigid3 | None, world_from_cam: Rigid3 | None
    ) -> None:
        """Take the pose of the last image. The camera has noise if images differ for long while
        pose and odometry stand still."""
        max_motion, max_change = 0.001, 0.03  # metres and radians; of odometry and of poses
        now = None
        if odom_from_cam is not None and world_from_cam is not None:
            now = t_ns, odom_from_cam, world_from_cam
        before = self._still
        is_still = (
            (before is not None and now is not None and self._differs)
            and now[1].is_same(before[1], max_motion, max_motion)
            and now[2].is_same(before[2], max_change, max_change)
        )
        if not is_still:
            self._still = now
        elif before is not None and t_ns - before[0] >= self.noise_seconds * 1e9:
            self._has_noise = True

    def repeat(self, t_ns: int, odom_from_cam: Rigid3 | None) -> Repeat:
        """Take an image that equals the last one."""
        self._number += 1
        if self.odom_from_cam is None:
            self.odom_from_cam = odom_from_cam
        self._fault = self._fault or self._find_motion(t_ns, odom_from_cam)
        fault = self._fault
        if not (fault or self._is_simulated):
            fault = self._find_doubt(odom_from_cam)
        if not fault:
            self._evidence_ns = t_ns
        return Repeat(self._number, fault, (t_ns - self._evidence_ns) / 1e9)

    def _find_motion(self, t_ns: int, odom_from_cam: Rigid3 | None) -> str:
        before = self.odom_from_cam
        if before is None or odom_from_cam is None:
            return ""
        seconds, longest = (t_ns - self._since_ns) / 1e9, 40.0  # of drift
        limit = self.max_motion + self.max_drift * min(seconds, longest)
        motion = before.inverse() @ odom_from_cam
        if motion.is_same(Rigid3.identity(), limit, limit):
            return ""
        way, turn = float(np.linalg.norm(motion.translation)), np.degrees(motion.angle())
        return (
            f"the camera hangs: its images are equal while odometry moved {way:.2f} m and"
            f" {turn:.0f} degrees; restart its driver"
        )

    def _find_doubt(self, odom_from_cam: Rigid3 | None) -> str:
        if self._has_noise:
            return (
                "the camera hangs: its images are equal, and differed before while the robot stood;"
                f" {_REMEDY}"
            )
        if odom_from_cam is None:
            return (
                "the images are equal: the camera hangs, or stands in a simulator without noise;"
                f" {_REMEDY}"
            )
        return ""


def _differs_everywhere(before: UInt8[np.ndarray, "..."], image: UInt8[np.ndarray, "..."]) -> bool:
    """Return whether pixels changed in nearly all parts of an image, as by noise. A moving object
    changes only some parts."""
    num, least = 4, 12  # parts along a side; least number of changed parts
    if before.shape != image.shape:
        return False
    rows, columns = (size // num * num for size in image.shape[:2])
    changed = (before != image).reshape(*image.shape[:2], -1).any(axis=2)[:rows, :columns]
    parts = changed.reshape(num, rows // num, num, columns // num).any(axis=(1, 3))
    return int(parts.sum()) >= least
