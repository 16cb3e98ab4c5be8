"""Make a map smaller. Start reading at `prune_map`.

Vanished landmarks are removed first. A landmark has vanished if many images that show its
neighbours again never show it. Descriptors are then quantized on request
(`descriptor_quantization.py`). With a size budget, nodes supported by others are removed if every
node would otherwise keep few landmarks (`node_pruning.py`). Each remaining node then keeps as many
landmarks as fit. Landmarks with a high observation probability are preferred. They are spread over
the image, because a landmark beside others adds less. The objective is a submodular coverage: a
cell of the image counts as the square root of the sum of its probabilities (Krause & Golovin 2014,
greedy choice).
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.errors import MapError
from topoloc.lifelong.descriptor_quantization import quantize_map_descriptors
from topoloc.lifelong.lazy_sequences import OverlaySequence, TransformedSequence
from topoloc.lifelong.node_pruning import compute_node_support, remove_nodes, select_removed_nodes
from topoloc.lifelong.recall_change import measure_recall_change
from topoloc.localization.map_facts.map_building import with_map_statistics
from topoloc.mapping.landmark_statistics import LandmarkStatistics, merge_count_statistics
from topoloc.mapping.storage.map_writing import write_map
from topoloc.mapping.topomap import TopoMetricMap, TopoNode
from topoloc.recordings.atomic import temporary_file

_PAGE_SLACK_BYTES = 4096  # reserved for an entry in the map's history
_POINT_COLUMNS = ("points_img", "shapes", "descriptors", "points_cam", "sqrt_covs")


@dataclass(frozen=True)
class _FileSize:
    """Hold the sizes of a map's file in bytes: the whole file, one landmark of each feature type,
    and the average of a node's other data. The other data are its template, its virtual nodes and
    all its images but one."""

    size: int
    bytes_per_point: dict[str, float]
    of_node: float

    @staticmethod
    def of(path: Path, kinds: Sequence[str]) -> _FileSize:
        """Measure a map's file with these feature types."""
        lengths = " + ".join(f"total(length({name}))" for name in _POINT_COLUMNS)
        counted = "SELECT count(*), total(length(jpeg)) FROM"
        with closing(
            sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        ) as database:
            bytes_per_point = {}
            for kind in kinds:
                points = f"SELECT {lengths}, total(num_points) FROM node_points WHERE kind = ?"
                num_bytes, num = database.execute(points, (kind,)).fetchone()
                of_sums = database.execute(
                    "SELECT total(length(sums)) FROM landmark_sums WHERE kind = ?", (kind,)
                ).fetchone()[0]
                bytes_per_point[kind] = (num_bytes + of_sums) / max(num, 1)
            num, of_templates = database.execute(f"{counted} node_templates").fetchone()
            num_images, of_images = database.execute(f"{counted} place_images").fetchone()
            of_virtual_nodes = database.execute(
                f"SELECT {lengths} FROM side_node_points"
            ).fetchone()[0]
        of_images *= max(1.0 - num / max(num_images, 1), 0.0)
        return _FileSize(
            path.stat().st_size,
            bytes_per_point,
            (of_templates + of_virtual_nodes + of_images) / max(num, 1),
        )

    def bytes_without_points(self, topomap: TopoMetricMap) -> float:
        """Return the bytes of this file without the landmarks of its map."""
        return self.size - sum(
            of_one * sum(len(node.features) for node in topomap.layers[kind].nodes)
            for kind, of_one in self.bytes_per_point.items()
        )


def _measure_file_size(topomap: TopoMetricMap, path: Path) -> _FileSize:
    """Write the map to a temporary file beside `path` and measure it. Raises MapError."""
    try:
        with temporary_file(path) as tried:
            write_map(topomap, tried)
            return _FileSize.of(tried, topomap.kinds)
    except OSError as error:
        raise MapError(f"cannot write beside map {path}: {error.strerror}") from error


@dataclass(frozen=True, eq=False)
class PrunedMap:
    """Hold the pruned map and the numbers of changes, by name."""

    topomap: TopoMetricMap
    changes: dict[str, Any]


