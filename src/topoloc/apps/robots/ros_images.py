"""Images of a topic of ROS 2 as queries: the newest one each time, with the calibration of the
topic `camera_info` beside it. The order of bytes is that of the pixels, if the label is wrong."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from topoloc import CalibrationError, Camera, RecordingError, StereoFrame, UnreadableImageError
from topoloc.apps.cli.queries.query_answers import QueryFrame
from topoloc.apps.formats.bags.bag_images import camera_info, decode_image, reduce_to_part
from topoloc.apps.formats.bags.messages import frame_id, stamp_ns
from topoloc.apps.formats.bags.pixel_order import compare_orders
from topoloc.apps.formats.bags.topics import is_rectified
from topoloc.apps.robots.ros_node import RosNode

PREFIX = "ros:"


def is_topic(source: str) -> bool:
    """Return whether a source is a topic, such as `ros:/camera/image_raw`."""
    return source.startswith(PREFIX)


def topic_of(source: str, example: str) -> str:
    """Return the name of a topic with its slash. Raises RecordingError: the source names none."""
    topic = f"/{source.removeprefix(PREFIX).lstrip('/')}"
    if not re.fullmatch(r"(/[A-Za-z]\w*)+", topic, re.ASCII):
        raise RecordingError(f"{source[:80]}: no topic of ROS; ros:/{example} is expected")
    return topic


class RosImages:
    """The images of a topic. `num_taken` counts them, and `num_dropped` those that a newer one
    replaced. `fault` says why there are none, `notes` what is mended.

    Args:
        source: `ros:` and the topic. One that ends with /compressed has JPEG or PNG images.
        has_camera: the camera is given, and camera_info is not needed.
        warn: gets one line for each fault and note.

    Raises RecordingError: the source names no topic.
    """

    def __init__(
        self, node: RosNode, source: str, has_camera: bool, warn: Callable[[str], None]
    ) -> None:
        messages, compressed = node.messages, "/compressed"
        self.topic = topic_of(source, "camera/image_raw")
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
        self.fault: str | None = None
        self.notes: dict[str, str] = {}
        self._orders: dict[tuple[str, int], list[float]] = {}  # evidence by encoding and its flag

    def frames(self, stop: threading.Event) -> Iterator[QueryFrame]:
        """Yield the newest image each time, until `stop`. An image that is older than the last one
        is dropped, unless the clock was set back. Images wait for their calibration."""
        patience, set_back_ns = 10.0, 1_000_000_000  # seconds without an image; nanoseconds
        since, last_ns, waiting_since, newest = time.monotonic(), 0, float("inf"), None
        while not stop.is_set():
            arrived = self._images.take(5)
            newer = [one for one in arrived if stamp_ns(one.header.stamp) > last_ns]
            if arrived and stamp_ns(arrived[-1].header.stamp) < last_ns - set_back_ns:
                newer = arrived[-1:]
            self.num_dropped += len(arrived) - min(len(newer), 1)
            if newer:
                newest, since = newer[-1], time.monotonic()
                last_ns, waiting_since = stamp_ns(newest.header.stamp), min(waiting_since, since)
            elif newest is None and time.monotonic() - since > patience:
                self._complain(self._describe_silence())
                since = float("inf")
            if newest is None or not self._has_calibration(waiting_since):
                stop.wait(0.002)
                continue
            message, newest, self.fault, waiting_since = newest, None, None, float("inf")
            self.frame_id = frame_id(message)
            self.num_taken += 1
            yield self._make_frame(f"{self.num_taken - 1:06d}", last_ns, message)

    def _has_calibration(self, since: float) -> bool:
        """Return whether the camera is known, or `camera_info` has come. Complain if images have
        waited for it long, `since` a time."""
        patience = 2.0  # seconds
        if self._infos is None:
            return True
        for info in self._infos.take(5):
            self._last_info = info
        is_late = self._last_info is None and time.monotonic() - since >= patience
        if is_late and self.fault is None:
            self._complain(
                f"{self.info_topic}: no calibration, so the images of {self.topic} wait; publish"
                " it, or give --camera FILE"
            )
        return self._last_info is not None

    def _complain(self, text: str) -> None:
        self.fault = text
        self._warn(text)

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

    def _make_frame(self, name: str, t_ns: int, message: Any) -> QueryFrame:
        def read() -> StereoFrame:
            place = f"{self.topic} {name}"
            image = decode_image(message, place, is_reversed=self._has_reversed_bytes(message))
            camera = self._find_camera(image.shape[1], image.shape[0])
            return StereoFrame(name, t_ns, image, camera)

        return QueryFrame(name, t_ns, read)

    def _has_reversed_bytes(self, message: Any) -> bool:
        """Return whether the pixels of the first images have another order of bytes than their
        label, as of a bag. A note says so."""
        num_samples = 5
        if not hasattr(message, "encoding"):
            return False
        encoding, flag = str(message.encoding), int(getattr(message, "is_bigendian", 0))
        evidence = self._orders.setdefault((encoding, flag), [])
        if len(evidence) < num_samples:
            with suppress(UnreadableImageError):
                evidence += [one for one in [compare_orders(message)] if not np.isnan(one)]
        is_reversed = bool(evidence) and float(np.median(evidence)) > 1.0
        kind = "pixel_order"
        if is_reversed and kind not in self.notes:
            label = f"is_bigendian {flag} of {encoding}" if "16" in encoding else encoding
            text = (
                f"the bytes of {self.topic} are in another order than {label} says: its pixels are"
                " smooth in that one alone, and are read in it"
            )
            self.notes |= {kind: text}
            self._warn(text)
        return is_reversed

    def _find_camera(self, width: int, height: int) -> Camera | None:
        """Return the camera of images of this size, None if it is given. Raises CalibrationError:
        K is zero, or means nothing."""
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
