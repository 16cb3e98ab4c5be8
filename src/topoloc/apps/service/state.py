"""What the routes share: one service in one process."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from starlette.requests import HTTPConnection

from topoloc import Localization, Localizer, MapCache, NotLocalized, TopolocError
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.logs import log
from topoloc.apps.service.metrics import Metrics
from topoloc.apps.service.query_handler import QueryHandler
from topoloc.apps.service.request_errors import RequestError, to_request_error
from topoloc.apps.service.streams import Streams
from topoloc.apps.service.workers import Workers
from topoloc.plugin import TilePending

R = TypeVar("R")


@dataclass(eq=False)
class Service:
    """Maps, those who answer from them, and what is counted; `scenes` are the documents of some
    maps with the stamps of their files."""

    maps: MapCache[Localizer]
    query_handler: QueryHandler
    workers: Workers
    config: ServiceConfig
    metrics: Metrics
    streams: Streams
    scenes: dict[str, tuple[tuple[int, ...], bytes]] = field(default_factory=dict)
    num_awaiting: int = 0

    async def run_job(self, request: HTTPConnection, job: Callable[[], R]) -> R:
        """What a worker makes of the job, which may be done again from its beginning: where it
        needs a tile that is not here, the worker is free for others until that has come. Raises
        RequestError, whatever it raised."""
        start = time.monotonic()
        try:
            while True:
                try:
                    return await self.workers.run(
                        job, self.config.answer_s, time.monotonic() - start
                    )
                except TilePending as awaited:
                    await self._wait_for_fetch(awaited)
        except Exception as error:
            refusal = to_request_error(error)
            if not isinstance(error, TopolocError | RequestError):
                log("failure", logging.ERROR, error, request_id=request.scope["request_id"])
            raise refusal from error

    async def _wait_for_fetch(self, awaited: TilePending) -> None:
        """When the tile is here, will not come, or has been waited for long enough. Raises
        RequestError where too many wait already."""
        if self.num_awaiting >= self.workers.number + self.workers.max_queue:
            raise RequestError(
                429,
                f"{self.num_awaiting} requests wait already for tiles that are being fetched",
                retry_after_s=5,
            )
        fetch = awaited.fetch
        self.num_awaiting += 1
        try:
            await asyncio.wait(
                [asyncio.wrap_future(fetch.future)],
                timeout=max(0.0, fetch.deadline - time.monotonic()),
            )
        finally:
            self.num_awaiting -= 1

    def count(
        self, request: HTTPConnection, name: str, result: Localization | NotLocalized
    ) -> None:
        """The outcome, for the metrics and the log."""
        outcome = "localized" if isinstance(result, Localization) else result.reason
        self.metrics.answers.labels(name, outcome).inc()
        if "total" in result.times_ms:
            self.metrics.search_seconds.labels(name).observe(result.times_ms["total"] / 1e3)
        request.scope["facts"].update({"map": name, "outcome": outcome})

    async def close(self) -> None:
        """What has begun is finished; then the maps are closed."""
        self.query_handler.atlases.close()
        await asyncio.to_thread(self.workers.close)
        self.streams.close()
        self.maps.close()


def get_service(request: HTTPConnection) -> Service:
    return request.app.state.service
