"""Measure how much each part of the method contributes to the error.

One part at a time is replaced by ground truth, by a better version, or by the paper's version.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.localization.guided import GuidedConfig
from topoloc.localization.localizer import LocalizerConfig
from topoloc_paper.asking import Way, summary
from topoloc_paper.datasets import Dataset
from topoloc_paper.maps import MapKind
from topoloc_paper.settings import Bench

SURF_ALONE = LocalizerConfig(kinds=("surf",))
# With a second feature type, guided matching is also how the types confirm each other's poses.
UNGUIDED = replace(SURF_ALONE, guided=GuidedConfig(num_nodes=0))


def rows(bench: Bench, datasets: list[Dataset]) -> list[dict[str, Any]]:
    """Return a row for each recording and each replaced part. Nodes come from surf-vlad or from
    ground truth."""
    return [
        row
        for dataset in datasets
        for label in dataset.queries
        for row in _rows(bench, dataset, label)
    ]


def ways_of(dataset: Dataset) -> dict[str, tuple[str, Way]]:
    """Return the replaced part -> (the stage that it belongs to, the settings of the queries)."""
    paper = MapKind.as_paper(dataset)
    return {
        "as it is": ("", Way(paper)),
        "nearest nodes given": ("coarse", Way(paper, knows_node=True)),
        "one node instead of four": (
            "coarse",
            Way(paper, config=LocalizerConfig(num_candidates=1)),
        ),
        "SURF alone": ("features", Way(paper, config=SURF_ALONE)),
        "SURF alone, no second, guided match": ("matching", Way(paper, config=UNGUIDED)),
        "SIFT instead of SURF": (
            "matching",
            Way(MapKind(dataset.d_thresh, dataset.lambda_rot, kind="sift")),
        ),
        "OpenCV's PnP": (
            "geometry",
            Way(paper, config=LocalizerConfig(pose=AbsolutePoseConfig("opencv", 8.0))),
        ),
        "topoloc's own, denser nodes": ("map", Way(MapKind.as_topoloc())),
    }


def _rows(bench: Bench, dataset: Dataset, label: str) -> list[dict[str, Any]]:
    found = []
    for change, (part, way) in ways_of(dataset).items():
        result = summary(bench, dataset, label, way)
        row: dict[str, Any] = {
            "dataset": dataset.name,
            "queries": label,
            "part": part,
            "change": change,
        }
        keys = (
            "num_queries",
            "num_localized",
            "median_translation_m",
            "median_rotation_deg",
            "topological_accuracy",
        )
        found.append(row | {key: result[key] for key in keys})
    return found
