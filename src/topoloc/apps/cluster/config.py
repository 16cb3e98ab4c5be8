"""How work is shared out to the machines of a cluster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from topoloc.plugin import AtLeast, Between


@dataclass(frozen=True)
class ClusterConfig:
    """How work is shared out to the machines of a cluster."""

    cpus_per_recording: Annotated[int, Between(1, 1024)] = 1
    """Processors that a recording, or a pair of tiles, is worked on, and threads that it may
    use."""
    memory_mb_per_recording: Annotated[int, AtLeast(0)] = 0
    """Megabytes that Ray sets aside for each of them; 0: nothing is reckoned."""
    max_retries: Annotated[int, Between(0, 100)] = 3
    """How often one is begun again whose worker, or machine, went away."""


@dataclass(frozen=True)
class ReplicasConfig:
    """How many processes of a service answer on a cluster."""

    least: Annotated[int, Between(1, 10_000)] = 1
    """Replicas that are always there."""
    most: Annotated[int, Between(1, 10_000)] = 1
    """Replicas at most; more than `least` come and go as they are needed."""
    cpus_per_replica: Annotated[int, Between(1, 1024)] = 1
    """Processors of a replica, and pictures that it localizes at a time, where `serve.workers` does
    not say so."""
    busy: Annotated[float, Between(0.05, 20)] = 1.0
    """Another replica comes where each has more than so many requests a picture that it localizes
    at a time."""
    upscale_delay_s: Annotated[float, AtLeast(0)] = 10.0
    """Seconds that it must have been so before another one comes."""
    downscale_delay_s: Annotated[float, AtLeast(0)] = 300.0
    """Seconds that there must have been too many before one goes."""
