"""Settings of work and of services on a cluster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from topoloc.plugin import AtLeast, Between


@dataclass(frozen=True)
class ClusterConfig:
    """Resources of the tasks on a cluster."""

    cpus_per_recording: Annotated[int, Between(1, 1024)] = 1
    """Processors and threads of a task, for a recording or a pair of tiles."""
    memory_mb_per_recording: Annotated[int, AtLeast(0)] = 0
    """Megabytes that Ray reserves for a task. 0: none."""
    max_retries: Annotated[int, Between(0, 100)] = 3
    """How often a task is restarted after the loss of its worker or machine."""


@dataclass(frozen=True)
class ReplicasConfig:
    """Number of replicas of a service on a cluster."""

    least: Annotated[int, Between(1, 10_000)] = 1
    """Minimum number of replicas."""
    most: Annotated[int, Between(1, 10_000)] = 1
    """Maximum number of replicas. Those beyond `least` start and stop by load."""
    cpus_per_replica: Annotated[int, Between(1, 1024)] = 1
    """Processors of a replica. It localizes this many images in parallel unless `serve.workers` is
    set."""
    busy: Annotated[float, Between(0.05, 20)] = 1.0
    """A replica is added if each has more requests than this for each image that it localizes in
    parallel."""
    upscale_delay_s: Annotated[float, AtLeast(0)] = 10.0
    """Seconds of such load before a replica is added."""
    downscale_delay_s: Annotated[float, AtLeast(0)] = 300.0
    """Seconds of low load before a replica is removed."""
