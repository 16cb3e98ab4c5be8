"""Make a map smaller. Start reading at `prune`.

Vanished landmarks are removed first. A landmark has vanished if many images that show its
neighbours again never show it. With a size budget, nodes supported by others are removed if every
node would otherwise keep few landmarks. Each remaining node then keeps as many landmarks as fit
(`node_pruning.py`).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.errors import MapError
from topoloc.lifelong.node_localization import measure_recall_change
from topoloc.lifelong.node_pruning import (
    choose_landmarks,
    compute_node_support,
    find_vanished,
    remove_nodes,
    select_landmarks,
    select_removed_nodes,
    transform_nodes,
)
from topoloc.localization.map_facts.map_building import with_map_statistics
from topoloc.mapping.edit import WaitCallback, edit_map
from topoloc.mapping.landmark_statistics import merge_count_statistics
from topoloc.mapping.storage.entries import overlay
from topoloc.mapping.storage.map_file import MapFile
from topoloc.mapping.storage.map_writing import write_map
from topoloc.mapping.topomap import TopoMetricMap, TopoNode
from topoloc.mapping.validation import describe_failure
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
    def measure(path: Path, kinds: Sequence[str]) -> _FileSize:
        """Measure a map's file with these feature types. Raises MapError."""
        lengths = " + ".join(f"total(length({name}))" for name in _POINT_COLUMNS)
        counted = "SELECT count(*), total(length(jpeg)) FROM"
        with closing(MapFile(path)) as file, file.read_connection() as database:
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


def measure_file_size(topomap: TopoMetricMap, path: Path) -> _FileSize:
    """Write the map to a temporary file beside `path` and measure it. Raises MapError."""
    try:
        with temporary_file(path) as tried:
            write_map(topomap, tried)
            return _FileSize.measure(tried, topomap.kinds)
    except OSError as error:
        raise MapError(f"cannot write beside map {path}: {describe_failure(error)}") from error


@dataclass(frozen=True, eq=False)
class PrunedFile:
    """The changes of a pruned map file, numbers by their names, and its mapped length (m)."""

    changes: dict[str, Any]
    length_m: float


def prune(
    path: str | Path,
    max_mb: float | None = None,
    on_wait: WaitCallback | None = None,
) -> PrunedFile:
    """Remove from a map file the landmarks that are gone and, with a budget, those that add least.

    Args:
        path: the map file, which is replaced if anything is removed.
        max_mb: megabytes that the file may have; None removes only landmarks that are gone.
        on_wait: called if another process edits the map, before this one waits.

    Raises:
        ConfigError: a setting is out of its bounds.
        MapError: the budget is too small, or the map is missing, damaged, or cannot be written.
    """
    with edit_map(path, on_wait) as edit:
        before, length_m = edit.path.stat().st_size, edit.topomap.length_m
        max_bytes = None if max_mb is None else round(max_mb * 1e6)
        topomap, changes = prune_map(edit.topomap, edit.path, max_bytes)
        changes |= {"bytes_before": before}
        if topomap is not edit.topomap:
            to_size = "" if max_mb is None else f" to {max_mb:g} MB"
            edit.commit(topomap, f"prune{to_size}", changes)
    return PrunedFile(changes | {"bytes": Path(path).stat().st_size}, length_m)


def prune_map(
    topomap: TopoMetricMap,
    path: Path,
    max_bytes: int | None = None,
) -> tuple[TopoMetricMap, dict[str, Any]]:
    """Return the map without vanished landmarks and, if there is a budget (`max_bytes`), small
    enough for it. Return the numbers of changes by name, too.

    The file of the map at `path` is the basis of the budget. Raises MapError if
    the budget is too small for 100 landmarks per node.
    """
    counted = transform_nodes(topomap, _merge_session_counts)
    is_same = counted is topomap and topomap.file is not None
    file = _FileSize.measure(path, topomap.kinds) if is_same else measure_file_size(counted, path)
    fewer = counted if max_bytes is None else _drop_nodes(counted, file, max_bytes)
    file = file if fewer is counted else measure_file_size(fewer, path)
    return _prune_landmarks(topomap, fewer, path, file, max_bytes)


