"""A long list in the making whose entries lie on disk, but for those used last: what a map of any
length is built with."""

from __future__ import annotations

import functools
import io
import pickle
import sqlite3
import threading
from collections import OrderedDict
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import is_dataclass
from typing import Any, TypeVar, overload

import numpy as np

from topoloc.errors import TopolocError

T = TypeVar("T")

DEFAULT_BYTES = 64_000_000
"""Of each shelf, where nobody says."""


class Shelf(Sequence[T]):
    """Entries that stay in memory up to a number of bytes; those used longest ago lie in a
    temporary file, which ends with this process.

    An entry that was changed has to be put back (``shelf[row] = entry``), or the change may be
    lost. Threads may share a shelf. It is pickled as a list.

    Args:
        by_reference: objects that stay in memory in any case; entries that refer to them refer to
            these same objects when they come back.

    Raises:
        TopolocError: the folder of temporary files has no room left; from whatever adds entries or
            looks at them.
    """

    def __init__(
        self,
        entries: Iterable[T] = (),
        max_bytes: int | None = None,
        by_reference: Sequence[object] = (),
    ) -> None:
        self._lock = threading.RLock()
        self._kept: OrderedDict[int, tuple[T, int, bool]] = (
            OrderedDict()
        )  # by row: entry, bytes, whether the file has it as it is
        self._length, self._num_bytes, self._max_bytes = (
            0,
            0,
            DEFAULT_BYTES if max_bytes is None else max_bytes,
        )
        self._referred, self._numbers = (
            by_reference,
            {id(one): number for number, one in enumerate(by_reference)},
        )
        self._database: sqlite3.Connection | None = None
        for entry in entries:
            self.append(entry)

    def append(self, entry: T) -> None:
        with self._lock:
            self._length += 1
            self._keep(self._length - 1, entry, False)

    def __len__(self) -> int:
        return self._length

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> list[T]: ...
    def __getitem__(self, index: int | slice) -> T | list[T]:
        if isinstance(index, slice):
            return [self[row] for row in range(*index.indices(len(self)))]
        with self._lock:
            row = self._row(index)
            if row in self._kept:
                self._kept.move_to_end(row)
            else:
                self._keep(row, self._read(row), True)
            return self._kept[row][0] if row in self._kept else self._read(row)

    def __setitem__(self, index: int, entry: T) -> None:
        with self._lock:
            self._keep(self._row(index), entry, False)

    def __iter__(self) -> Iterator[T]:
        return (self[row] for row in range(len(self)))

    def __reduce__(self) -> Any:
        return list, (list(self),)

    def _row(self, index: int) -> int:
        row = index + self._length if index < 0 else int(index)
        if not 0 <= row < self._length:
            raise IndexError(index)
        return row

    def _keep(self, row: int, entry: T, is_written: bool) -> None:
        """In memory, as the entry used last; others give way. An entry beyond the whole budget is
        written at once."""
        if row in self._kept:
            self._num_bytes -= self._kept.pop(row)[1]
        size = bytes_of(entry, self._numbers)
        self._kept[row] = entry, size, is_written
        self._num_bytes += size
        while self._num_bytes > self._max_bytes and self._kept:
            oldest, (given_up, freed, on_disk) = self._kept.popitem(last=False)
            self._num_bytes -= freed
            if not on_disk:
                self._write(oldest, given_up)

    def _write(self, row: int, entry: T) -> None:
        with self._told():
            if self._database is None:
                # an empty name is a file of nobody else's, gone when it is closed
                self._database = sqlite3.connect("", isolation_level=None, check_same_thread=False)
                for pragma in ("journal_mode = OFF", "synchronous = OFF"):
                    self._database.execute(f"PRAGMA {pragma}")
                self._database.execute(
                    "CREATE TABLE entries (row INTEGER PRIMARY KEY, entry BLOB NOT NULL)"
                )
            buffer = io.BytesIO()
            _Pickler(buffer, self._numbers).dump(entry)
            self._database.execute(
                "INSERT OR REPLACE INTO entries VALUES (?, ?)", (row, buffer.getbuffer())
            )

    def _read(self, row: int) -> T:
        assert self._database is not None
        with self._told():
            blob = self._database.execute(
                "SELECT entry FROM entries WHERE row = ?", (row,)
            ).fetchone()[0]
        return _Unpickler(io.BytesIO(blob), self._referred).load()

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            raise TopolocError(
                "the folder of temporary files (TMPDIR) does not hold what is in the making:"
                f" {error}"
            ) from error


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, numbers: dict[int, int]) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._numbers = numbers

    def persistent_id(self, obj: Any) -> int | None:
        return self._numbers.get(id(obj))


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, referred: Sequence[object]) -> None:
        super().__init__(file)
        self._referred = referred

    def persistent_load(self, pid: Any) -> object:
        return self._referred[pid]


def bytes_of(value: Any, apart: Container[int] = ()) -> int:
    """Bytes of the arrays and byte strings in a value, its fields and items, those of mappings too;
    objects of these `id` do not count."""
    total, left = 0, [value]
    while (
        left
    ):  # no recursion: a draft has hundreds of parts, and is counted whenever a picture has seen it
        one = left.pop()
        if id(one) in apart:
            continue
        if isinstance(one, np.ndarray):
            total += one.nbytes
        elif isinstance(one, bytes):
            total += len(one)
        elif isinstance(one, dict):
            left.extend(one.values())
        elif isinstance(one, list | tuple):
            left.extend(one)
        else:
            left.extend([getattr(one, name) for name in _fields_of(type(one))])
    return total


@functools.cache
def _fields_of(kind: type) -> tuple[str, ...]:
    """Of a dataclass; else none."""
    return tuple(kind.__dataclass_fields__) if is_dataclass(kind) else ()
