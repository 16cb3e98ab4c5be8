"""Streams: each has a tracker of its own, and keeps its map open until it ends or is forgotten."""

from __future__ import annotations

import threading
import time
import uuid
from contextlib import ExitStack
from dataclasses import dataclass, field
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


@dataclass(eq=False)
class Stream:
    """One stream; its lock is held while a picture of it is looked at, and `resources` keeps its
    map open."""

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
        idle_s: a stream without a picture for so long is forgotten.
    """

    def __init__(
        self,
        maps: MapCache[Localizer],
        query_handler: QueryHandler,
        config: TrackerConfig,
        max_streams: int,
        idle_s: float,
    ) -> None:
        self._maps, self._answerer, self._config = maps, query_handler, config
        self._max_streams, self._idle_s = max_streams, idle_s
        self._lock = threading.Lock()
        self._streams: dict[str, Stream] = {}

    def __len__(self) -> int:
        return len(self._streams)

    def begin(self, map_name: str, camera: str | None) -> Stream:
        """A stream in this map; `camera` is what its pictures' camera is called where they do not
        say it themselves.

        Raises:
            RequestError: there are too many, or there is no such map.
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
            raise RequestError(
                429, f"{self._max_streams} streams are followed already", retry_after_s=10
            )
        return stream

    def find(self, map_name: str, stream_id: str) -> Stream:
        """Raises RequestError."""
        stream = self._streams.get(stream_id)
        if stream is None or stream.map_name != map_name:
            raise RequestError(
                404, "there is no such stream here; one without a picture for a while is forgotten"
            )
        return stream

    def next(self, stream: Stream, query_request: QueryRequest, t_ns: int) -> dict[str, Any]:
        """The answer to the stream's next picture, as JSON.

        Raises:
            RequestError: the stream has ended, or looks at another picture still.
            TopolocError: the picture, its camera or its time is none.
        """
        if not stream.lock.acquire(blocking=False):
            raise RequestError(
                409,
                "the picture before is looked at still; the next one may come when that is"
                " answered",
            )
        try:
            if stream.is_ended:
                raise RequestError(404, "the stream has ended")
            stream.last_used = time.monotonic()
            named = QueryRequest(query_request.picture, query_request.camera or stream.camera)
            image, camera = self._answerer.decode_query(named, stream.tracker.localizer.topomap)
            if isinstance(camera, UncalibratedCamera):
                raise CalibrationError(
                    "a stream needs a calibrated camera: `map`, fx,fy,cx,cy or a JSON object"
                )
            return stream.tracker.process(image, camera, t_ns).to_json(query_request.picture.name)
        finally:
            stream.last_used = time.monotonic()
            stream.lock.release()

    def end(self, stream: Stream) -> None:
        """Forget it, when the picture that is being looked at is done."""
        with stream.lock:
            with self._lock:
                self._streams.pop(stream.id, None)
            if not stream.is_ended:
                stream.is_ended = True
                stream.resources.close()

    def forget_idle(self) -> None:
        """End those that nobody has used for long."""
        oldest = time.monotonic() - self._idle_s
        for stream in [
            one
            for one in list(self._streams.values())
            if one.last_used < oldest and not one.lock.locked()
        ]:
            self.end(stream)

    def close(self) -> None:
        for stream in list(self._streams.values()):
            self.end(stream)
