"""The state that all routes share: worker threads, maps and streams. A stream has a tracker and
keeps its map open until it ends."""

from __future__ import annotations

import asyncio
import ctypes
import logging
import threading
import time
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, TypeVar

from starlette.requests import HTTPConnection

from topoloc import (
    Localization,
    Localizer,
    MapCache,
    NotLocalized,
    TopolocError,
    Tracker,
    TrackerConfig,
)
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.connections import while_connected
from topoloc.apps.service.logs import Metrics, log
from topoloc.apps.service.notes import NoteFiles
from topoloc.apps.service.protocols.discovery_messages import Announced
from topoloc.apps.service.query_handler import QueryHandler
from topoloc.apps.service.query_request import QueryRequest
from topoloc.apps.service.request_errors import RequestError, to_request_error
from topoloc.apps.service.tile_fetcher import TilePending

_MAINTENANCE_PERIOD_S = 5.0
R = TypeVar("R")


@dataclass(eq=False)
class Stream:
    """One stream. Its lock is held during a query. `resources` keep its map open."""

    map_name: str
    address: str
    resources: ExitStack
    tracker: Tracker
    camera: str | None
    id: str = field(default_factory=lambda: uuid.uuid4().hex)
    lock: threading.Lock = field(default_factory=threading.Lock)
    last_used: float = field(default_factory=time.monotonic)
    is_ended: bool = False


class Streams:
    """All streams of a service, at most `config.max_sessions`, and `max_sessions_per_address` of
    one address."""

    def __init__(
        self,
        maps: MapCache[Localizer],
        query_handler: QueryHandler,
        tracking: TrackerConfig,
        config: ServiceConfig,
    ) -> None:
        self._maps, self._query_handler = maps, query_handler
        self._tracking, self._config = tracking, config
        self._lock = threading.Lock()
        self._streams: dict[str, Stream] = {}

    def __len__(self) -> int:
        return len(self._streams)

    def begin(self, map_name: str, camera: str | None, address: str) -> Stream:
        """Begin a stream in a map for a client at this address. `camera` is the default for its
        images. Raises RequestError: there are too many streams, or no such map; MapError: the map
        is damaged."""
        self.forget_idle()
        resources = ExitStack()
        localizer = resources.enter_context(self._maps.use_map(map_name)).content
        stream = Stream(map_name, address, resources, Tracker(localizer, self._tracking), camera)
        with self._lock:
            fault = self._find_excess(address)
            if fault is None:
                self._streams[stream.id] = stream
        if fault is not None:
            resources.close()
            raise RequestError(429, fault, 10)
        return stream

    def _find_excess(self, address: str) -> str | None:
        """Return why this address may not begin a stream, None if it may."""
        number = sum(one.address == address for one in self._streams.values())
        if number >= self._config.max_sessions_per_address:
            return f"{number} streams of this address are open already"
        number = len(self._streams)
        return f"{number} streams are open already" if number >= self._config.max_sessions else None

    def find(self, map_name: str, stream_id: str) -> Stream:
        """Return a stream by its id. Raises RequestError."""
        stream = self._streams.get(stream_id)
        if stream is None or stream.map_name != map_name:
            raise RequestError(404, "there is no such stream; a stream without images ends")
        return stream

    def next(self, stream: Stream, query_request: QueryRequest, t_ns: int) -> dict[str, Any]:
        """Return the result for the next image of a stream, as JSON. Raises RequestError: the
        stream has ended, or its previous image is still in progress; TopolocError: the image, its
        camera or its time is invalid."""
        if not stream.lock.acquire(blocking=False):
            raise RequestError(409, "the previous image is in progress; send the next one after it")
        try:
            if stream.is_ended or query_request.stop.is_set():
                raise RequestError(404, "the stream has ended")
            stream.last_used = time.monotonic()
            named = replace(query_request, camera=query_request.camera or stream.camera)
            tracker, handler = stream.tracker, self._query_handler
            image, camera = handler.decode_query(named, tracker.localizer.topomap)
            deadline = handler.deadline_of(named.stop, named.max_ms)
            return tracker.process(image, camera, t_ns, None, deadline).to_json(named.picture.name)
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
        oldest = time.monotonic() - self._config.session_idle_s
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