def prune_map(
    topomap: TopoMetricMap,
    path: Path,
    max_bytes: int | None = None,
    descriptors: Literal["fine", "coarse"] = "fine",
) -> PrunedMap:
    """Return the map without vanished landmarks and, if there is a budget, small enough for it.

    Args:
        topomap: the map.
        path: the map's file. Its size is the basis of the budget.
        max_bytes: the budget in bytes. None removes vanished landmarks only.
        descriptors: `coarse` quantizes the descriptors before any landmark is removed for the
            budget. `fine` keeps them.

    Raises:
        MapError: the budget is too small for the map with `min_points` landmarks per node.
    """
    # Step of coarse descriptors, in root mean squares of a descriptor's numbers. They are
    # quantized before any landmark is removed for the budget.
    descriptor_step = 0.64
    counted = _merge_session_counts(topomap)
    if descriptors == "coarse":
        counted = quantize_map_descriptors(counted, descriptor_step)
    file = (
        _FileSize.of(path, topomap.kinds)
        if counted is topomap
        else _measure_file_size(counted, path)
    )
    fewer = counted if max_bytes is None else _drop_nodes(counted, file, max_bytes)
    file = file if fewer is counted else _measure_file_size(fewer, path)
    return _prune_landmarks(topomap, fewer, path, file, max_bytes)


def _merge_session_counts(topomap: TopoMetricMap) -> TopoMetricMap:
    """Merge the observation counts of sessions that only counted. Return the same map if nothing
    changes."""

    def merge_counts(node: TopoNode) -> TopoNode:
        return replace(
            node,
            session_statistics=merge_count_statistics(node.session_statistics),
        )

    if not any(
        len(list(node.session_statistics)) > len(list(merge_counts(node).session_statistics))
        for layer in topomap.layers.values()
        for node in layer.nodes
    ):
        return topomap
    layers = {
        kind: replace(layer, nodes=TransformedSequence(layer.nodes, merge_counts))
        for kind, layer in topomap.layers.items()
    }
    return replace(topomap, layers=layers)


def _drop_nodes(topomap: TopoMetricMap, file: _FileSize, max_bytes: int) -> TopoMetricMap:
    """Remove nodes until each remaining node can keep `few_points` landmarks, or no further node
    can be removed. Return the same map if none needs to be removed."""
    # Whole nodes are removed if the budget leaves fewer landmarks per node than this.
    few_points = 200
    num_compared = 12  # number of near nodes that each node is compared with
    # A node is removed only if every place keeps a node with at least this many recognised
    # landmarks.
    min_held = 60
    remaining = {
        kind: np.array([(~_find_vanished(node)).sum() for node in topomap.layers[kind].nodes])
        for kind in topomap.kinds
    }
    min_bytes = sum(
        (
            np.minimum(remaining[kind], few_points) * file.bytes_per_point[kind]
            for kind in topomap.kinds
        ),
        np.zeros(1),
    )
    excess_bytes = file.bytes_without_points(topomap) + float(min_bytes.sum()) - max_bytes
    if excess_bytes <= 0:
        return topomap
    of_node, support = min_bytes + file.of_node, compute_node_support(topomap, num_compared)
    chosen = select_removed_nodes(
        support, min_held, lambda rows: float(of_node[rows].sum()) >= excess_bytes
    )
    return topomap if chosen is None else remove_nodes(topomap, *chosen)


def _prune_landmarks(
    before: TopoMetricMap,
    topomap: TopoMetricMap,
    path: Path,
    file: _FileSize,
    max_bytes: int | None,
) -> PrunedMap:
    """Remove vanished landmarks and reduce the others to the budget.

    Args:
        before: the original map.
        topomap: the map after the earlier steps.
        path: the map's file.
        file: the file sizes of `topomap`.
        max_bytes: the budget in bytes, or None.
    """
    vanished = {
        kind: [_find_vanished(node) for node in topomap.layers[kind].nodes]
        for kind in topomap.kinds
    }
    remaining = {
        kind: [int((~of_node).sum()) for of_node in vanished[kind]] for kind in topomap.kinds
    }
    largest = max(max(of_kind) for of_kind in remaining.values())
    most, budget, fixed_bytes = largest, max_bytes, file.bytes_without_points(topomap)
    num_nodes = len(before.summaries) - len(topomap.summaries)
    while True:
        if budget is not None:
            most = min(
                most,
                _max_points_per_node(remaining, file.bytes_per_point, fixed_bytes, budget),
            )
        if (
            topomap is before
            and most >= largest
            and not any(of_node.any() for of_kind in vanished.values() for of_node in of_kind)
        ):
            return PrunedMap(
                before, {"nodes_dropped": 0, "landmarks_gone": 0, "landmarks_dropped": 0}
            )
        pruned = _drop_landmarks(topomap, vanished, most)
        if (
            max_bytes is None
            or budget is None
            or (written := _measure_file_size(pruned.topomap, path).size + _PAGE_SLACK_BYTES)
            <= max_bytes
        ):
            changes = {"nodes_dropped": num_nodes} | pruned.changes
            return replace(
                pruned,
                changes=changes | measure_recall_change(before, pruned.topomap),
            )
        budget -= (
            round(1.1 * (written - max_bytes)) + _PAGE_SLACK_BYTES
        )  # the compressed size is known only after writing


