"""A map made smaller: read from `prune_map`. What is gone goes first, then what adds least.

A landmark is gone where pictures that found their other landmarks again never found this one. For a budget, every node then keeps so many
landmarks as fit: those with the best chance to be seen again, spread over the picture, for a landmark beside others tells less
(submodular coverage: a cell of the picture counts as the root of the chances in it; Krause & Golovin 2014, greedy choice).
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.bounds import AtLeast, Between, check_bounds
from topoloc.errors import MapError
from topoloc.lifelong.earlier_recall import earlier_recall
from topoloc.lifelong.overlay import Overlay
from topoloc.localization.map_facts.building import with_map_facts
from topoloc.map.sums import LandmarkSums
from topoloc.map.topomap import TopoMetricMap, TopoNode
from topoloc.map.writing import write_map
from topoloc.sequences.atomic import scratch_file

_PAGES = 4096  # what an entry in the history may take
_POINT_COLUMNS = ("points_img", "shapes", "descriptors", "points_cam", "sqrt_covs")


@dataclass(frozen=True)
class PruneConfig:
    """What is taken for gone, and what is never dropped."""

    min_expected: Annotated[int, Between(1, 1000)] = 4
    """Pictures of later sessions that should have shown a landmark, before it can be taken for gone."""
    min_seen_share: Annotated[float, Between(0, 1)] = 0.3
    """Only sessions count that saw at least this share of a node's landmarks again: in another light none are seen."""
    cells: Annotated[int, Between(1, 100)] = 8
    """The picture's columns of cells, over which the landmarks that are kept are spread."""
    min_points: Annotated[int, Between(10, 100_000)] = 100
    """Landmarks that a node keeps at least; a budget that asks for fewer is refused."""
    max_gone_share: Annotated[float, AtLeast(0)] = 0.7
    """Of a node's landmarks at most this share is taken for gone."""
    earlier_asked: Annotated[int, Between(0, 10_000)] = 24
    """Nodes, at most, that the map is asked before and after, for its history to tell what the edit cost; 0: none."""


@dataclass(frozen=True, eq=False)
class PrunedMap:
    """The smaller map, and what changed: numbers by their names."""

    topomap: TopoMetricMap
    changes: dict[str, Any]


def prune_map(topomap: TopoMetricMap, path: Path, max_bytes: int | None = None, config: PruneConfig | None = None) -> PrunedMap:
    """The map without landmarks that are gone, and, with a budget, with so many a node that its file fits.

    Args:
        path: the map's file, whose bytes the budget is reckoned from.

    Raises:
        ConfigError: a setting is out of its bounds.
        MapError: the budget is too small for what is no landmark, and `min_points` a node.
    """
    config = config or PruneConfig()
    check_bounds(config)
    gone = {kind: [_gone(node, config) for node in topomap.nodes_of(kind)] for kind in topomap.kinds}
    left = {kind: [int((~of_node).sum()) for of_node in gone[kind]] for kind in topomap.kinds}
    largest = max(max(of_kind) for of_kind in left.values())
    most, budget = largest, max_bytes
    while True:
        if budget is not None:
            most = min(most, _most_points(left, _point_bytes(path, topomap.kinds), path.stat().st_size, budget, config))
        if most >= largest and not any(of_node.any() for of_kind in gone.values() for of_node in of_kind):
            return PrunedMap(topomap, {"landmarks_gone": 0, "landmarks_dropped": 0})
        pruned = _with_fewer(topomap, gone, most, config)
        if max_bytes is None or budget is None or (size := _bytes_of(pruned.topomap, path)) <= max_bytes:
            return replace(pruned, changes=pruned.changes | earlier_recall(topomap, pruned.topomap, config.earlier_asked))
        budget -= round(1.1 * (size - max_bytes)) + _PAGES  # how well bytes pack is known only now


def _with_fewer(topomap: TopoMetricMap, gone: Mapping[str, list[np.ndarray]], most: int, config: PruneConfig) -> PrunedMap:
    """Without the landmarks that are `gone` (booleans, a node), and with `most` of the others a node."""
    pruned, num_gone, num_dropped = {}, 0, 0
    for kind in topomap.kinds:
        changed = {}
        for row, (node, of_node) in enumerate(zip(topomap.nodes_of(kind), gone[kind], strict=True)):
            rows = np.flatnonzero(~of_node)
            kept = rows if len(rows) <= most else rows[_chosen(node, rows, most, config)]
            num_gone, num_dropped = num_gone + int(of_node.sum()), num_dropped + len(rows) - len(kept)
            if len(kept) < len(of_node):
                changed[row] = with_points(node, kept)
        pruned[kind] = Overlay(topomap.nodes_of(kind), changed, [])
    nodes = pruned.pop(topomap.kind)
    smaller = replace(topomap, summaries=[node.summary for node in nodes], nodes=nodes, other_kinds=pruned)
    return PrunedMap(with_map_facts(smaller), {"landmarks_gone": num_gone, "landmarks_dropped": num_dropped})


