"""Provide changed versions of long sequences that read an entry only when it is accessed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

from topoloc.mapping.storage.entries import LazySequence
from topoloc.mapping.topomap import TopoMetricMap, TopoNode

T = TypeVar("T")


def overlay(base: Sequence[T], changed: Mapping[int, T], added: Sequence[T]) -> LazySequence[T]:
    """Return `base` with the entries of `changed` (by row) replaced and those of `added`
    appended."""

    def read(row: int) -> T:
        if row in changed:
            return changed[row]
        return base[row] if row < len(base) else added[row - len(base)]

    return LazySequence(lambda: len(base) + len(added), read)


def transform_nodes(
    topomap: TopoMetricMap, transform: Callable[[TopoNode], TopoNode]
) -> TopoMetricMap:
    """Return the map with each node transformed at every access, or the same map if `transform`
    returns all nodes unchanged."""
    if all(transform(node) is node for layer in topomap.layers.values() for node in layer.nodes):
        return topomap
    layers = {
        kind: replace(
            layer,
            nodes=LazySequence(
                partial(len, layer.nodes), lambda row, layer=layer: transform(layer.nodes[row])
            ),
        )
        for kind, layer in topomap.layers.items()
    }
    return replace(topomap, layers=layers)
