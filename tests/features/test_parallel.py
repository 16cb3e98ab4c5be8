"""Test work on threads: each row and item once and in order, raised errors, and threads of
a forked child."""

from __future__ import annotations

import os
import sys
import threading

import numpy as np
import pytest

from topoloc import compiled
from topoloc.features.parallel import parallel_for_rows, parallel_map


@pytest.mark.parametrize(("num_rows", "num_threads"), [(1, 4), (7, 1), (7, 3), (480, 2)])
def test_every_row_is_done_once(num_rows: int, num_threads: int):
    rows = np.zeros(num_rows, np.int64)

    def run(first: int, last: int) -> None:
        rows[first:last] += 1

    parallel_for_rows(run, num_rows, num_threads)
    assert (rows == 1).all()


def test_an_error_in_any_band_is_raised():
    def run(first: int, last: int) -> None:
        if first > 0:
            raise ValueError("second band")

    with pytest.raises(ValueError, match="second band"):
        parallel_for_rows(run, 10, 2)


@pytest.mark.skipif(sys.platform == "win32", reason="no fork there")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_child_can_work_too():
    parallel_for_rows(lambda first, last: None, 10, 2)  # the parent's pool is there
    child = os.fork()
    if child == 0:
        parallel_for_rows(lambda first, last: None, 10, 2)
        os._exit(7)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7


def test_items_come_in_order_a_few_at_a_time_each_by_one_thread():
    taken, at_once, both = list[int](), list[int](), threading.Barrier(2)

    def items():
        for item in range(10):
            taken.append(item)
            yield item

    def work(item: int) -> tuple[int, int, list[int]]:
        if item < 2:
            both.wait(timeout=60)  # the first two are worked on at the same time
        return item, compiled.num_threads(), list(parallel_map(abs, [-item]))

    for item, num_threads, nested in parallel_map(work, items()):
        assert (num_threads, nested) == (1, [item])
        at_once.append(len(taken) - item)
    assert taken == list(range(10))
    assert max(at_once) <= compiled.num_threads() + 1
    assert compiled.num_threads() == 2


def test_an_error_is_raised_in_its_items_place():
    quotients = parallel_map(lambda item: 1.0 / item, [2, 1, 0, 4])
    assert [next(quotients), next(quotients)] == [0.5, 1.0]
    with pytest.raises(ZeroDivisionError):
        next(quotients)
