"""What Prometheus reads at /metrics."""

from __future__ import annotations

from collections.abc import Callable

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    ProcessCollector,
    generate_latest,
)

_SECONDS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)


class Metrics:
    """The counters of one service."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        of = self.registry
        self.requests = Counter(
            "topoloc_requests", "Requests by route and status.", ("route", "status"), registry=of
        )
        meaning = "Seconds from a request's head to the end of its answer."
        self.seconds = Histogram(
            "topoloc_request_seconds", meaning, ("route",), registry=of, buckets=_SECONDS
        )
        meaning = "Answers by map and outcome: localized, or the reason why not."
        self.answers = Counter("topoloc_answers", meaning, ("map", "outcome"), registry=of)
        meaning = "Seconds that localizing took, without waiting."
        self.search_seconds = Histogram(
            "topoloc_localize_seconds", meaning, ("map",), registry=of, buckets=_SECONDS
        )

    def gauge(self, name: str, meaning: str, value: Callable[[], float]) -> None:
        """One that is asked whenever somebody reads."""
        Gauge(name, meaning, registry=self.registry).set_function(value)

    def text(self) -> bytes:
        """In Prometheus' text format 0.0.4."""
        return generate_latest(self.registry)
