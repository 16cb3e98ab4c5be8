"""Settings of the service."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Annotated

from topoloc.plugin import AtLeast, Between


@dataclass(frozen=True)
class ServiceConfig:
    """Limits of the service in size, time and number. Requests beyond them are refused."""

    workers: Annotated[int, Between(0, 256)] = 0
    """Images that are localized in parallel, each in its own thread. 0: one for each processor."""
    max_queue: Annotated[int, Between(0, 100_000)] = 32
    """Requests that may wait for a worker. Further ones get the status 429."""
    memory_mb: Annotated[int, Between(32, 1_000_000)] = 512
    """Megabytes of all maps in memory. The least recently used map is closed first."""
    max_upload_mb: Annotated[float, Between(0.01, 1e6)] = 20.0
    """Megabytes of one request."""
    max_megapixels: Annotated[float, Between(0.01, 100)] = 50.0
    """Megapixels of one image, read from its header before decoding."""
    upload_s: Annotated[float, Between(0.01, 1e6)] = 20.0
    """Seconds until a request must be complete, and until a client must read its response."""
    answer_s: Annotated[float, Between(0.01, 1e6)] = 30.0
    """Seconds until a request is answered, with waiting. After them it gets the status 503."""
    fetch_s: Annotated[float, Between(0.01, 1e6)] = 10.0
    """Seconds that a request waits for a tile from an object store. The fetch then continues for
    later requests."""
    geolocation_m: Annotated[float, Between(0.01, 1e6)] = 100.0
    """Metres that are added to three times the accuracy of a device's position (GeoPose Protocol).
    Tiles of atlases further away are skipped."""
    max_sessions: Annotated[int, Between(0, 100_000)] = 64
    """Streams at a time."""
    max_sessions_per_address: Annotated[int, AtLeast(1)] = 16
    """Streams of one address at a time."""
    session_idle_s: Annotated[float, Between(0.01, 1e6)] = 60.0
    """Seconds without an image after which a stream ends."""
    max_notes: Annotated[int, Between(0, 100_000)] = 1000
    """Notes at places of a map, in NAME.notes.json beside it. 0: none are kept."""
    drain_s: Annotated[float, AtLeast(0)] = 20.0
    """Seconds that requests in progress may take after the service is told to end."""

    @property
    def num_workers(self) -> int:
        """Number of worker threads."""
        return self.workers or os.cpu_count() or 1

    @property
    def max_upload_bytes(self) -> int:
        """Bytes of one request."""
        return int(self.max_upload_mb * 1e6)

    @property
    def max_pixels(self) -> int:
        """Pixels of one image."""
        return int(self.max_megapixels * 1e6)
