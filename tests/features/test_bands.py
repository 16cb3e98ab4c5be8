"""Work shared out to threads: every row once, errors raised, and a forked child has threads of its own."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest

from topoloc.features.bands import run_in_bands


@pytest.mark.parametrize(("num_rows", "num_threads"), [(1, 4), (7, 1), (7, 3), (480, 2)])
def test_every_row_is_done_once(num_rows: int, num_threads: int):
    rows = np.zeros(num_rows, np.int64)

    def run(first: int, last: int) -> None:
        rows[first:last] += 1

    run_in_bands(run, num_rows, num_threads)
    assert (rows == 1).all()


def test_an_error_in_any_band_is_raised():
    def run(first: int, last: int) -> None:
        if first > 0:
            raise ValueError("second band")

    with pytest.raises(ValueError, match="second band"):
        run_in_bands(run, 10, 2)


@pytest.mark.skipif(sys.platform == "win32", reason="no fork there")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_child_can_work_too():
    run_in_bands(lambda first, last: None, 10, 2)  # the parent's pool is there
    child = os.fork()
    if child == 0:
        run_in_bands(lambda first, last: None, 10, 2)
        os._exit(7)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
