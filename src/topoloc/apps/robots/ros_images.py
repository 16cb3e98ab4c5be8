"""Images of a topic of ROS 2 as queries: the newest one each time, with the calibration of the
topic `camera_info` beside it."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

from topoloc import CalibrationError, Camera, RecordingError, StereoFrame
from topoloc.apps.cli.queries.query_answers import QueryFrame
from topoloc.apps.formats.bags.bag_images import camera_info, decode_image, reduce_to_part
from topoloc.apps.formats.bags.messages import frame_id, stamp_ns
from topoloc.apps.formats.bags.topics import is_rectified
from topoloc.apps.robots.ros_node import RosNode

PREFIX = "ros:"


def is_topic(source: str) -> bool:
    """Return whether a source is a topic, such as `ros:/camera/image_raw`."""
    return source.startswith(PREFIX)


class RosImages:
    """The images of a topic. `num_taken` counts them, and `num_dropped` those that a newer one
    replaced.

    Args:
        source: `ros:` and the topic. One that ends with /compressed has JPEG or PNG images.
        has_camera: the camera is given, and camera_info is not needed.
        warn: gets one line if no images come.

    Raises RecordingError: the source names no topic.
    """

    def __init__(
        self, node: RosNode, source: str, has_camera: bool, warn: Callable[[str], None]
    ) -> None:
        messages, compressed = node.messages, "/compressed"
        self.topic = f"/{source.removeprefix(PREFIX).lstrip('/')}"
        if not re.fullmatch(r"(/[A-Za-z]\w*)+", self.topic, re.ASCII):
            raise RecordingError(
                f"{source[:80]}: no topic of ROS; ros:/camera/image_raw is expected"
            )
        kind = messages.Image
        if self.topic.endswith(compressed):
            kind = messages.CompressedImage
        self.info_topic = f"{self.topic.removesuffix(compressed).rpartition('/')[0]}/camera_info"
        self._images = node.create_reader(self.topic, kind, "sensor")
        self._infos = None
        if not has_camera:
            self._infos = node.create_reader(self.info_topic, messages.CameraInfo, "sensor")
        self._warn, self._domain = warn, node.domain
        self._cameras: dict[tuple[int, int], Camera] = {}
        self._last_info: Any = None
        self.frame_id, self.num_taken, self.num_dropped = "", 0, 0

    def frames(self, stop: threading.Event) -> Iterator[QueryFrame]:
        """Yield the newest image each time, until `stop`. An image that is older than the last one
        is dropped, unless the clock was set back. Raises CalibrationError: K is zero, or there is
        no calibration."""
        patience, set_back_ns = 10.0, 1_000_000_000  # seconds without an image; nanoseconds
        since, last_ns = time.monotonic(), 0
        while not stop.is_set():
            arrived = self._images.take(5)
            newer = [one for one in arrived if stamp_ns(one.header.stamp) > last_ns]
            if arrived and stamp_ns(arrived[-1].header.stamp) < last_ns - set_back_ns:
                newer = arrived[-1:]
            self.num_dropped += len(arrived) - min(len(newer), 1)
            if not newer:
                if time.monotonic() - since > patience:
                    self._warn(self._describe_silence())
                    since = float("inf")
                stop.wait(0.002)
                continue
            message = newer[-1]
            since, last_ns = time.monotonic(), stamp_ns(message.header.stamp)
            self.frame_id = frame_id(message)
            self.num_taken += 1
            yield self._make_frame(f"{self.num_taken - 1:06d}", last_ns, message, stop)

    def describe_load(self) -> str | None:
        """Return a sentence if images come twice as fast as they are taken, or faster."""
        taken, dropped = self.num_taken, self.num_dropped
        if dropped < taken or taken < 100:  # the first ones take longer
            return None
        return (
            f"images come faster than answers ({dropped} of {dropped + taken} dropped); lower the"
            " rate of the camera or the size of its images"
        )

    def _describe_silence(self) -> str:
        return (
            f"{self.topic}: no image for 10 s in ROS domain {self._domain}; check the topic's name"
            " and ROS_DOMAIN_ID"
        )

    def _make_frame(self, name: str, t_ns: int, message: Any, stop: threading.Event) -> QueryFrame:
        def read() -> StereoFrame:
            image = decode_image(message, f"{self.topic} {name}")
            camera = self._find_camera(image.shape[1], image.shape[0], stop)
            return StereoFrame(name, t_ns, image, camera)

        return QueryFrame(name, t_ns, read)

    def _find_camera(self, width: int, height: int, stop: threading.Event) -> Camera | None:
        """Return the camera of images of this size, None if it is given. Wait for its message."""
        if self._infos is None:
            return None
        wait_s = 5.0
        end = time.monotonic() + wait_s
        while True:
            for info in self._infos.take(5):
                self._last_info = info
            if self._last_info is not None or stop.is_set():
                break
            if time.monotonic() > end:
                raise CalibrationError(
                    f"{self.info_topic}: no calibration for 5 s; publish it, or give --camera FILE"
                )
            stop.wait(0.01)
        if self._last_info is None:
            return None
        if (width, height) not in self._cameras:
            self._cameras[width, height] = self._read_camera(width, height)
        return self._cameras[width, height]

    def _read_camera(self, width: int, height: int) -> Camera:
        message = self._last_info
        info = camera_info(message, self.info_topic)
        reduced = reduce_to_part(info, message)
        if (info.width, info.height) != (width, height):
            info = reduced
        if not info.is_calibrated:
            raise CalibrationError(
                f"{self.info_topic}: K is zero, the camera is not calibrated; calibrate it, or give"
                " --camera FILE"
            )
        return info.camera(is_rectified(self.topic))
