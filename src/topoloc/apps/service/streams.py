"""Streams of images: each has its own tracker and keeps its map open until it ends."""

from __future__ import annotations

import asyncio
import ctypes
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from topoloc import (
    CalibrationError,
    Localizer,
    MapCache,
    Tracker,
    TrackerConfig,
    UncalibratedCamera,
)
from topoloc.apps.service.query_handler import QueryHandler
from topoloc.apps.service.query_request import QueryRequest
from topoloc.apps.service.request_errors import RequestError

_MAINTENANCE_PERIOD_S = 5.0


@dataclass(eq=False)
class Stream:
    """One stream. Its lock is held during a query. `resources` keep its map open."""

    map_name: str
    resources: ExitStack
    tracker: Tracker
    camera: str | None
    id: str = field(default_factory=lambda: uuid.uuid4().hex)
    lock: threading.Lock = field(default_factory=threading.Lock)
    last_used: float = field(default_factory=time.monotonic)
    is_ended: bool = False


class Streams:
    """All streams of a service, at most `max_streams`.

    Args:
        idle_s: seconds without an image after which a stream ends.
    """

    def __init__(
        self,
        maps: MapCache[Localizer],
        query_handler: QueryHandler,
        config: TrackerConfig,
        max_streams: int,
        idle_s: float,
    ) -> None:
        self._maps, self._query_handler, self._config = maps, query_handler, config
        self._max_streams, self._idle_s = max_streams, idle_s
        self._lock = threading.Lock()
        self._streams: dict[str, Stream] = {}

    def __len__(self) -> int:
        return len(self._streams)

    def begin(self, map_name: str, camera: str | None) -> Stream:
        """Begin a stream in a map. `camera` is the default for its images.

        Raises:
            RequestError: there are too many streams, or no such map.
            MapError: the map is damaged.
        """
        self.forget_idle()
        resources = ExitStack()
        localizer = resources.enter_context(self._maps.use_map(map_name)).content
        stream = Stream(map_name, resources, Tracker(localizer, self._config), camera)
        with self._lock:
            is_full = len(self._streams) >= self._max_streams
            if not is_full:
                self._streams[stream.id] = stream
        if is_full:
            resources.close()
            raise RequestError(429, f"{self._max_streams} streams are open already", 10)
        return stream

    def find(self, map_name: str, stream_id: str) -> Stream:
        """Return a stream by its id. Raises RequestError."""
        stream = self._streams.get(stream_id)
        if stream is None or stream.map_name != map_name:
            raise RequestError(404, "there is no such stream; a stream without images ends")
        return stream

    def next(self, stream: Stream, query_request: QueryRequest, t_ns: int) -> dict[str, Any]:
        """Return the result for the next image of a stream, as JSON.

        Raises:
            RequestError: the stream has ended, or its previous image is still in progress.
            TopolocError: the image, its camera or its time is invalid.
        """
        if not stream.lock.acquire(blocking=False):
            raise RequestError(409, "the previous image is in progress; send the next one after it")
        try:
            if stream.is_ended:
                raise RequestError(404, "the stream has ended")
            stream.last_used = time.monotonic()
            named = QueryRequest(query_request.picture, query_request.camera or stream.camera)
            image, camera = self._query_handler.decode_query(
                named, stream.tracker.localizer.topomap
            )
            if isinstance(camera, UncalibratedCamera):
                raise CalibrationError(
                    "a stream needs a calibrated camera: `map`, fx,fy,cx,cy or a JSON object"
                )
            return stream.tracker.process(image, camera, t_ns).to_json(query_request.picture.name)
        finally:
            stream.last_used = time.monotonic()
            stream.lock.release()

    def end(self, stream: Stream) -> None:
        """End a stream after its image in progress."""
        with stream.lock:
            with self._lock:
                self._streams.pop(stream.id, None)
            if not stream.is_ended:
                stream.is_ended = True
                stream.resources.close()

    def forget_idle(self) -> None:
        """End the streams without a recent image."""
        oldest = time.monotonic() - self._idle_s
        for stream in list(self._streams.values()):
            if stream.last_used < oldest and not stream.lock.locked():
                self.end(stream)

    def close(self) -> None:
        """End all streams."""
        for stream in list(self._streams.values()):
            self.end(stream)

    async def run_maintenance(self) -> None:
        """End idle streams and return free memory to the system, every few seconds.

        Without `malloc_trim` glibc keeps memory that threads freed: tens of megabytes after a
        thousand images.
        """
        while True:
            await asyncio.sleep(_MAINTENANCE_PERIOD_S)
            await asyncio.to_thread(self.forget_idle)
            if (trim := _find_malloc_trim()) is not None:
                await asyncio.to_thread(trim, 0)


@cache
def _find_malloc_trim() -> Callable[[int], int] | None:
    """Return the function of glibc; None with another C library."""
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return None