def _drop_landmarks(
    topomap: TopoMetricMap, vanished: Mapping[str, list[np.ndarray]], most: int
) -> PrunedMap:
    """Remove the `vanished` landmarks (a mask per node) and keep at most `most` of the others per
    node."""
    pruned, num_gone, num_dropped = {}, 0, 0
    for kind, layer in topomap.layers.items():
        changed = {}
        for row, (node, of_node) in enumerate(zip(layer.nodes, vanished[kind], strict=True)):
            rows = np.flatnonzero(~of_node)
            kept = rows if len(rows) <= most else rows[_select_landmarks(node, rows, most)]
            num_gone, num_dropped = (
                num_gone + int(of_node.sum()),
                num_dropped + len(rows) - len(kept),
            )
            if len(kept) < len(of_node):
                changed[row] = select_landmarks(node, kept)
        pruned[kind] = replace(layer, nodes=OverlaySequence(layer.nodes, changed, []))
    summaries = [node.summary for node in pruned[topomap.kind].nodes]
    smaller = replace(topomap, summaries=summaries, layers=pruned)
    return PrunedMap(
        with_map_statistics(smaller), {"landmarks_gone": num_gone, "landmarks_dropped": num_dropped}
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
            parts = (
                getattr(of_session, name)[stays] for name in ("roots", "pulls", "expected", "seen")
            )
            session_statistics.append(
                LandmarkStatistics(of_session.session_id, new_row[of_session.rows[stays]], *parts)
            )
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


def _find_vanished(node: TopoNode) -> Bool[np.ndarray, " n"]:
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
            share = session_statistics.seen.sum(dtype=np.int64) / max(
                int(session_statistics.expected.sum(dtype=np.int64)), 1
            )
            expected[session_statistics.rows] += session_statistics.expected
            seen[session_statistics.rows] += session_statistics.seen
            log_missed[session_statistics.rows] += session_statistics.expected * np.log1p(
                -min(share, 0.99)
            )
    vanished = (expected >= min_expected) & (seen == 0) & (log_missed <= np.log(max_chance))
    return vanished if vanished.sum() <= max_gone_share * num else np.zeros(num, bool)


def _observation_probability(node: TopoNode) -> Float[np.ndarray, " n"]:
    """Return each landmark's probability of being seen if it should be visible, over all sessions
    (Laplace's rule)."""
    expected, seen = np.ones(len(node.features)) * 2.0, np.ones(len(node.features))
    for session_statistics in node.session_statistics:
        expected[session_statistics.rows] += session_statistics.expected
        seen[session_statistics.rows] += session_statistics.seen
    return seen / expected


def _select_landmarks(
    node: TopoNode, rows: Int[np.ndarray, " m"], most: int
) -> Int[np.ndarray, " k"]:
    """Select the rows that a node keeps. Greedy choice: each next landmark adds most to the
    coverage of its cell."""
    cells = 8  # number of cell columns in the image. The kept landmarks are spread over the cells
    size = node.camera.width / cells
    cell = (node.features.points_img[rows] / size).astype(np.int64)
    key = cell[:, 1] * (cells + 1) + cell[:, 0]
    chances, gains = _observation_probability(node)[rows], np.empty(len(rows))
    for one in np.unique(key):
        of_cell = np.flatnonzero(key == one)
        best_first = of_cell[np.argsort(-chances[of_cell], kind="stable")]
        total = np.cumsum(chances[best_first])
        gains[best_first] = np.sqrt(total) - np.sqrt(
            total - chances[best_first]
        )  # gains decrease within a cell, so sorting is the greedy choice
    return np.sort(np.argsort(-gains, kind="stable")[:most])


def _max_points_per_node(
    remaining: dict[str, list[int]],
    bytes_per_point: dict[str, float],
    fixed_bytes: float,
    max_bytes: int,
) -> int:
    """Return the largest number of landmarks per node and feature type that fits the budget.
    `fixed_bytes` is the size of the file without landmarks."""
    # Minimum number of landmarks per node. A budget that requires fewer is an error.
    min_points = 100

    def file_size_with(most: int) -> float:
        return fixed_bytes + sum(
            sum(min(n, most) for n in of_kind) * bytes_per_point[kind]
            for kind, of_kind in remaining.items()
        )

    if file_size_with(min_points) > max_bytes:
        least, num = (
            file_size_with(min_points) / 1e6,
            max(len(of_kind) for of_kind in remaining.values()),
        )
        raise MapError(
            f"with {min_points} landmarks each its {num} nodes take {least:.2f} MB; nothing"
            " is dropped"
        )
    low, high = min_points, max(max(of_kind) for of_kind in remaining.values())
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if file_size_with(middle) <= max_bytes else (low, middle - 1)
    return low
