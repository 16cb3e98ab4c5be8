"""Test a list with entries on disk: they are read back unchanged."""

from __future__ import annotations

import pickle
import sqlite3
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, strategies as st

from topoloc import disk_list
from topoloc.disk_list import DiskList
from topoloc.errors import TopolocError


@dataclass(eq=False)
class Frame:
    name: str
    picture: np.ndarray | None = None


@dataclass(eq=False)
class Entry:
    frame: Frame
    values: list[np.ndarray]


def entries(count: int, frames: list[Frame]) -> list[Entry]:
    return [Entry(frames[k], [np.full(100, k, np.float64)]) for k in range(count)]


@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 1000)), max_size=60),
    st.sampled_from([0, 900, 2500, 10**6]),
)
def test_it_is_a_list_with_any_entries_on_disk(changes: list[tuple[int, int]], max_bytes: int):
    there, plain = (
        DiskList((np.full(100, k) for k in range(10)), max_bytes),
        [np.full(100, k) for k in range(10)],
    )
    for row, value in changes:
        np.testing.assert_array_equal(there[row], plain[row])
        there[row] = plain[row] = np.full(100, value)
    there.append(np.zeros(3))
    np.testing.assert_array_equal(
        np.concatenate(list(there)), np.concatenate([*plain, np.zeros(3)])
    )
    np.testing.assert_array_equal(np.stack(there[2:5]), np.stack(plain[2:5]))
    np.testing.assert_array_equal(there[-2], plain[-1])
    assert len(there) == 11


def test_the_memory_is_limited():
    frames = [Frame(str(k), np.zeros(5000)) for k in range(50)]  # shared objects do not count
    there = DiskList(entries(50, frames), max_bytes=8_000, shared_objects=frames)
    assert len(there._cache) == 10
    assert there[0].values[0][0] == 0.0
    assert len(there._cache) == 10
    assert 0 in there._cache


def test_assigned_entries_are_stored_and_shared_objects_stay_the_same():
    frames = [Frame(str(k)) for k in range(5)]
    there = DiskList(entries(5, frames), max_bytes=0, shared_objects=frames)
    entry = there[3]
    assert entry.frame is frames[3]
    entry.values.append(np.ones(4))
    assert len(there[3].values) == 1
    there[3] = entry
    assert len(there[3].values) == 2


def test_it_is_pickled_as_a_list_and_has_an_end():
    there = DiskList([np.zeros(5), np.ones(5)], max_bytes=0)
    back = pickle.loads(pickle.dumps(there))
    assert isinstance(back, list)
    np.testing.assert_array_equal(back[1], np.ones(5))
    for row in (2, -3):
        with pytest.raises(IndexError):
            there[row]


def test_a_full_disk_is_one_line(monkeypatch: pytest.MonkeyPatch):
    class Full:
        def execute(self, *_: object) -> None:
            raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(disk_list.sqlite3, "connect", lambda *_, **__: Full())
    with pytest.raises(TopolocError, match=r"TMPDIR.*disk is full"):
        DiskList([np.zeros(5)], max_bytes=0)
