"""Quantize a map's descriptors in larger steps, to make the map's file smaller.

Descriptors take half of a landmark's bytes. A file stores their numbers as signed bytes and
compresses them, so fewer different values take fewer bits. A map reads them as usual, because the
length of a descriptor does not matter. The default step is 0.64 times a number's root mean square
(16 times the file's step for 64 numbers). With it, the scalar product of two descriptors changes by
0.02. `benchmarks/descriptor_size.py` compares this with product quantization and with signs alone.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float32, Int8

from topoloc.lifelong.lazy_sequences import TransformedSequence
from topoloc.mapping.storage.point_encoding import dequantize_descriptors
from topoloc.mapping.topomap import TopoMetricMap, TopoNode

# A node counts as quantized if the median norm of its stored descriptors is at most this many times
# the norm expected for the step.
_MAX_NORM_RATIO = 1.5


def quantize_map_descriptors(topomap: TopoMetricMap, step: float) -> TopoMetricMap:
    """Return the map with quantized descriptors, or the same map if all nodes are quantized
    already.

    A node is quantized each time it is read. Virtual nodes keep their descriptors.

    Args:
        topomap: the map.
        step: the step, in root mean squares of a descriptor's numbers.

    Raises:
        MapError: a node cannot be read.
    """
    if all(
        quantize_node_descriptors(node, step) is node
        for layer in topomap.layers.values()
        for node in layer.nodes
    ):
        return topomap
    quantize = partial(quantize_node_descriptors, step=step)
    layers = {
        kind: replace(layer, nodes=TransformedSequence(layer.nodes, quantize))
        for kind, layer in topomap.layers.items()
    }
    return replace(topomap, layers=layers)


def quantize_node_descriptors(node: TopoNode, step: float) -> TopoNode:
    """Return the node with its descriptors quantized, or the same node if they are quantized
    already. `step` is in root mean squares of a descriptor's numbers."""
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
    """Quantize descriptors of length 1 to signed bytes."""
    return np.clip(np.rint(descriptors * (np.sqrt(descriptors.shape[1]) / step)), -127, 127).astype(
        np.int8
    )


def _median_norm(stored: Int8[np.ndarray, "n d"]) -> float:
    return float(np.median(np.linalg.norm(stored.astype(np.float32), axis=1)))
