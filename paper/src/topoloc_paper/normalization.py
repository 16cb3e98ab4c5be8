"""With and without patch normalisation: the paper claims about 20 % better accuracy with it, on
data that is not simulated."""

from __future__ import annotations

from typing import Any

from topoloc.localization.localizer import LocalizerConfig
from topoloc_paper.asking import Way, summary
from topoloc_paper.datasets import Dataset
from topoloc_paper.maps import MapKind, Normalization
from topoloc_paper.settings import Bench

FEATURE_TYPES: tuple[Normalization, ...] = ("none", "paper", "wide")
# The images of learned features have the normalization of their network in every map.
NORMALIZED_FEATURES = LocalizerConfig(kinds=("surf",))


def rows(bench: Bench, datasets: list[Dataset]) -> list[dict[str, Any]]:
    """Query every recording in maps without normalisation, with the paper's 17x17 one, and with
    topoloc's.

    surf-vlad finds the nodes.
    """
    return [
        row
        for dataset in datasets
        for label in dataset.queries
        for row in _rows(bench, dataset, label)
    ]


def _rows(bench: Bench, dataset: Dataset, label: str) -> list[dict[str, Any]]:
    found = []
    for kind in FEATURE_TYPES:
        way = Way(MapKind.as_paper(dataset, kind), config=NORMALIZED_FEATURES)
        result = summary(bench, dataset, label, way)
        row: dict[str, Any] = {
            "dataset": dataset.name,
            "queries": label,
            "normalization": kind,
            "real": dataset.is_real,
        }
        row |= {
            key: result[key]
            for key in (
                "num_queries",
                "num_localized",
                "median_translation_m",
                "median_rotation_deg",
            )
        }
        found.append(
            row
            | {
                "topological_accuracy": result["topological_accuracy"],
                "recall_25cm": result["recall"]["0.25m_2deg"],
            }
        )
    return found
