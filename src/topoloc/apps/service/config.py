"""What the service takes on: sizes, times and numbers beyond which a request is refused."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Annotated

from topoloc.plugin import Above, AtLeast, Between


@dataclass(frozen=True)
class ServiceConfig:
    """What the service takes on: sizes, times and numbers beyond which a request is refused."""

    workers: Annotated[int, Between(0, 256)] = 0
    """Pictures that are localized at a time, each in a thread of its own; 0: one a processor."""
    max_queue: Annotated[int, Between(0, 100_000)] = 32
    """Requests that may wait for a worker; one more is answered with 429."""
    memory_mb: Annotated[int, Between(32, 1_000_000)] = 512
    """Megabytes of maps that are kept in memory, all maps together; the ones used longest ago are
    closed first."""
    max_upload_mb: Annotated[float, Above(0)] = 20.0
    """Megabytes of one request."""
    max_megapixels: Annotated[float, Between(0.01, 100)] = 50.0
    """Of one picture; known from its header before anything is decoded."""
    upload_s: Annotated[float, Above(0)] = 20.0
    """Seconds in which a request must be there whole, and in which a client must take its
    answer."""
    answer_s: Annotated[float, Above(0)] = 30.0
    """Seconds in which a request is answered, waiting included; then it is told that it took too
    long."""
    fetch_s: Annotated[float, Above(0)] = 10.0
    """Seconds that a request waits for a tile to come from an object store; it goes on coming, for
    those who ask later."""
    geolocation_m: Annotated[float, Above(0)] = 100.0
    """Where a request of the GeoPose Protocol says where the device is, tiles of atlases are not
    asked that lie further from there than so many metres and three times the accuracy that the
    device claims."""
    max_sessions: Annotated[int, Between(0, 100_000)] = 64
    """Streams at a time."""
    session_idle_s: Annotated[float, Above(0)] = 60.0
    """Seconds without a picture after which a stream is forgotten."""
    drain_s: Annotated[float, AtLeast(0)] = 20.0
    """Seconds that requests in progress are given when the service is told to end."""

    @property
    def num_workers(self) -> int:
        return self.workers or os.cpu_count() or 1

    @property
    def max_upload_bytes(self) -> int:
        return int(self.max_upload_mb * 1e6)

    @property
    def max_pixels(self) -> int:
        return int(self.max_megapixels * 1e6)
