"""What is done every few seconds: streams that nobody uses are forgotten, and memory that is free
goes back to the system.

The C library keeps what threads freed, in pieces: without this a service grows by tens of megabytes
over a thousand pictures.
"""

from __future__ import annotations

import asyncio
import ctypes
from collections.abc import Callable
from functools import cache

from topoloc.apps.service.streams import Streams

_PERIOD_S = 5.0


async def run_maintenance(streams: Streams) -> None:
    """Until it is cancelled."""
    while True:
        await asyncio.sleep(_PERIOD_S)
        await asyncio.to_thread(_run_once, streams)


def _run_once(streams: Streams) -> None:
    streams.forget_idle()
    trim = _find_malloc_trim()
    if trim is not None:
        trim(0)


@cache
def _find_malloc_trim() -> Callable[[int], int] | None:
    """glibc's; None where the C library is another one."""
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return None
