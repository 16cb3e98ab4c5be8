"""Where an error comes from: one part at a time is given the truth, made better, or made the
paper's."""

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
    """A row for each recording and each part that is changed; surf-vlad finds the nodes where they
    are not given."""
    return [
        row
        for dataset in datasets
        for label in dataset.queries
        for row in _rows(bench, dataset, label)
    ]


def ways_of(dataset: Dataset) -> dict[str, tuple[str, Way]]:
    """What is changed -> (the part of the method that it belongs to, how the queries are then
    answered)."""
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
