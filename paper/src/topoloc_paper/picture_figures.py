"""Figures that need pictures or PoseNet's answers: conditions side by side, patch-normalised pairs,
PoseNet's path beside ours."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from topoloc.features.extraction import PatchNormalizationConfig, patch_normalize
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Localization
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.recordings.frame import to_grey
from topoloc_paper import posenet_baseline
from topoloc_paper.asking import Way, answers, queries_of
from topoloc_paper.datasets import Dataset
from topoloc_paper.drawings import draw_against_posenet, draw_pictures
from topoloc_paper.maps import MapKind, why_not
from topoloc_paper.settings import Bench

NUM_PLACES = 3


def against_posenet(bench: Bench) -> dict[str, Figure]:
    """For the first recording of each place: PoseNet's positions and those of cnn-fc (as in the
    paper), or surf-vlad without torch."""
    if why_not(bench, "posenet"):
        return {}
    figures = {}
    for dataset in bench.rendered:
        label = next(iter(dataset.queries))
        theirs = posenet_baseline.asked(bench, dataset, label)
        ours = answers(bench, dataset, label, Way(MapKind.as_paper(dataset), "cnn-fc"))
        found = [
            a.result.world_from_cam.translation for a in ours if isinstance(a.result, Localization)
        ]
        truths, posenet = np.array(theirs["truths"])[:, :3], np.array(theirs["poses"])[:, :3]
        figures[dataset.name] = draw_against_posenet(
            truths, posenet, np.array(found).reshape(-1, 3), f"{dataset.name}, {label}"
        )
    return figures


def conditions(bench: Bench) -> dict[str, Figure]:
    """Draw each place as mapped and under every query condition, from about the same poses."""
    figures = {}
    for dataset in (d for d in bench.rendered if len(d.queries) > 1):
        columns = _same_places(bench, dataset)
        names = ["mapped", *dataset.queries]
        rows = [[column[k] for column in columns] for k in range(NUM_PLACES)]
        figures[f"{dataset.name}_conditions"] = draw_pictures(rows, [""] * NUM_PLACES, names)
    return figures


def normalized_pairs(bench: Bench) -> dict[str, Figure]:
    """A mapped picture and the last condition's of the same place, as they are, and normalised by
    the paper's and topoloc's windows."""
    figures = {}
    for dataset in (d for d in bench.rendered if len(d.queries) > 1):
        columns = _same_places(bench, dataset)
        rows, names = [], []
        for name, column in zip(["mapped", *dataset.queries], columns, strict=True):
            if name in ("mapped", *list(dataset.queries)[-1:]):
                grey = to_grey(column[0])
                paper = patch_normalize(grey, PatchNormalizationConfig.paper())
                rows.append(
                    [grey, paper, patch_normalize(grey, PatchNormalizationConfig(65, 24.0))]
                )
                names.append(name)
        titles = ["as it is", "17x17, the paper's", "65x65, topoloc's"]
        figures[f"{dataset.name}_normalized"] = draw_pictures(rows, names, titles)
    return figures


def _same_places(bench: Bench, dataset: Dataset) -> list[list[np.ndarray]]:
    """For the mapping and each recording: `NUM_PLACES` pictures taken nearest to some of the first
    recording's queries."""
    first = queries_of(bench, dataset, next(iter(dataset.queries)))
    posed = [pose for pose in first.poses if pose is not None]
    anchors = [posed[(2 * k + 1) * len(posed) // (2 * NUM_PLACES)] for k in range(NUM_PLACES)]
    sequences = [
        dataset.open_mapping()[0],
        *(queries_of(bench, dataset, label) for label in dataset.queries),
    ]
    found = []
    for sequence in sequences:
        poses = [pose if pose is not None else Rigid3.identity() for pose in sequence.poses]
        stacked = NodePoses.from_poses(poses)
        found.append(
            [
                sequence[int(np.argmin(node_distances(anchor, stacked, 10.0)))].image
                for anchor in anchors
            ]
        )
    return found
