"""Hold a long list with only the entries used last in memory. Maps of any length are built with
it."""

from __future__ import annotations

import functools
import io
import pickle
import sqlite3
import threading
from collections import OrderedDict
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import is_dataclass
from typing import Any, TypeVar, overload

import numpy as np

from topoloc.errors import TopolocError

T = TypeVar("T")

DEFAULT_MAX_BYTES = 64_000_000
"""Default memory budget of each list, bytes."""


class DiskList(Sequence[T]):
    """Hold entries in memory up to a number of bytes. The entries used longest ago are moved to a
    temporary file, which is deleted when the process ends.

    A changed entry must be assigned again (``entries[row] = entry``), otherwise the change may be
    lost. Threads may share a list. It is pickled as a plain list.

    Args:
        entries: first entries of the list.
        max_bytes: memory budget. Default: `DEFAULT_MAX_BYTES`.
        shared_objects: objects that always stay in memory. Entries that refer to one of them refer
            to the same object after they are read back.

    Raises:
        TopolocError: the folder of temporary files is full. Any method that reads or adds entries
            may raise it.
    """

    def __init__(
        self,
        entries: Iterable[T] = (),
        max_bytes: int | None = None,
        shared_objects: Sequence[object] = (),
    ) -> None:
        self._lock = threading.RLock()
        # By row: entry, bytes, whether the file holds its current state.
        self._cache: OrderedDict[int, tuple[T, int, bool]] = OrderedDict()
        self._length, self._num_bytes = 0, 0
        self._max_bytes = DEFAULT_MAX_BYTES if max_bytes is None else max_bytes
        self._shared_objects = shared_objects
        self._reference_ids = {id(one): number for number, one in enumerate(shared_objects)}
        for entry in entries:
            self.append(entry)

    def append(self, entry: T) -> None:
        """Add an entry at the end."""
        with self._lock:
            self._length += 1
            self._cache_entry(self._length - 1, entry, False)

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
            if row in self._cache:
                self._cache.move_to_end(row)
            else:
                self._cache_entry(row, self._read(row), True)
            return self._cache[row][0] if row in self._cache else self._read(row)

    def __setitem__(self, index: int, entry: T) -> None:
        with self._lock:
            self._cache_entry(self._row(index), entry, False)

    def __iter__(self) -> Iterator[T]:
        return (self[row] for row in range(len(self)))

    def __reduce__(self) -> Any:
        return list, (list(self),)

    def _row(self, index: int) -> int:
        row = index + self._length if index < 0 else int(index)
        if not 0 <= row < self._length:
            raise IndexError(index)
        return row

    def _cache_entry(self, row: int, entry: T, is_written: bool) -> None:
        """Put an entry into memory as the one used last, and evict the oldest entries beyond the
        budget. An entry larger than the whole budget is written at once."""
        if row in self._cache:
            self._num_bytes -= self._cache.pop(row)[1]
        size = bytes_of(entry, self._reference_ids)
        self._cache[row] = entry, size, is_written
        self._num_bytes += size
        while self._num_bytes > self._max_bytes and self._cache:
            oldest, (evicted, freed, on_disk) = self._cache.popitem(last=False)
            self._num_bytes -= freed
            if not on_disk:
                self._write(oldest, evicted)

    @functools.cached_property
    def _database(self) -> sqlite3.Connection:
        # An empty name creates a private file, deleted when it is closed.
        database = sqlite3.connect("", isolation_level=None, check_same_thread=False)
        table = "CREATE TABLE entries (row INTEGER PRIMARY KEY, entry BLOB NOT NULL)"
        for statement in ("PRAGMA journal_mode = OFF", "PRAGMA synchronous = OFF", table):
            database.execute(statement)
        return database

    def _write(self, row: int, entry: T) -> None:
        buffer = io.BytesIO()
        _Pickler(buffer, self._reference_ids).dump(entry)
        with self._convert_disk_errors():
            self._database.execute(
                "INSERT OR REPLACE INTO entries VALUES (?, ?)", (row, buffer.getbuffer())
            )

    def _read(self, row: int) -> T:
        with self._convert_disk_errors():
            found = self._database.execute("SELECT entry FROM entries WHERE row = ?", (row,))
            (blob,) = found.fetchone()
        return _Unpickler(io.BytesIO(blob), self._shared_objects).load()

    def _convert_disk_errors(self) -> AbstractContextManager[None]:
        fault = "the folder of temporary files (TMPDIR) does not hold what is in the making"
        return TopolocError.at(fault, sqlite3.OperationalError)


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, shared_ids: Mapping[int, Any]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._shared_ids = shared_ids

    def persistent_id(self, obj: object) -> Any:
        return self._shared_ids.get(id(obj))


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, shared_objects: Sequence[Any]) -> None:
        super().__init__(file)
        self._shared_objects = shared_objects

    def persistent_load(self, pid: Any) -> Any:
        return self._shared_objects[pid]


def bytes_of(value: Any, excluded_ids: Container[int] = ()) -> int:
    """Return the bytes of the arrays and byte strings in a value, its fields, its items and the
    values of its dicts. Objects whose `id` is in `excluded_ids` do not count."""
    total, pending = 0, [value]
    while pending:  # no recursion: a node draft has hundreds of parts, counted after each image
        item = pending.pop()
        if id(item) in excluded_ids:
            continue
        if isinstance(item, np.ndarray):
            total += item.nbytes
        elif isinstance(item, bytes):
            total += len(item)
        elif isinstance(item, dict):
            pending.extend(item.values())
        elif isinstance(item, list | tuple):
            pending.extend(item)
        else:
            pending.extend([getattr(item, name) for name in _dataclass_fields(type(item))])
    return total


@functools.cache
def _dataclass_fields(kind: type) -> tuple[str, ...]:
    """Return the field names of a dataclass, or none for any other class."""
    return tuple(kind.__dataclass_fields__) if is_dataclass(kind) else ()
