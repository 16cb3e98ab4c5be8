"""Train the paper's baseline, PoseNet, on the mapping images of our classifiers, and run the same
queries.

The method is that of Kendall, Grimes & Cipolla (2015) and Kendall & Cipolla (2017). `posenet.py` is
the network. Each loss of the settings is trained, and the network with the least mean D_total on
the held-out images answers every query.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.mapping.topomap import TopoMetricMap
from topoloc_paper.asking import queries_of
from topoloc_paper.datasets import Dataset
from topoloc_paper.maps import MapKind, built, path_of
from topoloc_paper.settings import Bench, sequence_digest
from topoloc_paper.stage_code import learning
from topoloc_paper.stages import Done, digest_of
from topoloc_paper.stored_answers import pose_of, pose_to_json
from topoloc_training.classifier_config import NetworkInputConfig

if TYPE_CHECKING:
    from topoloc_paper.posenet import PoseNet, PoseNetConfig

_CODE = learning("topoloc_paper/posenet.py")


def trained(bench: Bench, dataset: Dataset) -> Done:
    """Train the network, and return the best loss and the training times. `_network_path` is its
    file.

    Raises:
        WeightsError, TrainingError: see `train_posenet`.
        MissingExtraError: torch is not installed. `why_not` returns this reason in advance.
    """
    kind = MapKind.as_paper(dataset)
    map_done = built(bench, dataset, kind)
    target = _network_path(bench, dataset)
    configs = [
        _config(bench, loss, map_done.result["num_images"]) for loss in bench.config.posenet_losses
    ]
    settings = {
        "images": map_done.result["images_digest"],
        "weights": bench.config.weights.digest("posenet"),
    }
    settings |= {"configs": [asdict(config) for config in configs]}

    def train() -> dict[str, Any]:
        from topoloc_paper.posenet import train_posenet
        from topoloc_training.weights import find_weights

        backbone, file = bench.config.weights.choice("posenet")
        weights = find_weights(backbone, file)
        topomap = TopoMetricMap.load(path_of(bench, dataset, kind))
        scores: dict[str, float] = {}
        best: PoseNet | None = None
        for config in configs:
            loss = config.loss
            told, checkpoint = (
                f"PoseNet of {dataset.name} ({loss})",
                target.with_name(f"{target.stem}-{digest_of(settings)}-{loss}.checkpoint"),
            )
            found = train_posenet(
                topomap,
                backbone,
                weights,
                config,
                lambda stage, done, total, told=told: bench.progress(told, done, total),
                checkpoint,
            )
            scores[loss] = found.held_out_m
            if best is None or found.held_out_m < best.held_out_m:
                best = found
        assert best is not None
        best.save(target)
        for path in target.parent.glob(f"{target.stem}-*"):
            path.unlink()
        return {
            "held_out_m": scores,
            "loss": best.config.loss,
            "epochs": best.config.training.max_epochs,
        }

    return bench.store.get(f"posenet-{dataset.name}", settings, train, _CODE, [target])


def asked(bench: Bench, dataset: Dataset, label: str) -> dict[str, Any]:
    """The poses that PoseNet gives ("poses"), the true ones ("truths"), and medians as `summarize`
    names them."""
    done = trained(bench, dataset)
    sequence = queries_of(bench, dataset, label)

    def ask() -> dict[str, Any]:
        from topoloc_paper.posenet import PoseNet

        network = PoseNet.load(_network_path(bench, dataset))
        posed = [i for i, pose in enumerate(sequence.poses) if pose is not None]
        known = dataset.map_from_query_truth()
        truths = [known @ pose for pose in sequence.poses if pose is not None]
        found = network.localize([sequence[i].image for i in posed])
        return {
            "poses": [pose_to_json(pose) for pose in found],
            "truths": [pose_to_json(pose) for pose in truths],
        }

    settings = {"posenet": done.digest, "queries": sequence_digest(sequence)}
    rows = bench.store.get(
        f"posenet-answers-{dataset.name}-{label.replace(' ', '_')}", settings, ask, _CODE
    ).result
    pairs = [(pose_of(a), pose_of(b)) for a, b in zip(rows["poses"], rows["truths"], strict=True)]
    metres = [translation_error(a, b) for a, b in pairs]
    degrees = [float(np.rad2deg(rotation_error(a, b))) for a, b in pairs]
    return rows | {
        "num_queries": len(pairs),
        "num_localized": len(pairs),
        "median_translation_m": float(np.median(metres)),
        "median_rotation_deg": float(np.median(degrees)),
    }


def _network_path(bench: Bench, dataset: Dataset) -> Path:
    return bench.folder("models") / f"{dataset.name}-posenet.pth"


def _config(bench: Bench, loss: str, num_images: int) -> PoseNetConfig:
    from topoloc_paper.posenet import PoseNetConfig

    training = bench.config.training(bench.config.posenet_epochs, num_images)
    return PoseNetConfig(loss, picture=NetworkInputConfig(112, 84), training=training)  # pyright: ignore[reportArgumentType]
