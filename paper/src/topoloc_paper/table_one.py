"""Make Tables I and II: PoseNet and every coarse localizer on every recording, beside the paper's
figures.

Nodes are placed by the paper's D_thresh.
"""

from __future__ import annotations

from typing import Any

from topoloc.errors import TrainingError, WeightsError
from topoloc_paper import posenet_baseline
from topoloc_paper.asking import Way, summary
from topoloc_paper.datasets import Dataset
from topoloc_paper.maps import MapKind, taught, why_not
from topoloc_paper.published import TABLE_ONE, TABLE_TWO, MedianErrors
from topoloc_paper.settings import LEARNED, Bench

METHODS = ("posenet", *LEARNED, "surf-vlad")
# What the paper asked each map: the other lane in the light of the mapping, the evening, the lab as
# it was.
TABLE_ONE_QUERIES = {"street": "clear", "corridor": "evening", "lab": "day"}
KEPT = (
    "num_queries",
    "num_localized",
    "median_translation_m",
    "median_rotation_deg",
    "topological_accuracy",
    "neighbour_accuracy",
)


def rows(bench: Bench, dataset: Dataset, label: str) -> list[dict[str, Any]]:
    """A row for each method, and two of surf-vlad on topoloc's own nodes: the product as it
    comes."""
    found = [_row(bench, dataset, label, method, MapKind.as_paper(dataset)) for method in METHODS]
    return [*found, _row(bench, dataset, label, "surf-vlad", MapKind.as_topoloc())]


def all_rows(bench: Bench, datasets: list[Dataset]) -> list[dict[str, Any]]:
    """The rows of every recording of these data sets."""
    return [
        row
        for dataset in datasets
        for label in dataset.queries
        for row in rows(bench, dataset, label)
    ]


def published_for(dataset: str, label: str, method: str) -> MedianErrors | None:
    """Return the paper's figure for the same case, None if it has none."""
    if dataset == "street" and label in ("cloudy", "rain"):
        return TABLE_TWO[label].get(method)
    return (
        TABLE_ONE.get(dataset, {}).get(method) if TABLE_ONE_QUERIES.get(dataset) == label else None
    )


def _row(bench: Bench, dataset: Dataset, label: str, method: str, kind: MapKind) -> dict[str, Any]:
    row: dict[str, Any] = {
        "dataset": dataset.name,
        "title": dataset.title,
        "queries": label,
        "method": method,
        "nodes": kind.words,
    }
    row |= {"weights": bench.config.weights.words(method), "real": dataset.is_real}
    paper = published_for(dataset.name, label, method)
    row |= {
        "paper_m": paper.metres if paper else None,
        "paper_deg": paper.degrees if paper else None,
    }
    if missing := why_not(bench, method):
        return row | {"missing": missing}
    try:
        if method == "posenet":
            found = posenet_baseline.asked(bench, dataset, label)
            done = posenet_baseline.trained(bench, dataset)
            row["training"] = (
                f"{done.result['loss']} loss, at most {done.result['epochs']} epochs,"
                f" {done.seconds:.0f} s"
            )
        else:
            found = summary(bench, dataset, label, Way(kind, method))
            row["training"] = (
                f"{taught(bench, dataset, kind, method).seconds:.0f} s" if method in LEARNED else ""
            )
            row["false_accepts"] = found["false_accepts"]
            row["ms"] = found["median_times_ms"].get("total")
    except (TrainingError, WeightsError) as error:
        return row | {"missing": str(error)}
    return row | {key: found.get(key) for key in KEPT}
