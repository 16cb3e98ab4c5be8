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

from topoloc.lifelong.lazy_sequences import TransformedSequence
from topoloc.mapping.point_encoding import dequantize_descriptors
from topoloc.mapping.topomap import TopoMetricMap, TopoNode

# stored numbers no larger than so many times those of this step are in it, or a larger one, already
_MAX_NORM_RATIO = 1.5


def quantize_map_descriptors(topomap: TopoMetricMap, step: float) -> TopoMetricMap:
    """The map, each of whose nodes rounds its descriptors when it is asked for; the map itself
    where all are rounded. The walls beside the nodes stay as they are.

    Args:
        step: in root mean squares of a descriptor's numbers.

    Raises:
        MapError: from reading the nodes.
    """
    if all(
        quantize_node_descriptors(node, step) is node
        for kind in topomap.kinds
        for node in topomap.nodes_of(kind)
    ):
        return topomap
    nodes = {
        kind: TransformedSequence(
            topomap.nodes_of(kind), lambda node: quantize_node_descriptors(node, step)
        )
        for kind in topomap.kinds
    }
    return replace(topomap, nodes=nodes.pop(topomap.kind), other_kinds=nodes)


def quantize_node_descriptors(node: TopoNode, step: float) -> TopoNode:
    """The node with its descriptors in steps of so many root mean squares; the node itself where
    they are."""
    stored = node.stored_descriptors
    if len(node.features) == 0 or (
        stored is not None
        and _median_norm(stored) <= _MAX_NORM_RATIO * np.sqrt(stored.shape[1]) / step
    ):
        return node
    rounded = _quantize(node.features.descriptors, step)
    return replace(
        node,
        features=replace(node.features, descriptors=dequantize_descriptors(rounded)),
        stored_descriptors=rounded,
    )


def _quantize(descriptors: Float32[np.ndarray, "n d"], step: float) -> Int8[np.ndarray, "n d"]:
    """Of descriptors of length 1."""
    return np.clip(np.rint(descriptors * (np.sqrt(descriptors.shape[1]) / step)), -127, 127).astype(
        np.int8
    )


def _median_norm(stored: Int8[np.ndarray, "n d"]) -> float:
    return float(np.median(np.linalg.norm(stored.astype(np.float32), axis=1)))
