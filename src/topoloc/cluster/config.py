"""How work is shared out to the machines of a cluster."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from topoloc.bounds import AtLeast, Between


@dataclass(frozen=True)
class ClusterConfig:
    """How work is shared out to the machines of a cluster."""

    cpus_per_recording: Annotated[int, Between(1, 1024)] = 1
    """Processors that a recording is mapped on, and threads that it may use."""
    memory_mb_per_recording: Annotated[int, AtLeast(0)] = 0
    """Megabytes that Ray sets aside for each recording that is mapped; 0: nothing is reckoned."""
    max_retries: Annotated[int, Between(0, 100)] = 3
    """How often a recording is begun again whose worker, or machine, went away."""
