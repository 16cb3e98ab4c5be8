"""A long sequence with some entries changed and others behind it, without reading the rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

T = TypeVar("T")


class Overlay(Sequence[T]):
    """`before` with the entries of `changed` (by their rows) in place of its own, and `added` behind it."""

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
        return self._before[row] if row < len(self._before) else self._added[row - len(self._before)]
