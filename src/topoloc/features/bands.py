"""Rows (of an image, of a table of products) shared out to threads: kernels that release the GIL fill one band each."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from topoloc import compiled


@functools.cache
def _pool(process_id: int) -> ThreadPoolExecutor:
    """The threads of this process; a forked child inherits the pool but not its threads, and would wait for them forever."""
    return ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix=f"bands-{process_id}")


def run_in_bands(run: Callable[[int, int], object], num_rows: int, num_threads: int | None = None) -> None:
    """Call run(first_row, last_row) for `num_threads` bands of about equal height that cover the rows, at the same time.

    None is as many as `set_num_threads` said. The calling thread takes one band itself; an exception of any band is raised here.
    """
    num_bands = max(1, min(num_threads or compiled.num_threads(), num_rows))
    borders = [num_rows * band // num_bands for band in range(num_bands + 1)]
    pool = _pool(os.getpid())
    others = [pool.submit(run, borders[band], borders[band + 1]) for band in range(1, num_bands)]
    run(0, borders[1])
    for other in others:
        other.result()
