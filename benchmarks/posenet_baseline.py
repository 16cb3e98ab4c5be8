"""Compare PoseNet with the deep-geometric localizer: median pose errors on the same images, and
their ratio.

    python benchmarks/posenet_baseline.py MAP --queries SEQ [SEQ ...] [--weights FILE] [--epochs 80]
    [--losses ...] [--rates ...]

PoseNet is tuned as carefully as our own networks: every loss and learning rate is trained on the
map's images, and the network with the least mean D_total on the held-out images is used. It answers
every query. Ours is evaluated on its localized queries, and their share is printed.
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path

import numpy as np

from topoloc.evaluation.metrics import summarize
from topoloc.evaluation.query_localization import localize_queries
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence
from topoloc_paper.posenet import PoseNet, PoseNetConfig, train_posenet
from topoloc_training.classifier_config import NetworkInputConfig, TrainingConfig
from topoloc_training.weights import find_weights

LOSSES = ("beta", "learnt", "reprojection")
LEARNING_RATES = (3e-4, 1e-3)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map")
    parser.add_argument("--queries", nargs="+", required=True)
    parser.add_argument("--weights", help="SqueezeNet 1.1 trained on ImageNet")
    parser.add_argument("--epochs", type=int, default=80)
    parser.add_argument("--losses", nargs="+", default=LOSSES, choices=LOSSES)
    parser.add_argument("--rates", nargs="+", type=float, default=LEARNING_RATES)
    parser.add_argument("--coarse", default=None)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    topomap = TopoMetricMap.load(arguments.map)
    posenet = tuned(topomap, arguments)
    localizer = Localizer(topomap, LocalizerConfig(coarse=arguments.coarse))
    rows = []
    for path in arguments.queries:
        sequence = open_sequence(path)
        frames = [sequence[i] for i, pose in enumerate(sequence.poses) if pose is not None]
        pairs = list(
            zip(
                posenet.localize([f.image for f in frames]),
                [f.world_from_cam for f in frames],
                strict=True,
            )
        )
        theirs = [float(np.median([translation_error(a, b) for a, b in pairs if b is not None]))]
        theirs.append(
            float(np.rad2deg(np.median([rotation_error(a, b) for a, b in pairs if b is not None])))
        )
        ours = summarize(localize_queries(localizer, sequence))
        row = {
            "queries": path,
            "posenet_m": theirs[0],
            "posenet_deg": theirs[1],
            "ours_m": ours["median_translation_m"],
        }
        row |= {
            "ours_deg": ours["median_rotation_deg"],
            "localized": ours["num_localized"] / max(ours["num_queries"], 1),
        }
        rows.append(row)
        if row["ours_m"]:
            print(
                f"{path[-30:]:<32}PoseNet {theirs[0]:.3f} m, {theirs[1]:.2f} deg; ours"
                f" {row['ours_m']:.4f} m, {row['ours_deg']:.3f} deg ({100 * row['localized']:.0f} %"
                f" localized), {theirs[0] / row['ours_m']:.1f} and"
                f" {theirs[1] / row['ours_deg']:.1f} times smaller",
                flush=True,
            )
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


def tuned(topomap: TopoMetricMap, arguments: argparse.Namespace) -> PoseNet:
    """The PoseNet that does best on the held-out images."""
    found = find_weights("squeezenet1_1", arguments.weights)
    best: PoseNet | None = None
    for loss, rate in itertools.product(arguments.losses, arguments.rates):
        training = TrainingConfig(
            max_epochs=arguments.epochs, patience=arguments.epochs // 3, learning_rate=rate
        )
        posenet = train_posenet(
            topomap,
            "squeezenet1_1",
            found,
            PoseNetConfig(loss, picture=NetworkInputConfig(112, 84), training=training),
        )
        print(
            f"PoseNet, {loss} loss, learning rate {rate:g}: D_total {posenet.held_out_m:.3f} m on"
            " held-out images",
            flush=True,
        )
        if best is None or posenet.held_out_m < best.held_out_m:
            best = posenet
    assert best is not None
    return best


if __name__ == "__main__":
    main()
