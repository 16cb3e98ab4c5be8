"""Make a node smaller: select its landmarks, and quantize their descriptors in larger steps.

Landmarks with a high observation probability are kept. They are spread over the image, because a
landmark beside others adds less. The objective is a submodular coverage: a cell of the image counts
as the square root of the sum of its probabilities (Krause & Golovin 2014, greedy choice).

Descriptors take half of a landmark's bytes. A file stores their numbers as signed bytes and
compresses them, so fewer different values take fewer bits. A map reads them as usual, because the
length of a descriptor does not matter. The default step is 0.64 times a number's root mean square
(16 times the file's step for 64 numbers). With it, the scalar product of two descriptors changes by
0.02. `benchmarks/descriptor_size.py` compares this with product quantization and with signs alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from topoloc.mapping.landmark_statistics import LandmarkStatistics
from topoloc.mapping.storage.entries import change_each
from topoloc.mapping.storage.point_encoding import dequantize_descriptors, quantize_descriptors
from topoloc.mapping.topomap import TopoMetricMap, TopoNode

# A node counts as quantized if the median norm of its stored descriptors is at most this many times
# the norm expected for the step.
_MAX_NORM_RATIO = 1.5


def transform_nodes(
    topomap: TopoMetricMap, transform: Callable[[TopoNode], TopoNode]
) -> TopoMetricMap:
    """Return the map with each node transformed at every access, or the same map if `transform`
    returns all nodes unchanged."""
    if all(transform(node) is node for layer in topomap.layers.values() for node in layer.nodes):
        return topomap
    layers = {
        kind: replace(layer, nodes=change_each(layer.nodes, transform))
        for kind, layer in topomap.layers.items()
    }
    return replace(topomap, layers=layers)


def quantize_node_descriptors(node: TopoNode, step: float) -> TopoNode:
    """Return the node with its descriptors quantized, or the same node if they are quantized
    already. `step` is in root mean squares of a descriptor's numbers."""
    stored, descriptors = node.stored_descriptors, node.features.descriptors
    scale = np.sqrt(descriptors.shape[1]) / step
    if stored is not None and len(stored) > 0:
        norms = np.linalg.norm(stored.astype(np.float32), axis=1)
        if np.median(norms) <= _MAX_NORM_RATIO * scale:
            return node
    if len(descriptors) == 0:
        return node
    rounded = quantize_descriptors(descriptors, scale)
    return replace(
        node,
        features=replace(node.features, descriptors=dequantize_descriptors(rounded)),
        stored_descriptors=rounded,
    )


def select_landmarks(node: TopoNode, kept: Int[np.ndarray, " k"]) -> TopoNode:
    """Return the node with the landmarks `kept` (rows in increasing order) and their session
    statistics."""
    new_row = np.full(len(node.features), -1)
    new_row[kept] = np.arange(len(kept))
    session_statistics = []
    for of_session in node.session_statistics:
        stays = new_row[of_session.rows] >= 0
        if stays.any():
            names, rows = ("roots", "pulls", "expected", "seen"), new_row[of_session.rows[stays]]
            parts = (getattr(of_session, name)[stays] for name in names)
            session_statistics.append(LandmarkStatistics(of_session.session_id, rows, *parts))
    stored = node.stored_descriptors
    return replace(
        node,
        summary=replace(node.summary, num_points=len(kept)),
        features=node.features.select(kept),
        points_cam=node.points_cam[kept],
        point_sqrt_covs=node.point_sqrt_covs[kept],
        session_statistics=session_statistics,
        stored_descriptors=None if stored is None else stored[kept],
    )


def find_vanished(node: TopoNode) -> Bool[np.ndarray, " n"]:
    """Return the mask of landmarks that later sessions never saw although they saw the rest of the
    node.

    The number of missed images must be large enough: a session that finds a third of the landmarks
    misses an existing one in four images with a probability of one in five.
    """
    # Minimum number of images of later sessions that should have shown a landmark, before it
    # can count as vanished.
    min_expected = 4
    # A landmark counts as vanished if an existing landmark would stay unseen in all these
    # images with at most this probability. The probability follows from the shares that the
    # sessions saw of the node.
    max_chance = 0.02
    # If more than this share of a node's landmarks would count as vanished, none of them
    # does.
    max_gone_share = 0.7
    num = len(node.features)
    expected, seen, log_missed = np.zeros(num, np.int64), np.zeros(num, np.int64), np.zeros(num)
    for session_statistics in node.session_statistics:
        later = session_statistics.session_id != node.summary.session_id
        if later and session_statistics.is_reobserved():
            rows, own = session_statistics.rows, session_statistics.expected
            num_seen = session_statistics.seen.sum(dtype=np.int64)
            share = num_seen / max(int(own.sum(dtype=np.int64)), 1)
            expected[rows] += own
            seen[rows] += session_statistics.seen
            log_missed[rows] += own * np.log1p(-min(share, 0.99))
    vanished = (expected >= min_expected) & (seen == 0) & (log_missed <= np.log(max_chance))
    return vanished if vanished.sum() <= max_gone_share * num else np.zeros(num, bool)


def choose_landmarks(
    node: TopoNode, rows: Int[np.ndarray, " m"], most: int
) -> Int[np.ndarray, " k"]:
    """Select the rows that a node keeps. Greedy choice: each next landmark adds most to the
    coverage of its cell."""
    cells = 8  # number of cell columns in the image. The kept landmarks are spread over the cells
    size = node.camera.width / cells
    cell = (node.features.points_img[rows] / size).astype(np.int64)
    key = cell[:, 1] * (cells + 1) + cell[:, 0]
    # the probability of being seen if it should be visible, over all sessions (Laplace's rule)
    expected, seen = np.ones(len(node.features)) * 2.0, np.ones(len(node.features))
    for of_session in node.session_statistics:
        expected[of_session.rows] += of_session.expected
        seen[of_session.rows] += of_session.seen
    chances, gains = (seen / expected)[rows], np.empty(len(rows))
    for one in np.unique(key):
        of_cell = np.flatnonzero(key == one)
        best_first = of_cell[np.argsort(-chances[of_cell], kind="stable")]
        total = np.cumsum(chances[best_first])
        # gains decrease within a cell, so sorting is the greedy choice
        gains[best_first] = np.sqrt(total) - np.sqrt(total - chances[best_first])
    return np.sort(np.argsort(-gains, kind="stable")[:most])
