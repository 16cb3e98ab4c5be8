"""Work shared out to threads, whose kernels release the GIL: rows (of an image, of a table of
products), one band each, or whole items."""

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
    """The threads of this process; a forked child inherits the pool but not its threads, and would
    wait for them forever."""
    return ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix=f"bands-{process_id}")


def parallel_for_rows(
    run: Callable[[int, int], object], num_rows: int, num_threads: int | None = None
) -> None:
    """Call run(first_row, last_row) for `num_threads` bands of about equal height that cover the
    rows, at the same time.

    None is as many as `set_num_threads` said. The calling thread takes one band itself; an
    exception of any band is raised here.
    """
    num_bands = max(1, min(num_threads or compiled.num_threads(), num_rows))
    bounds = [num_rows * band // num_bands for band in range(num_bands + 1)]
    pool = _pool(os.getpid())
    others = [pool.submit(run, bounds[band], bounds[band + 1]) for band in range(1, num_bands)]
    run(0, bounds[1])
    for other in others:
        other.result()


def parallel_map(work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """What work(item) gives, in the order of the items, of which as many threads as
    `set_num_threads` said take one each at a time.

    A whole item a thread: nothing waits for the other half of a picture, and what Python does for
    one item hides behind the kernels of another. At most one result more than there are threads
    waits to be taken, so that memory stays what it is; an exception is raised in its item's place.
    The items themselves are made by the calling thread.
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
