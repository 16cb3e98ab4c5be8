"""A map gets one of the paper's learned coarse localizers, trained from the small pictures that it
keeps. Needs topoloc-training.

    python examples/train_classifier.py [MAP] [--weights FILE] [--epochs 8] [--out FILE]

With `--weights` (SqueezeNet 1.1 of ImageNet, as torchvision publishes it) `cnn-nn` is made: nothing
is trained, its features are kept of every mapping picture. Without weights `cnn-fc` is trained from
nothing, which knows the mapping pictures alone.
"""

import argparse
from pathlib import Path

import topoloc
from topoloc.demo.recordings import SHIPPED
from topoloc.evaluation.metrics import summarize
from topoloc.evaluation.query_localization import localize_queries
from topoloc.mapping.nodes import NodeConfig
from topoloc_training.classifier_config import CnnFcConfig, NetworkInputConfig, TrainingConfig
from topoloc_training.coarse_storing import store_coarse
from topoloc_training.coarse_training import CoarseTrainingConfig, train_coarse


def main(map_file: Path | None, weights: str | None, epochs: int, out: Path) -> None:
    if map_file is None:  # few nodes, as the paper has them: D_thresh 2 m, lambda 2 m/rad
        map_file = out
        laps = [topoloc.open_sequence(SHIPPED / name) for name in ("map_lap1", "map_lap2")]
        topoloc.build_map(
            laps, topoloc.BuildConfig(nodes=NodeConfig(d_thresh=2.0, lambda_rot=2.0))
        ).save(map_file)
    topomap = topoloc.TopoMetricMap.load(map_file)
    print(f"{len(topomap.nodes)} nodes, {len(topomap.place_images)} pictures to learn from")

    name, backbone = ("cnn-nn", "squeezenet1_1") if weights else ("cnn-fc", "compact")
    of_fc = CnnFcConfig(
        picture=NetworkInputConfig(112, 84), training=TrainingConfig(max_epochs=epochs)
    )
    model = train_coarse(
        topomap, name, backbone, weights or "scratch", CoarseTrainingConfig(cnn_fc=of_fc)
    )
    store_coarse(
        map_file, out, model, make_default=False
    )  # the map's other coarse localizers stay, and so does its default

    trained, day = topoloc.TopoMetricMap.load(out), topoloc.open_sequence(SHIPPED / "day@0::4")
    for coarse in ("surf-vlad", name):
        judged = summarize(
            localize_queries(
                topoloc.Localizer(trained, topoloc.LocalizerConfig(coarse=coarse)), day
            )
        )
        accuracy, near = (
            100.0 * judged["topological_accuracy"],
            100.0 * judged["neighbour_accuracy"],
        )
        print(
            f"{coarse}: nearest node first in {accuracy:.0f} %, one of its neighbours in"
            f" {near:.0f} %"
        )
        print(f"    {judged['num_localized']} of {judged['num_queries']} localized")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "map", nargs="?", type=Path, help="a map of the built-in lab; by default one is made"
    )
    parser.add_argument("--weights", help="SqueezeNet 1.1 trained on ImageNet")
    parser.add_argument("--epochs", type=int, default=8, help="of cnn-fc; 60 are its default")
    parser.add_argument(
        "--out", type=Path, default=Path("lab_learned.topo"), help="the map file to write"
    )
    args = parser.parse_args()
    main(args.map, args.weights, args.epochs, args.out)
