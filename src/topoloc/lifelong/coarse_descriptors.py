"""Descriptors in larger steps: half of a landmark's bytes are its descriptor, and most of these say
nothing that matching needs.

A file keeps a descriptor's numbers as signed bytes and packs them, so what few different numbers
occur takes few bits, and a map reads them as any others: their length does not matter. In steps of
0.64 of a number's root mean square (16 times the file's for 64 numbers) two descriptors' scalar
product moves by 0.02. Product quantisation to 8 to 32 bytes and signs alone find no more at equal
bytes (`benchmarks/descriptor_size.py`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Int8

from topoloc.lifelong.overlay import Changed
from topoloc.mapping.points import unit_descriptors
from topoloc.mapping.topomap import TopoMetricMap, TopoNode

# stored numbers no larger than so many times those of this step are in it, or a larger one, already
_ROUNDED_TWICE = 1.5


def with_coarse_descriptors(topomap: TopoMetricMap, step: float) -> TopoMetricMap:
    """The map, each of whose nodes rounds its descriptors when it is asked for; the map itself
    where all are rounded. The walls beside the nodes stay as they are.

    Args:
        step: in root mean squares of a descriptor's numbers.

    Raises:
        MapError: from reading the nodes.
    """
    if all(
        coarser(node, step) is node for kind in topomap.kinds for node in topomap.nodes_of(kind)
    ):
        return topomap
    nodes = {
        kind: Changed(topomap.nodes_of(kind), lambda node: coarser(node, step))
        for kind in topomap.kinds
    }
    return replace(topomap, nodes=nodes.pop(topomap.kind), other_kinds=nodes)


def coarser(node: TopoNode, step: float) -> TopoNode:
    """The node with its descriptors in steps of so many root mean squares; the node itself where
    they are."""
    stored = node.stored_descriptors
    if len(node.features) == 0 or (
        stored is not None and _length(stored) <= _ROUNDED_TWICE * np.sqrt(stored.shape[1]) / step
    ):
        return node
    rounded = _rounded(node.features.descriptors, step)
    return replace(
        node,
        features=replace(node.features, descriptors=unit_descriptors(rounded)),
        stored_descriptors=rounded,
    )


def _rounded(descriptors: Float32[np.ndarray, "n d"], step: float) -> Int8[np.ndarray, "n d"]:
    """Of descriptors of length 1."""
    return np.clip(np.rint(descriptors * (np.sqrt(descriptors.shape[1]) / step)), -127, 127).astype(
        np.int8
    )


def _length(stored: Int8[np.ndarray, "n d"]) -> float:
    return float(np.median(np.linalg.norm(stored.astype(np.float32), axis=1)))
