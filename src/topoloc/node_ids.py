"""Define the two numbers of a map's nodes as types, so that a type checker tells them apart, and
sequences that are read row by row."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NewType, SupportsInt, TypeVar

T = TypeVar("T")

Row = NewType("Row", int)
"""Index into a table of nodes (`summaries`, `nodes`) of one loaded map. Edits change it."""
NodeId = NewType("NodeId", int)
"""Id of a node. It never changes and is never reused. Files and results hold ids."""


def as_rows(indices: Iterable[SupportsInt]) -> list[Row]:
    """Return indices into a table of nodes, such as an index array, as rows."""
    return [Row(int(index)) for index in indices]


class LazySequence(Sequence[T]):
    """Show a sequence of `length()` entries. Each is the result of `read` for its row, at every
    access."""

    def __init__(self, length: Callable[[], int], read: Callable[[Row], T]) -> None:
        self._length, self._read = length, read

    def __len__(self) -> int:
        return self._length()

    def __getitem__(self, index: Any) -> Any:
        rows = range(len(self))[index]  # raises IndexError
        return (
            [*map(self._read, as_rows(rows))] if isinstance(rows, range) else self._read(Row(rows))
        )
