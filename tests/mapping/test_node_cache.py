"""Test the byte budget that the nodes of all open maps share."""

from __future__ import annotations

import gc

import numpy as np

from topoloc.mapping.node_cache import CachedNodes, NodeCache, bytes_of


def test_the_least_recently_used_nodes_of_all_owners_are_dropped():
    memory, read = NodeCache(1000), []

    def reader(name: str) -> CachedNodes[np.ndarray]:
        def read_row(row: int) -> np.ndarray:
            read.append((name, row))
            return np.zeros(50)  # 400 bytes

        return CachedNodes(read_row, memory)

    one, other = reader("one"), reader("other")
    (
        one(0),
        other(0),
        one(0),
        other(1),
    )  # the third is remembered, the fourth is too much: other(0) goes
    assert read == [("one", 0), ("other", 0), ("other", 1)]
    one(0), other(0)
    assert read[3:] == [("other", 0)]
    assert memory.num_bytes <= 1000
    memory.resize(0)
    assert memory.num_bytes == 0
    one(0), one(0)
    assert read[4:] == [("one", 0), ("one", 0)]


def test_nodes_are_freed_with_their_owner():
    memory = NodeCache(10_000)
    remembered = CachedNodes(lambda row: np.zeros(100), memory)
    remembered(3)
    assert memory.num_bytes == 800
    del remembered
    gc.collect()
    assert memory.num_bytes == 0


def test_bytes_are_those_of_arrays_wherever_they_are():
    assert bytes_of((np.zeros(3), [b"abc", np.zeros(2, np.float32)], "text")) == 24 + 3 + 8