def _merge_session_counts(node: TopoNode) -> TopoNode:
    """Merge the observation counts of sessions that only counted. Return the same node if nothing
    changes."""
    before = list(node.session_statistics)
    merged = merge_count_statistics(before)
    return node if len(merged) == len(before) else replace(node, session_statistics=merged)


def _drop_nodes(topomap: TopoMetricMap, file: _FileSize, max_bytes: int) -> TopoMetricMap:
    """Remove nodes until each remaining node can keep `few_points` landmarks, or no further node
    can be removed. Return the same map if none needs to be removed."""
    # Whole nodes are removed if the budget leaves fewer landmarks per node than this.
    few_points = 200
    num_compared = 12  # number of near nodes that each node is compared with
    # A node is removed only if every place keeps a node with at least this many recognised
    # landmarks.
    min_held = 60
    min_bytes = np.zeros(len(topomap.summaries))
    for kind, layer in topomap.layers.items():
        remaining = np.array([(~find_vanished(node)).sum() for node in layer.nodes])
        min_bytes += np.minimum(remaining, few_points) * file.bytes_per_point[kind]
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
) -> tuple[TopoMetricMap, dict[str, Any]]:
    """Remove vanished landmarks and reduce the others to the budget. `before` is the original map,
    `topomap` the map after the earlier steps with its sizes `file`."""
    vanished = {
        kind: [find_vanished(node) for node in layer.nodes]
        for kind, layer in topomap.layers.items()
    }
    remaining = {
        kind: [int((~of_node).sum()) for of_node in masks] for kind, masks in vanished.items()
    }
    is_any_vanished = any(of_node.any() for masks in vanished.values() for of_node in masks)
    most = largest = max(max(of_kind) for of_kind in remaining.values())
    fixed_bytes, excess = file.bytes_without_points(topomap), 0
    num_nodes = len(before.summaries) - len(topomap.summaries)
    while True:
        if max_bytes is not None:
            limit = max_bytes - excess
            most = min(
                most, _max_points_per_node(remaining, file.bytes_per_point, fixed_bytes, limit)
            )
        if topomap is before and most >= largest and not is_any_vanished:
            return before, {"nodes_dropped": 0, "landmarks_gone": 0, "landmarks_dropped": 0}
        pruned, changes = _drop_landmarks(topomap, vanished, most)
        written = 0
        if max_bytes is not None:
            written = measure_file_size(pruned, path).size + _PAGE_SLACK_BYTES
        if max_bytes is None or written <= max_bytes:
            changes = {"nodes_dropped": num_nodes} | changes
            return pruned, changes | measure_recall_change(before, pruned)
        # the compressed size is known only after writing
        excess += round(1.1 * (written - max_bytes)) + _PAGE_SLACK_BYTES


def _drop_landmarks(
    topomap: TopoMetricMap, vanished: Mapping[str, list[np.ndarray]], most: int
) -> tuple[TopoMetricMap, dict[str, Any]]:
    """Remove the `vanished` landmarks (a mask per node) and keep at most `most` of the others per
    node. Return the map and the numbers of removed landmarks."""
    layers, num_gone, num_dropped = {}, 0, 0
    for kind, layer in topomap.layers.items():
        changed = {}
        for row, (node, of_node) in enumerate(zip(layer.nodes, vanished[kind], strict=True)):
            rows = np.flatnonzero(~of_node)
            kept = rows if len(rows) <= most else rows[choose_landmarks(node, rows, most)]
            num_gone += len(of_node) - len(rows)
            num_dropped += len(rows) - len(kept)
            if len(kept) < len(of_node):
                changed[row] = select_landmarks(node, kept)
        layers[kind] = replace(layer, nodes=overlay(layer.nodes, changed, []))
    summaries = [node.summary for node in layers[topomap.kind].nodes]
    smaller = with_map_statistics(replace(topomap, summaries=summaries, layers=layers))
    return smaller, {"landmarks_gone": num_gone, "landmarks_dropped": num_dropped}


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
        least, num = file_size_with(min_points) / 1e6, max(map(len, remaining.values()))
        raise MapError(
            f"with {min_points} landmarks each its {num} nodes take {least:.2f} MB; nothing"
            " is dropped"
        )
    largest = max(max(of_kind) for of_kind in remaining.values())
    counts = range(min_points, max(largest, min_points) + 1)
    return counts[bisect_right(counts, max_bytes, key=file_size_with) - 1]