def _bytes_of(topomap: TopoMetricMap, path: Path) -> int:
    """Of its file, which is to be at `path`, with an entry for one more edit. Raises MapError."""
    try:
        with scratch_file(path) as tried:
            write_map(topomap, tried)
            return tried.stat().st_size + _PAGES
    except OSError as error:
        raise MapError(f"cannot write beside map {path}: {error.strerror}") from error


def with_points(node: TopoNode, kept: Int[np.ndarray, " k"]) -> TopoNode:
    """The node with these of its landmarks (rows in increasing order) and what sessions know of them."""
    new_row = np.full(len(node.features), -1)
    new_row[kept] = np.arange(len(kept))
    sums = []
    for of_session in node.sums:
        stays = new_row[of_session.rows] >= 0
        if stays.any():
            parts = (getattr(of_session, name)[stays] for name in ("roots", "pulls", "expected", "seen"))
            sums.append(LandmarkSums(of_session.session_id, new_row[of_session.rows[stays]], *parts))
    stored = node.stored_descriptors
    return replace(
        node,
        summary=replace(node.summary, num_points=len(kept)),
        features=node.features.select(kept),
        points_cam=node.points_cam[kept],
        point_sqrt_covs=node.point_sqrt_covs[kept],
        sums=sums,
        stored_descriptors=None if stored is None else stored[kept],
    )


def _gone(node: TopoNode, config: PruneConfig) -> Bool[np.ndarray, " n"]:
    """The landmarks that later sessions never saw though they saw the rest."""
    num = len(node.features)
    expected, seen = np.zeros(num, np.int64), np.zeros(num, np.int64)
    for sums in node.sums:
        later = sums.session_id != node.summary.session_id
        if later and sums.seen.sum(dtype=np.int64) >= config.min_seen_share * sums.expected.sum(dtype=np.int64):
            expected[sums.rows] += sums.expected
            seen[sums.rows] += sums.seen
    gone = (expected >= config.min_expected) & (seen == 0)
    return gone if gone.sum() <= config.max_gone_share * num else np.zeros(num, bool)


def _chances(node: TopoNode) -> Float[np.ndarray, " n"]:
    """Each landmark's chance to be seen by a picture that should show it, by all that sessions saw (Laplace's rule)."""
    expected, seen = np.ones(len(node.features)) * 2.0, np.ones(len(node.features))
    for sums in node.sums:
        expected[sums.rows] += sums.expected
        seen[sums.rows] += sums.seen
    return seen / expected


def _chosen(node: TopoNode, rows: Int[np.ndarray, " m"], most: int, config: PruneConfig) -> Int[np.ndarray, " k"]:
    """Which of these rows a node keeps: chance by chance the one that adds most to what its cell holds already."""
    size = node.camera.width / config.cells
    cell = (node.features.points_img[rows] / size).astype(np.int64)
    key = cell[:, 1] * (config.cells + 1) + cell[:, 0]
    chances, gains = _chances(node)[rows], np.empty(len(rows))
    for one in np.unique(key):
        of_cell = np.flatnonzero(key == one)
        best_first = of_cell[np.argsort(-chances[of_cell], kind="stable")]
        total = np.cumsum(chances[best_first])
        gains[best_first] = np.sqrt(total) - np.sqrt(total - chances[best_first])  # falls from one to the next: greedy is sorting
    return np.sort(np.argsort(-gains, kind="stable")[:most])


def _point_bytes(path: Path, kinds: Sequence[str]) -> dict[str, float]:
    """Bytes that a landmark of each kind takes in the file."""
    lengths = " + ".join(f"sum(length({name}))" for name in _POINT_COLUMNS)
    query = f"SELECT {lengths}, sum(num_points) FROM node_points WHERE kind = ?"
    sums = "SELECT total(length(sums)) FROM landmark_sums WHERE kind = ?"
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as database:
        of_kind = {}
        for kind in kinds:
            num_bytes, num = database.execute(query, (kind,)).fetchone()
            of_kind[kind] = (num_bytes + database.execute(sums, (kind,)).fetchone()[0]) / max(num, 1)
    return of_kind


def _most_points(left: dict[str, list[int]], of_point: dict[str, float], size: int, max_bytes: int, config: PruneConfig) -> int:
    """Landmarks a node of each kind so that the file fits."""
    everything = sum(sum(of_kind) * of_point[kind] for kind, of_kind in left.items())
    rest = max(size - everything, 0.0)

    def bytes_with(most: int) -> float:
        return rest + sum(sum(min(n, most) for n in of_kind) * of_point[kind] for kind, of_kind in left.items())

    if bytes_with(config.min_points) > max_bytes:
        least = bytes_with(config.min_points) / 1e6
        raise MapError(f"map of {size / 1e6:.2f} MB: with {config.min_points} landmarks a node it takes {least:.2f} MB; nothing is dropped")
    low, high = config.min_points, max(max(of_kind) for of_kind in left.values())
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if bytes_with(middle) <= max_bytes else (low, middle - 1)
    return low
