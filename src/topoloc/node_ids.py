"""Define the two numbers of a map's nodes as types, so that a type checker tells them apart."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NewType, SupportsInt

Row = NewType("Row", int)
"""Index into a table of nodes (`summaries`, `nodes`) of one loaded map. Edits change it."""
NodeId = NewType("NodeId", int)
"""Id of a node. It never changes and is never reused. Files and results hold ids."""


def as_rows(indices: Iterable[SupportsInt]) -> list[Row]:
    """Return indices into a table of nodes, such as an index array, as rows."""
    return [Row(int(index)) for index in indices]
