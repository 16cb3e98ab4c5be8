"""Rank nodes with a classification network that has one output per node, trained on the mapping
images: cnn-fc.

This is the paper's first classifier (section III-A): VGG-11 with its last layer replaced, or a
smaller backbone. Each image is labelled with its nearest node by Eq. 1 (position and heading), or
with those about as near. Scores are probabilities, calibrated on images held out of the training.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int
from torch import Generator, Tensor, nn

from topoloc.errors import MapError, TrainingError
from topoloc.features.features import Features
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import Row
from topoloc.retrieval.coarse import CoarseModel, Image, NodeScore, model_array
from topoloc_training.backbones import Backbone, has_wide_classifier
from topoloc_training.classifier_config import BackboneName, ClassifierNetworkConfig, CnnFcConfig
from topoloc_training.frozen_maps import FrozenMaps, plain_maps
from topoloc_training.inference import BATCH_SIZE, Predictor, to_channels_last
from topoloc_training.network_images import ImageShape, prepare_network_images
from topoloc_training.stored_networks import (
    load_network_weights,
    read_setting,
    rounded_to_half,
    to_arrays,
)
from topoloc_training.training import Task, Training, deterministic, fit, hold_out
from topoloc_training.training_set import Progress, TrainingSet, decode_pictures
from topoloc_training.weights import MAP, Weights, describe

NAME = "cnn-fc"
MAX_OUTPUTS = 100_000
_SQUEEZED, _ROWS, _COLUMNS = 64, 4, 5
_OUTPUT_LAYERS = ("head.5.", "backbone.classifier.6.")


class NodeClassifier(nn.Module):
    """Map images to one score per node.

    VGG keeps its classifier except for the last layer. The small networks end with a mean over the
    image, which discards positions. Their features are reduced and pooled in cells instead.
    """

    def __init__(self, backbone: BackboneName, num_nodes: int) -> None:
        super().__init__()
        wide = has_wide_classifier(backbone)
        self.backbone = Backbone(backbone, num_outputs=num_nodes if wide else None)
        num_channels = self.backbone.num_channels
        self.head = nn.Identity() if wide else _grid_pooling_head(num_channels, num_nodes)

    def forward(self, images: Tensor, first: int = 0) -> Tensor:
        """Return one score per node. Arguments are those of `Backbone.forward`."""
        return self.head(self.backbone(images, first))


class CnnFc:
    """Implement the coarse localizer `cnn-fc`.

    Raises:
        MapError: the model's arrays are inconsistent.
    """

    def __init__(self, model: CoarseModel) -> None:
        self._input_config = read_setting(model, "config", ClassifierNetworkConfig).picture
        self._shape = ImageShape(*read_setting(model, "picture_shape", tuple[int, int]))
        self._temperature = read_setting(model, "temperature", float)
        num_outputs = read_setting(model, "num_nodes", int)
        damaged = f"the map's coarse localizer {NAME!r} is damaged:"
        if not 0 < num_outputs <= MAX_OUTPUTS or self._temperature <= 0.0:
            raise MapError(f"{damaged} {num_outputs} outputs, temperature {self._temperature}")
        try:
            network = NodeClassifier(read_setting(model, "backbone", BackboneName), num_outputs)
            self._predict = Predictor(load_network_weights(network, model.arrays))
        except (KeyError, RuntimeError, ValueError) as error:
            raise MapError(f"{damaged} {' '.join(str(error).split())[:200]}") from error
        # row in the map of each output's node, -1 for removed nodes
        self._rows = (
            model_array(model, "node_ids", "iu", (num_outputs,))
            if "node_ids" in model.arrays
            else np.arange(num_outputs)
        )

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """Rank nodes as in `CoarseLocalizer.rank`. Scores are probabilities. The local features are
        not used."""
        return self.rank_batch([image], num_candidates)[0]

    def rank_batch(self, images: Sequence[Image], num_candidates: int) -> list[list[NodeScore]]:
        """Rank nodes for many images, which pass through the network together."""
        ranked = []
        for row in self.probabilities(images):
            outputs = np.argsort(-row, kind="stable")
            outputs = outputs[self._rows[outputs] >= 0][:num_candidates]
            ranked.append([NodeScore(Row(int(self._rows[k])), float(row[k])) for k in outputs])
        return ranked

    def probabilities(self, images: Sequence[Image]) -> Float32[np.ndarray, "n nodes"]:
        """Return the probability of each output's node for each image."""
        rgb_images = prepare_network_images(images, self._shape, self._input_config)
        outputs = self._predict(rgb_images) / np.float32(self._temperature)
        powers = np.exp(outputs - outputs.max(axis=1, keepdims=True))
        return powers / powers.sum(axis=1, keepdims=True)


