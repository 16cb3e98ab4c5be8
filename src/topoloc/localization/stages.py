"""Milliseconds of each stage of a query."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class StageClock:
    """Adds up the time spent in named stages; `total` is the time since it was made."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._times_ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self._times_ms[name] = self._times_ms.get(name, 0.0) + (time.perf_counter() - start) * 1e3

    def times_ms(self) -> dict[str, float]:
        return self._times_ms | {"total": (time.perf_counter() - self._start) * 1e3}
