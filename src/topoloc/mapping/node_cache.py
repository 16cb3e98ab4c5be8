"""Cache nodes that were read and prepared for matching. All open maps of a process share one
budget."""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any, Generic, TypeVar

from topoloc.disk_list import bytes_of
from topoloc.mapping.forks import fork_safe
from topoloc.node_ids import Row

T = TypeVar("T")

DEFAULT_MAX_BYTES = 256_000_000


class NodeCache:
    """Keep the most recently used entries of several owners within a number of bytes.
    Thread-safe."""

    def __init__(self, max_bytes: int = DEFAULT_MAX_BYTES) -> None:
        self._lock = fork_safe(threading.Lock())
        self._removed_owners: list[int] = []
        self._entries: OrderedDict[tuple[int, Row], tuple[Any, int]] = OrderedDict()
        self._max_bytes, self._num_bytes = max_bytes, 0

    @property
    def num_bytes(self) -> int:
        """Return the number of bytes in the cache."""
        return self._num_bytes

    def resize(self, max_bytes: int) -> None:
        """Set a new budget. Entries beyond it are dropped at once."""
        with self._lock:
            self._max_bytes = max_bytes
            self._shrink()

    def get(self, owner: int, row: Row) -> Any:
        """Return an entry and mark it as the most recently used. Return None if it is not
        cached."""
        with self._lock:
            entry = self._entries.get((owner, row))
            if entry is None:
                return None
            self._entries.move_to_end((owner, row))
            return entry[0]

    def put(self, owner: int, row: Row, value: Any, num_bytes: int) -> None:
        """Add an entry and drop the least recently used ones beyond the budget. An entry larger
        than the budget is not kept."""
        with self._lock:
            _, before = self._entries.pop((owner, row), (None, 0))
            self._entries[owner, row] = value, num_bytes
            self._num_bytes += num_bytes - before
            self._shrink()

    def remove_owner(self, owner: int) -> None:
        """Drop all entries of an owner. Garbage collection may call this anywhere, even while this
        thread holds the lock."""
        self._removed_owners.append(owner)
        if self._lock.acquire(blocking=False):
            try:
                self._shrink()
            finally:
                self._lock.release()

    def _shrink(self) -> None:
        if self._removed_owners:
            removed = {self._removed_owners.pop() for _ in range(len(self._removed_owners))}
            for key in [key for key in self._entries if key[0] in removed]:
                self._num_bytes -= self._entries.pop(key)[1]
        while self._num_bytes > self._max_bytes and self._entries:
            self._num_bytes -= self._entries.popitem(last=False)[1][1]


NODE_CACHE = NodeCache()
"""The cache of the process."""


def set_node_cache_size(max_bytes: int) -> None:
    """Set the number of bytes of nodes that all open maps of this process keep in memory together.
    Defaults to 256 MB."""
    NODE_CACHE.resize(max_bytes)


class CachedNodes(Generic[T]):
    """Call `read` for a row of a map, or return its cached value."""

    _next_owner = 0
    _owner_lock = fork_safe(threading.Lock())

    def __init__(self, read: Callable[[Row], T], cache: NodeCache = NODE_CACHE) -> None:
        with CachedNodes._owner_lock:
            CachedNodes._next_owner += 1
            self._owner = CachedNodes._next_owner
        self._read, self._cache = read, cache
        weakref.finalize(self, cache.remove_owner, self._owner)

    def pool(self, rows: Iterable[Row]) -> list[T]:
        """Return the values of several rows."""
        return [self(row) for row in rows]

    def __call__(self, row: Row) -> T:
        value = self._cache.get(self._owner, row)
        if value is None:
            value = self._read(row)
            self._cache.put(self._owner, row, value, bytes_of(value))
        return value