def _grid_pooling_head(num_channels: int, num_nodes: int) -> nn.Sequential:
    squeeze = nn.Conv2d(num_channels, _SQUEEZED, 1), nn.ReLU(True)
    pool = nn.AdaptiveAvgPool2d((_ROWS, _COLUMNS)), nn.Flatten()
    linear = nn.Linear(_SQUEEZED * _ROWS * _COLUMNS, num_nodes)
    return nn.Sequential(*squeeze, *pool, nn.Dropout(0.3), linear)


def train(
    training_set: TrainingSet,
    backbone: BackboneName,
    weights: Weights | None,
    config: CnnFcConfig,
    progress: Progress,
    checkpoint: Path | None = None,
) -> CoarseModel:
    """Train on all mapping images but those held out. Weights of the map's own cnn-fc are tuned for
    a few epochs.

    Raises:
        TrainingError: see `fit`.
        MapError: a mapping image is damaged.
    """
    if training_set.num_nodes < 1:
        raise TrainingError(f"{NAME}: the map has no nodes")
    if weights is not None and weights.num_outputs is not None:
        config = _for_tuning(config)
    torch.manual_seed(config.training.seed)
    network = NodeClassifier(backbone, training_set.num_nodes)
    to_channels_last(network)
    pretrained = [] if weights is None else _load(network, weights)
    trunk = _freeze(
        network, len(network.backbone.features) if weights is None else config.num_tuned
    )
    images, shape = decode_pictures(training_set)
    pictures = torch.from_numpy(prepare_network_images(images, shape, config.picture))
    targets = torch.from_numpy(soft_labels(training_set, config.label_spread))
    held_out = hold_out(training_set.node_ids, config.training.held_out, config.training.seed)
    rows, judged = (
        np.flatnonzero(~held_out),
        np.flatnonzero(held_out) if held_out.any() else np.arange(len(held_out)),
    )
    with deterministic(config.training):
        shown, plain = (
            FrozenMaps(trunk, pictures, rows, config, progress),
            plain_maps(trunk, pictures[judged]),
        )

    def loss(rows: Tensor, generator: Generator) -> Tensor:
        outputs = network(shown.drawn(rows, generator), len(trunk))
        return nn.functional.cross_entropy(outputs.float(), targets[rows])

    def score() -> float:
        return float(
            nn.functional.cross_entropy(_outputs(network, plain, len(trunk)), targets[judged])
        )

    counts = np.bincount(training_set.node_ids[rows], minlength=training_set.num_nodes)
    balance = (
        1.0 / counts[training_set.node_ids[rows]]
    )  # every node is shown as often as every other
    done = fit(
        Task(network, loss, score, rows, balance, pretrained, NAME),
        config.training,
        progress,
        checkpoint,
    )
    rounded_to_half(network)
    labels = torch.from_numpy(training_set.node_ids[judged])
    temperature = (
        calibrated_temperature(_outputs(network, plain, len(trunk)), labels)
        if held_out.any()
        else 1.0
    )
    start = _facts_of_start(backbone, weights, config, shape)
    trained = _facts_of(done) | {
        "num_held_out": int(held_out.sum()),
        "widened_from": None if weights is None else weights.num_outputs,
    }
    facts = {"num_nodes": training_set.num_nodes, "temperature": temperature}
    settings = start | {"trained": trained} | facts
    return CoarseModel(NAME, settings, to_arrays(network))


def _facts_of_start(
    backbone: BackboneName, weights: Weights | None, config: CnnFcConfig, shape: ImageShape
) -> dict[str, Any]:
    """Return the settings from which a training starts, as a map stores them."""
    return {
        "backbone": backbone,
        "weights": describe(weights),
        "config": asdict(config),
        "picture_shape": [shape.width, shape.height],
    }


def _facts_of(done: Training) -> dict[str, Any]:
    """Return the facts of a training that a map stores."""
    return {
        "epochs": len(done.scores),
        "best_epoch": done.best_epoch,
        "stopped_by": done.stopped_by,
    }


def soft_labels(training_set: TrainingSet, spread: float) -> Float32[np.ndarray, "n nodes"]:
    """Return the share of each node in each image: a Gaussian of its distance beyond the nearest
    node. If `spread` is 0, the nearest node has the whole share."""
    excess = training_set.node_distances - training_set.node_distances.min(axis=1, keepdims=True)
    if spread <= 0.0:
        shares = np.zeros_like(excess)
        shares[np.arange(len(shares)), training_set.node_ids] = 1.0
        return shares.astype(np.float32)
    shares = np.exp(-0.5 * (excess / (spread * training_set.d_thresh)) ** 2)
    return (shares / shares.sum(axis=1, keepdims=True)).astype(np.float32)


