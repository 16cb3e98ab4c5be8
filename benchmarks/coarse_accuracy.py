"""Topological accuracy of every coarse localizer: the nearest node named first, or one of its
neighbours.

    python benchmarks/coarse_accuracy.py MAP --queries SEQ [SEQ ...] [--weights FILE] [--methods
    ...] [--json FILE]

Each is trained for MAP from the images it keeps; MAP itself is not changed. A neighbour is a node
next to the nearest one along the route, or within 1.5 D_thresh of the query by Eq. 1. The maps and
queries of the README's table:

    topoloc build kitchen@0::2 kitchen.topo --d-thresh 0.5                       queries
    kitchen@1::2 topoloc build kitchen@0-59/100 kitchen60.topo --d-thresh 0.5 --lambda 2
    queries kitchen@60-99/100 topoloc simulate lab lab --laps 2 --spacing 0.16 --draft;  topoloc
    build lab lab.topo --d-thresh 2 --lambda 2 topoloc simulate lab lab_q --take 1 --spacing 0.3
    --mono --draft             queries lab_q
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.evaluation.query_localization import find_neighbour_ids
from topoloc.features.extraction import extract_features
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoSequence, to_grey
from topoloc.recordings.open import open_sequence
from topoloc.retrieval.coarse import CoarseLocalizer, open_coarse_localizer
from topoloc_training.classifier_config import CnnFcConfig, NetworkInputConfig
from topoloc_training.coarse_training import CoarseTrainingConfig, train_coarse

COMPACT_PICTURE = NetworkInputConfig(112, 84)
METHODS = ("surf-vlad", "cnn-nn", "vlad-nn", "cnn-fc compact", "cnn-fc squeezenet1_1")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map")
    parser.add_argument("--queries", nargs="+", required=True)
    parser.add_argument("--weights", help="SqueezeNet 1.1 trained on ImageNet")
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    topomap = TopoMetricMap.load(arguments.map)
    sequences = [open_sequence(path) for path in arguments.queries]
    print(f"{arguments.map}: {len(topomap.summaries)} nodes, {len(topomap.place_images)} images")
    print(
        f"{'localizer':<22}{'queries':<26}{'top-1':>7}{'neighbour':>11}{'trained s':>11}{'of a core':>11}",  # noqa: E501
        flush=True,
    )
    rows = []
    for method in arguments.methods:
        start, cpu = time.perf_counter(), time.process_time()
        localizer = trained(topomap, method, arguments.weights)
        cost = {"wall_s": time.perf_counter() - start, "cpu_s": time.process_time() - cpu}
        for path, sequence in zip(arguments.queries, sequences, strict=True):
            row = {"method": method, "queries": path} | judge(topomap, localizer, sequence) | cost
            rows.append(row)
            shares = f"{100 * row['top_1']:>6.1f}%{100 * row['neighbour']:>10.1f}%"
            print(
                f"{method:<22}{path[-24:]:<26}{shares}{row['wall_s']:>11.0f}{row['cpu_s']:>11.0f}",
                flush=True,
            )
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


def trained(topomap: TopoMetricMap, method: str, weights: str | None) -> CoarseLocalizer:
    if method == "surf-vlad":
        return open_coarse_localizer(topomap.first_layer.coarse_models[method])
    name, _, backbone = method.partition(" ")
    if backbone == "compact":
        config = CoarseTrainingConfig(cnn_fc=CnnFcConfig(picture=COMPACT_PICTURE))
        return open_coarse_localizer(train_coarse(topomap, name, "compact", "scratch", config))
    return open_coarse_localizer(train_coarse(topomap, name, "squeezenet1_1", weights))


def judge(
    topomap: TopoMetricMap, localizer: CoarseLocalizer, sequence: StereoSequence
) -> dict[str, Any]:
    """Top-1 and neighbour accuracy, and D_total from the query to the node named (the median, in
    D_thresh)."""
    nodes = NodePoses.from_poses([summary.world_from_cam for summary in topomap.summaries])
    lambda_rot, d_thresh = topomap.config.lambda_rot, topomap.config.d_thresh
    features_config = topomap.config.features
    hits, near, away = [], [], []
    for i, world_from_cam in enumerate(sequence.poses):
        assert world_from_cam is not None, "queries need their truth"
        image = sequence[i].image
        first, *_ = localizer.rank(image, extract_features(to_grey(image), features_config), 1)
        distances = node_distances(world_from_cam, nodes, lambda_rot)
        hits.append(first.row == int(np.argmin(distances)))
        near.append(
            hits[-1]
            or topomap.summaries[first.row].node_id in find_neighbour_ids(topomap, distances)
        )
        away.append(distances[first.row] / d_thresh)
    return {
        "top_1": float(np.mean(hits)),
        "neighbour": float(np.mean(near)),
        "median_d_total": float(np.median(away)),
    }


if __name__ == "__main__":
    main()
