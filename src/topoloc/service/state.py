"""What the routes share: one service in one process."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from starlette.requests import HTTPConnection

from topoloc.atlas.open_maps import Maps
from topoloc.errors import TopolocError
from topoloc.localization.result import Localization, NotLocalized
from topoloc.service.answers import Answerer
from topoloc.service.config import ServiceConfig
from topoloc.service.logs import log
from topoloc.service.metrics import Metrics
from topoloc.service.refusals import Refusal, refusal_of
from topoloc.service.streams import Streams
from topoloc.service.workers import Workers

R = TypeVar("R")


@dataclass(eq=False)
class Service:
    """Maps, those who answer from them, and what is counted; `scenes` are the documents of some maps with the stamps of their files."""

    maps: Maps
    answerer: Answerer
    workers: Workers
    config: ServiceConfig
    metrics: Metrics
    streams: Streams
    scenes: dict[str, tuple[tuple[int, ...], bytes]] = field(default_factory=dict)

    async def work(self, request: HTTPConnection, job: Callable[[], R]) -> R:
        """What a worker makes of the job. Raises Refusal, whatever it raised."""
        try:
            return await self.workers.run(job, self.config.answer_s)
        except Exception as error:
            refusal = refusal_of(error)
            if not isinstance(error, TopolocError | Refusal):
                log("failure", logging.ERROR, error, request_id=request.scope["request_id"])
            raise refusal from error

    def count(self, request: HTTPConnection, name: str, result: Localization | NotLocalized) -> None:
        """The outcome, for the metrics and the log."""
        outcome = "localized" if isinstance(result, Localization) else result.reason
        self.metrics.answers.labels(name, outcome).inc()
        if "total" in result.times_ms:
            self.metrics.search_seconds.labels(name).observe(result.times_ms["total"] / 1e3)
        request.scope["facts"].update({"map": name, "outcome": outcome})

    async def close(self) -> None:
        """What has begun is finished; then the maps are closed."""
        await asyncio.to_thread(self.workers.close)
        self.streams.close()
        self.maps.close()


def service_of(request: HTTPConnection) -> Service:
    return request.app.state.service
