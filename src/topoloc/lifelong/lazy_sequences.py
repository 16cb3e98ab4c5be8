"""Provide changed versions of long sequences that read an entry only when it is accessed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

T = TypeVar("T")


class OverlaySequence(Sequence[T]):
    """Show `base` with the entries of `changed` (by row) replaced and the entries of `added`
    appended."""

    def __init__(self, base: Sequence[T], changed: Mapping[int, T], added: Sequence[T]) -> None:
        self._base, self._changed, self._added = base, changed, added

    def __len__(self) -> int:
        return len(self._base) + len(self._added)

    def __getitem__(self, index):  # type: ignore[override]
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        row = index + len(self) if index < 0 else index
        if not 0 <= row < len(self):
            raise IndexError(index)
        if row in self._changed:
            return self._changed[row]
        return self._base[row] if row < len(self._base) else self._added[row - len(self._base)]


class SelectedSequence(Sequence[T]):
    """Show the given rows of `base`."""

    def __init__(self, base: Sequence[T], rows: Sequence[int]) -> None:
        self._base, self._rows = base, rows

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index):  # type: ignore[override]
        return (
            [self._base[row] for row in self._rows[index]]
            if isinstance(index, slice)
            else self._base[self._rows[index]]
        )


class TransformedSequence(Sequence[T]):
    """Show the entries of `base`, each transformed by `transform` at every access."""

    def __init__(self, base: Sequence[T], transform: Callable[[T], T]) -> None:
        self._base, self._transform = base, transform

    def __len__(self) -> int:
        return len(self._base)

    def __getitem__(self, index):  # type: ignore[override]
        return (
            [self._transform(one) for one in self._base[index]]
            if isinstance(index, slice)
            else self._transform(self._base[index])
        )
