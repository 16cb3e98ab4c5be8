"""The number of nodes: D_thresh from low to high, the error and the map's bytes that come of it
(the paper's last figure)."""

from __future__ import annotations

from typing import Any

from topoloc_paper.asking import Way, summary
from topoloc_paper.datasets import Dataset
from topoloc_paper.maps import MapKind, built
from topoloc_paper.settings import Bench


def rows(bench: Bench, datasets: list[Dataset]) -> list[dict[str, Any]]:
    """Return a row for each data set and D_thresh, from many nodes to few.

    Queries are those of the first recording of each data set. surf-vlad finds the nodes.
    """
    return [
        _row(bench, dataset, d_thresh) for dataset in datasets for d_thresh in sorted(dataset.sweep)
    ]


def _row(bench: Bench, dataset: Dataset, d_thresh: float) -> dict[str, Any]:
    label = next(iter(dataset.queries))
    kind = MapKind(d_thresh, dataset.lambda_rot)
    found, facts = summary(bench, dataset, label, Way(kind)), built(bench, dataset, kind).result
    row: dict[str, Any] = {
        "dataset": dataset.name,
        "queries": label,
        "d_thresh": d_thresh,
        "num_nodes": facts["num_nodes"],
    }
    row |= {"bytes": facts["bytes"], "node_bytes": facts["bytes"] - facts["place_bytes"]}
    row |= {
        key: found[key]
        for key in ("num_queries", "num_localized", "median_translation_m", "median_rotation_deg")
    }
    return row | {"ms": found["median_times_ms"]["total"]}