def calibrated_temperature(outputs: Tensor, labels: Tensor) -> float:
    """Return the temperature (divisor of the outputs) of maximum likelihood (Guo et al. 2017), by
    golden section search over its logarithm."""
    low, high, ratio = float(np.log(0.05)), float(np.log(20.0)), (5.0**0.5 - 1.0) / 2.0

    def cost(log_temperature: float) -> float:
        return float(nn.functional.cross_entropy(outputs / float(np.exp(log_temperature)), labels))

    for _ in range(40):
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        low, high = (low, b) if cost(a) < cost(b) else (a, high)
    return float(np.exp(0.5 * (low + high)))


def _outputs(network: NodeClassifier, maps: Tensor, num_frozen: int) -> Tensor:
    """Return the outputs for feature maps of the first `num_frozen` layers."""
    network.eval()
    with torch.inference_mode():
        return torch.cat(
            [network(batch.float(), num_frozen).float() for batch in maps.split(BATCH_SIZE)]
        )


def _freeze(network: NodeClassifier, num_tuned: int) -> nn.Sequential:
    """The layers of the backbone before the last `num_tuned` that have weights: they do not learn,
    and are as the map will keep them."""
    layers = list(network.backbone.features)
    learning = [
        len(layers),
        *(k for k in reversed(range(len(layers))) if any(True for _ in layers[k].parameters())),
    ]
    trunk = nn.Sequential(*layers[: learning[num_tuned] if num_tuned < len(learning) - 1 else 0])
    rounded_to_half(trunk.requires_grad_(False))
    return trunk


def _load(network: NodeClassifier, weights: Weights) -> list[nn.Parameter]:
    """Load all fitting weights. The output layer fits only if the weights are the map's own.

    Returns:
        The loaded parameters, without the ones that learn at the full rate.
    """
    parameters = {
        name.removeprefix("backbone."): value for name, value in network.named_parameters()
    }
    fitting = {
        name: value
        for name, value in weights.tensors.items()
        if name in parameters and parameters[name].shape == value.shape
    }
    with torch.no_grad():
        for name, value in fitting.items():
            parameters[name].copy_(value)
    return [parameters[name] for name in fitting if not name.startswith(("classifier.6", "head."))]


def _for_tuning(config: CnnFcConfig) -> CnnFcConfig:
    num_epochs = min(config.tuning_epochs, config.training.max_epochs)
    return replace(
        config,
        num_copies=min(config.num_copies, num_epochs),
        training=replace(config.training, max_epochs=num_epochs),
    )


def weights_of_map(topomap: TopoMetricMap, backbone: BackboneName) -> Weights:
    """Return the network of the map's cnn-fc with an output for each node of the map.

    A new node starts with the output of the known node nearest by Eq. 1, whose images are most
    similar.

    Raises:
        TrainingError: the map has no cnn-fc, or one with another backbone, or one without any
            node of the map.
        MapError: the cnn-fc is damaged.
    """
    model = topomap.first_layer.coarse_models.get(NAME)
    if model is None:
        raise TrainingError(
            f"the map has no {NAME} to begin with; train one without --weights {MAP}"
        )
    CnnFc(model)  # a damaged one is named
    if (its := model.settings["backbone"]) != backbone:
        raise TrainingError(
            f"the map's {NAME} stands on {its}, not on {backbone}; give --backbone {its}"
        )
    outputs = _output_of_each_node(
        topomap, np.asarray(model.arrays.get("node_ids", np.arange(model.settings["num_nodes"])))
    )
    tensors = {}
    for name, array in model.arrays.items():
        if name.startswith("network."):
            name = name.removeprefix("network.")
            values = torch.from_numpy(np.asarray(array, np.float32))
            tensors[name.removeprefix("backbone.")] = (
                values[torch.from_numpy(outputs)] if name.startswith(_OUTPUT_LAYERS) else values
            )
    origin = model.settings.get("weights") or {"file": "", "sha256": ""}
    return Weights(
        backbone,
        tensors,
        origin["file"],
        origin["sha256"],
        num_outputs=int(model.settings["num_nodes"]),
    )


def _output_of_each_node(
    topomap: TopoMetricMap, node_ids: Int[np.ndarray, " outputs"]
) -> Int[np.ndarray, " nodes"]:
    output_of = {int(node_id): output for output, node_id in enumerate(node_ids)}
    known = [row for row, summary in enumerate(topomap.summaries) if summary.node_id in output_of]
    if not known:
        raise TrainingError(
            f"the map's {NAME} knows none of its nodes; train one without --weights {MAP}"
        )
    poses = NodePoses.from_poses([topomap.summaries[row].world_from_cam for row in known])
    outputs = []
    for summary in topomap.summaries:
        nearest = known[
            int(node_distances(summary.world_from_cam, poses, topomap.config.lambda_rot).argmin())
        ]
        outputs.append(
            output_of.get(summary.node_id, output_of[topomap.summaries[nearest].node_id])
        )
    return np.array(outputs, np.int64)
