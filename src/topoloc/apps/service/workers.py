"""Threads that answer, beside the loop that listens; and the line of those who wait for them, which
has an end."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from topoloc.apps.service.request_errors import RequestError

R = TypeVar("R")


class Workers:
    """So many threads, and at most `max_queue` jobs that wait for them. Called from the loop
    alone."""

    def __init__(self, number: int, max_queue: int) -> None:
        self.number, self.max_queue = number, max_queue
        self._pool = ThreadPoolExecutor(number, thread_name_prefix="worker")
        self._num_jobs, self._seconds_a_job = 0, 0.05

    @property
    def num_jobs(self) -> int:
        """Jobs that are done or wait."""
        return self._num_jobs

    async def run(self, job: Callable[[], R], timeout_s: float, spent_s: float = 0.0) -> R:
        """What the job returns or raises; of the seconds until it takes too long some may be spent.

        Raises:
            RequestError: too many wait already; or it took too long, in which case a job that had
                begun is finished for nobody.
        """
        if self._num_jobs >= self.number + self.max_queue:
            wait_s = max(1, round(self._num_jobs * self._seconds_a_job / self.number))
            raise RequestError(
                429,
                f"{self._num_jobs} requests are being answered or wait already",
                retry_after_s=wait_s,
            )
        self._num_jobs += 1
        loop = asyncio.get_running_loop()
        future: Future[R] = self._pool.submit(self._run_timed, job)
        future.add_done_callback(lambda _: loop.call_soon_threadsafe(self._finish_job))
        try:
            return await asyncio.wait_for(asyncio.wrap_future(future), timeout_s - spent_s)
        except TimeoutError:
            raise RequestError(503, f"no answer within {timeout_s:g} s", retry_after_s=5) from None

    def close(self) -> None:
        """What has begun is finished, what waits is not."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _run_timed(self, job: Callable[[], R]) -> R:
        start = time.perf_counter()
        try:
            return job()
        finally:
            self._seconds_a_job += 0.1 * (time.perf_counter() - start - self._seconds_a_job)

    def _finish_job(self) -> None:
        self._num_jobs -= 1
