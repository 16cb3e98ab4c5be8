"""cnn-fc is taught: each mapping image is labelled with its nearest node by Eq. 1 (position and
heading), or with those about as near."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Generator, Tensor, nn

from topoloc.errors import TrainingError
from topoloc.retrieval.cnn_fc import NAME, NodeClassifier
from topoloc.retrieval.coarse import CoarseModel
from topoloc.retrieval.inference import BATCH_SIZE, to_channels_last
from topoloc.retrieval.network_images import BackboneName, ImageShape, prepare_network_images
from topoloc_training.classifier_config import CnnFcConfig
from topoloc_training.frozen_maps import FrozenMaps, plain_maps
from topoloc_training.stored_weights import rounded_to_half, to_arrays
from topoloc_training.training import Task, Training, deterministic, fit, hold_out
from topoloc_training.training_set import Progress, TrainingSet, decode_pictures
from topoloc_training.weights import Weights, describe


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
