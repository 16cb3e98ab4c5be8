"""Log lines (JSON on standard error) and Prometheus metrics of the service.

Log lines contain no image content.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
)

LOGGER = logging.getLogger("topoloc.apps.service")
_SECONDS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)


class _JsonLines(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "event": record.getMessage(),
        } | getattr(record, "facts", {})
        if record.exc_info:
            line["trace"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def log_json() -> None:
    """Write all log records of the service, uvicorn and asyncio as JSON lines to standard error."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_JsonLines())
    for name in (LOGGER.name, "uvicorn", "asyncio"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [handler], False
        logger.setLevel(logging.INFO if name == LOGGER.name else logging.WARNING)


def log(
    event: str, level: int = logging.INFO, failure: BaseException | None = None, **facts: Any
) -> None:
    """Write one line, with the trace of a failure."""
    LOGGER.log(level, event, exc_info=failure, extra={"facts": facts})


class Metrics:
    """The Prometheus counters of one service."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        self.requests = self._counter(
            "topoloc_requests", "Requests by route and status.", "route", "status"
        )
        meaning = "Results by map and outcome: localized, or the reason of the refusal."
        self.answers = self._counter("topoloc_answers", meaning, "map", "outcome")
        self.seconds = self._histogram(
            "topoloc_request_seconds", "Seconds from request head to end of response.", "route"
        )
        self.search_seconds = self._histogram(
            "topoloc_localize_seconds", "Seconds of localization, without waiting.", "map"
        )

    def _counter(self, name: str, meaning: str, *labels: str) -> Counter:
        return Counter(name, meaning, labels, registry=self.registry)

    def _histogram(self, name: str, meaning: str, label: str) -> Histogram:
        return Histogram(name, meaning, (label,), registry=self.registry, buckets=_SECONDS)

    def gauge(self, name: str, meaning: str, value: Callable[[], float]) -> None:
        """Add a gauge that is computed at each read."""
        Gauge(name, meaning, registry=self.registry).set_function(value)

    def text(self) -> bytes:
        """Return all metrics in Prometheus' text format 0.0.4."""
        return generate_latest(self.registry)
