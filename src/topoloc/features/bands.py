"""Rows (of an image, of a table of products) shared out to threads: kernels that release the GIL fill one band each."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix="bands")


def run_in_bands(run: Callable[[int, int], object], num_rows: int, num_threads: int) -> None:
    """Call run(first_row, last_row) for `num_threads` bands of about equal height that cover the rows, at the same time.

    The calling thread takes one band itself; an exception of any band is raised here.
    """
    num_bands = max(1, min(num_threads, num_rows))
    borders = [num_rows * band // num_bands for band in range(num_bands + 1)]
    others = [_pool().submit(run, borders[band], borders[band + 1]) for band in range(1, num_bands)]
    run(0, borders[1])
    for other in others:
        other.result()
