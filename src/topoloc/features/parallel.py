"""Distribute work over threads: one band of rows (of an image, of a table of products) per thread,
or whole items. The kernels must release the GIL."""

from __future__ import annotations

import functools
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from topoloc import compiled

T = TypeVar("T")
R = TypeVar("R")


@functools.cache
def _pool(process_id: int) -> ThreadPoolExecutor:
    """Return the thread pool of this process. A forked child inherits a pool without its threads,
    and would wait for them forever."""
    return ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix=f"bands-{process_id}")


def parallel_for_rows(
    run: Callable[[int, int], object], num_rows: int, num_threads: int | None = None
) -> None:
    """Call run(first_row, last_row) in parallel for `num_threads` bands of about equal height that
    cover the rows.

    The default number is that of `set_num_threads`. The calling thread processes one band itself.
    An exception in any band is raised here.
    """
    num_bands = max(1, min(num_threads or compiled.num_threads(), num_rows))
    bounds = [num_rows * band // num_bands for band in range(num_bands + 1)]
    pool = _pool(os.getpid())
    others = [pool.submit(run, bounds[band], bounds[band + 1]) for band in range(1, num_bands)]
    run(0, bounds[1])
    for other in others:
        other.result()


def parallel_map(work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Yield work(item) in the order of the items. As many threads as `set_num_threads` set process
    one item each.

    With a whole item per thread, no thread waits for part of an image. The Python code for one item
    also overlaps with the kernels of another. At most one finished result more than there are
    threads is buffered, which limits memory. An exception is raised in its item's place. The
    calling thread creates the items.
    """
    number = compiled.num_threads()
    if number == 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(number, initializer=compiled.mark_worker_thread) as pool:
        pending: deque[Future[R]] = deque()
        try:
            for item in items:
                pending.append(pool.submit(work, item))
                if len(pending) > number:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()
