"""The state that all routes share: one service in one process, and its worker threads."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TypeVar

from starlette.requests import HTTPConnection

from topoloc import Localization, Localizer, MapCache, NotLocalized, TopolocError
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.logs import Metrics, log
from topoloc.apps.service.query_handler import QueryHandler
from topoloc.apps.service.request_errors import RequestError, to_request_error
from topoloc.apps.service.streams import Streams
from topoloc.plugin import TilePending

R = TypeVar("R")


class Workers:
    """Threads that run jobs, and a queue of at most `max_queue` jobs, for the event loop."""

    def __init__(self, number: int, max_queue: int) -> None:
        self.number, self.max_queue = number, max_queue
        self._pool = ThreadPoolExecutor(number, thread_name_prefix="worker")
        self.num_jobs, self._seconds_per_job = 0, 0.05
        """Jobs in progress or waiting; their mean duration."""

    async def run(self, job: Callable[[], R], timeout_s: float) -> R:
        """Return the result of the job, or raise its error.

        Raises:
            RequestError: the queue is full, or the time is over. A job in progress then continues
                and its result is dropped.
        """
        if self.num_jobs >= self.number + self.max_queue:
            wait_s = max(1, round(self.num_jobs * self._seconds_per_job / self.number))
            raise RequestError(
                429, f"{self.num_jobs} requests are in progress or wait already", wait_s
            )
        self.num_jobs += 1
        loop = asyncio.get_running_loop()
        future: Future[R] = self._pool.submit(self._run_timed, job)
        future.add_done_callback(lambda _: loop.call_soon_threadsafe(self._finish_job))
        return await asyncio.wait_for(asyncio.wrap_future(future), timeout_s)

    def close(self) -> None:
        """Finish the jobs in progress and drop those that wait."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _run_timed(self, job: Callable[[], R]) -> R:
        start = time.perf_counter()
        try:
            return job()
        finally:
            self._seconds_per_job += 0.1 * (time.perf_counter() - start - self._seconds_per_job)

    def _finish_job(self) -> None:
        self.num_jobs -= 1


@dataclass(eq=False)
class Service:
    """Maps, workers and counters. `scenes` caches documents with the stamps of their files."""

    maps: MapCache[Localizer]
    query_handler: QueryHandler
    workers: Workers
    config: ServiceConfig
    metrics: Metrics
    streams: Streams
    scenes: dict[str, tuple[tuple[int, ...], bytes]] = field(default_factory=dict)
    num_awaiting: int = 0

    async def run_job(self, request: HTTPConnection, job: Callable[[], R]) -> R:
        """Return the result of a job from a worker.

        If the job needs a tile that is still being fetched, it is run again after the fetch. The
        worker is free meanwhile. Every error of the job becomes a RequestError.
        """
        start = time.monotonic()
        try:
            while True:
                left_s = self.config.answer_s - (time.monotonic() - start)
                try:
                    return await self.workers.run(job, left_s)
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