class Workers:
    """Threads that run jobs, and a queue of at most `max_queue` jobs, for the event loop."""

    def __init__(self, number: int, max_queue: int) -> None:
        self.number, self.max_queue = number, max_queue
        self._places = asyncio.Semaphore(number)
        # as many again for jobs whose answer was given up, so that others go on
        self._pool = ThreadPoolExecutor(2 * number, thread_name_prefix="worker")
        self.num_jobs, self._seconds_per_job = 0, 0.05
        """Jobs in progress or waiting; their mean duration."""

    async def run(self, job: Callable[[], R], timeout_s: float) -> R:
        """Return the result of the job, or raise its error. Raises RequestError: the queue is full;
        TimeoutError: the time is over.

        If it is cancelled or late, a job in progress continues without its place."""
        if self.num_jobs >= self.number + self.max_queue:
            wait_s = max(1, round(self.num_jobs * self._seconds_per_job / self.number))
            raise RequestError(
                429, f"{self.num_jobs} requests are in progress or wait already", wait_s
            )
        self.num_jobs += 1
        try:
            async with asyncio.timeout(timeout_s), self._places:
                return await asyncio.wrap_future(self._pool.submit(self._run_timed, job))
        finally:
            self.num_jobs -= 1

    def close(self) -> None:
        """Finish the jobs in progress and drop those that wait."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _run_timed(self, job: Callable[[], R]) -> R:
        start = time.perf_counter()
        try:
            return job()
        finally:
            self._seconds_per_job += 0.1 * (time.perf_counter() - start - self._seconds_per_job)


@dataclass(eq=False)
class Service:
    """Maps, workers and counters. `scenes` caches documents with the stamps of their files,
    `announced` places with the time when they were looked at."""

    maps: MapCache[Localizer]
    query_handler: QueryHandler
    workers: Workers
    config: ServiceConfig
    metrics: Metrics
    streams: Streams
    notes: NoteFiles
    scenes: dict[str, tuple[tuple[int, ...], bytes]] = field(default_factory=dict)
    announced: tuple[float, list[Announced]] | None = None
    num_awaiting: int = 0

    async def run_job(
        self, request: HTTPConnection, job: Callable[[], R], stop: threading.Event | None = None
    ) -> R:
        """Return the result of a job from a worker. `stop` is set when the result is there, or when
        nobody waits for it any more: the client has gone, or the time is over.

        If the job needs a tile that is still being fetched, it is run again after the fetch. The
        worker is free meanwhile. Every error of the job becomes a RequestError.
        """
        start = time.monotonic()
        try:
            while True:
                left_s = self.config.answer_s - (time.monotonic() - start)
                try:
                    return await while_connected(request, self.workers.run(job, left_s))
                except TimeoutError:
                    raise RequestError(
                        503, f"no answer within {self.config.answer_s:g} s", 5
                    ) from None
                except TilePending as awaited:
                    await self._wait_for_fetch(awaited)
        except Exception as error:
            if not isinstance(error, TopolocError | RequestError):
                log("failure", logging.ERROR, error, request_id=request.scope["request_id"])
            raise to_request_error(error) from error
        finally:
            if stop is not None:
                stop.set()

    async def _wait_for_fetch(self, awaited: TilePending) -> None:
        """Wait for a tile until its deadline. Raises RequestError if too many requests wait."""
        if self.num_awaiting >= self.workers.number + self.workers.max_queue:
            raise RequestError(
                429, f"{self.num_awaiting} requests wait already for tiles that are fetched", 5
            )
        fetch = awaited.fetch
        self.num_awaiting += 1
        try:
            left_s = max(0.0, fetch.deadline - time.monotonic())
            await asyncio.wait([asyncio.wrap_future(fetch.future)], timeout=left_s)
        finally:
            self.num_awaiting -= 1

    def count(
        self, request: HTTPConnection, name: str, result: Localization | NotLocalized
    ) -> None:
        """Add the outcome to the metrics and the log."""
        outcome = "localized" if isinstance(result, Localization) else result.reason
        self.metrics.answers.labels(name, outcome).inc()
        if "total" in result.times_ms:
            self.metrics.search_seconds.labels(name).observe(result.times_ms["total"] / 1e3)
        request.scope["facts"].update({"map": name, "outcome": outcome})

    async def close(self) -> None:
        """Finish the jobs in progress, then close the maps."""
        self.query_handler.atlases.close()
        await asyncio.to_thread(self.workers.close)
        self.streams.close()
        self.maps.close()


def get_service(request: HTTPConnection) -> Service:
    """Return the service of a request."""
    return request.app.state.service
