"""Long sequences changed without reading them: some entries changed and others behind them, some
left out, all changed when asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

T = TypeVar("T")


class Overlay(Sequence[T]):
    """`before` with the entries of `changed` (by their rows) in place of its own, and `added`
    behind it."""

    def __init__(self, before: Sequence[T], changed: Mapping[int, T], added: Sequence[T]) -> None:
        self._before, self._changed, self._added = before, changed, added

    def __len__(self) -> int:
        return len(self._before) + len(self._added)

    def __getitem__(self, index):  # type: ignore[override]
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        row = index + len(self) if index < 0 else index
        if not 0 <= row < len(self):
            raise IndexError(index)
        if row in self._changed:
            return self._changed[row]
        return (
            self._before[row] if row < len(self._before) else self._added[row - len(self._before)]
        )


class Selected(Sequence[T]):
    """Some rows of `before`."""

    def __init__(self, before: Sequence[T], rows: Sequence[int]) -> None:
        self._before, self._rows = before, rows

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index):  # type: ignore[override]
        return (
            [self._before[row] for row in self._rows[index]]
            if isinstance(index, slice)
            else self._before[self._rows[index]]
        )


class Changed(Sequence[T]):
    """Each entry of `before` as `change` makes it, every time that it is asked for."""

    def __init__(self, before: Sequence[T], change: Callable[[T], T]) -> None:
        self._before, self._change = before, change

    def __len__(self) -> int:
        return len(self._before)

    def __getitem__(self, index):  # type: ignore[override]
        return (
            [self._change(one) for one in self._before[index]]
            if isinstance(index, slice)
            else self._change(self._before[index])
        )
