"""Images of a running camera by OpenCV: a webcam, an RTSP or HTTP stream, a GStreamer pipeline.

A thread reads the source and keeps only the newest image, so a slow consumer skips images but has
no delay. For a recording the thread waits instead, and no image is lost.
"""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2

from topoloc import Image, RecordingError
from topoloc.apps.formats.video import silence_opencv

_URL = re.compile(r"(rtsps?|rtmp|https?|udp|tcp)://\S+", re.IGNORECASE)
_DEVICE = re.compile(r"\d{1,3}|/dev/video\d{1,3}")
_WAIT_S = 0.2
_CLOSE_TIMEOUT_S = 1.0


def is_live(source: str) -> bool:
    """Return whether this is a live source and no file: a device number or ``/dev/video0``, a URL,
    or a pipeline with `` ! ``."""
    if _URL.fullmatch(source) or " ! " in source or source.startswith("/dev/video"):
        return True
    return bool(_DEVICE.fullmatch(source)) and not os.path.exists(source)


@dataclass(frozen=True, eq=False)
class LiveImage:
    """An image, grey (H, W) or RGB (H, W, 3), uint8. `t_ns` is the clock's time of its arrival,
    nanoseconds. `number` counts all images of the source, with the skipped ones."""

    image: Image
    t_ns: int
    number: int


class LiveSource:
    """An open source; iterating gives its pictures until it ends or `stop` is set. A context
    manager that closes it. Raises RecordingError: it cannot be opened; while iterating: it has
    stalled.

    Args:
        source: see `is_live`; a video file is read as if it were live.
        keep_all: no picture is dropped; the source waits.
        size: requested width and height of the images (pixels).
        stall_s: seconds without a picture after which the source has stalled.
    """

    def __init__(
        self,
        source: str,
        keep_all: bool = False,
        size: tuple[int, int] | None = None,
        stall_s: float = 10.0,
    ) -> None:
        self.source, self.keep_all, self.stall_s = source, keep_all, stall_s
        self.num_read, self.stop = 0, threading.Event()
        self._capture = _open_capture(source, size, stall_s)
        self._changed, self._latest = threading.Condition(), None
        self._is_ended = self._is_closed = False
        self._thread = threading.Thread(target=self._read_loop, name=f"live {source}", daemon=True)
        self._thread.start()

    def __enter__(self) -> LiveSource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[LiveImage]:
        while (picture := self._next()) is not None:
            yield picture

    def close(self) -> None:
        """Close the source. A read that hangs ends at its own time limit."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._thread.join(_CLOSE_TIMEOUT_S)

    def _next(self) -> LiveImage | None:
        since = time.monotonic()
        with self._changed:
            while self._latest is None and not self._is_ended and not self.stop.is_set():
                if time.monotonic() - since > self.stall_s:
                    raise RecordingError(f"{self.source}: no image for {self.stall_s:g} s")
                self._changed.wait(_WAIT_S)
            picture, self._latest = self._latest, None
            self._changed.notify_all()
        return None if self.stop.is_set() else picture

    def _read_loop(self) -> None:
        """Read until the source ends or is closed; runs in the thread."""
        last_ns = 0
        while not self._is_closed:
            is_read, pixels = self._capture.read()
            last_ns = max(time.time_ns(), last_ns + 1)
            with self._changed:
                if not is_read or pixels is None:
                    break
                while self.keep_all and self._latest is not None and not self._is_closed:
                    self._changed.wait(_WAIT_S)
                image = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
                self._latest = LiveImage(image, last_ns, self.num_read)
                self.num_read += 1
                self._changed.notify_all()
        with self._changed:
            self._is_ended = True
            self._changed.notify_all()
        self._capture.release()


def _open_capture(source: str, size: tuple[int, int] | None, stall_s: float) -> Any:
    """Open an OpenCV capture. Raises RecordingError."""
    is_pipeline = " ! " in source
    if is_pipeline and not cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER):
        raise RecordingError(
            f"{source}: this OpenCV has no GStreamer; use rtsp://, http:// or a device number"
        )
    with silence_opencv():
        if is_pipeline:
            capture = cv2.VideoCapture(source, cv2.CAP_GSTREAMER)
        elif _URL.fullmatch(source):
            ms = round(1e3 * stall_s)
            limits = {cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC: 2 * ms}
            flat = [number for pair in limits.items() for number in pair]
            capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, flat)
        else:
            is_number = source.isdigit() and not os.path.exists(source)
            capture = cv2.VideoCapture(int(source) if is_number else source)
        if capture.isOpened() and size is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    if not capture.isOpened():
        raise RecordingError(f"{source}: no such camera or stream, or it does not answer")
    return capture
