"""cnn-fc: a network whose output layer has one unit a node, trained on the mapping images.

The paper's first classifier (section III-A): VGG-11 with its last layer replaced, or a smaller backbone. Each image is labelled
with its nearest node by Eq. 1 (position and heading). Scores are probabilities, calibrated on images held out of the training.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from torch import Generator, Tensor, nn

from topoloc.errors import MapError, TrainingError
from topoloc.features.features import Features
from topoloc.places.augmentation import augment
from topoloc.places.backbones import Backbone, has_wide_classifier, normalize_pictures
from topoloc.places.classifier_config import BackboneName, CnnFcConfig, PictureConfig
from topoloc.places.coarse import CoarseModel, Image, NodeScore, model_array, setting
from topoloc.places.inference import BATCH_SIZE, Predictor, from_arrays, in_channels_last, rounded_to_half, to_arrays
from topoloc.places.training import Task, fit, hold_out
from topoloc.places.training_set import PictureShape, Progress, TrainingSet, decode_pictures, network_pictures
from topoloc.places.weights import Weights, describe

NAME = "cnn-fc"
MAX_OUTPUTS = 100_000
_SQUEEZED, _ROWS, _COLUMNS = 64, 4, 5


class NodeClassifier(nn.Module):
    """Images to one number a node. VGG keeps its classifier but for the last layer; the mean over the picture, which the
    small networks end with, forgets where things are in it: their features are squeezed and pooled in cells instead."""

    def __init__(self, backbone: BackboneName, num_nodes: int) -> None:
        super().__init__()
        wide = has_wide_classifier(backbone)
        self.backbone = Backbone(backbone, num_outputs=num_nodes if wide else None)
        self.head = nn.Identity() if wide else _cell_head(self.backbone.num_channels, num_nodes)

    def forward(self, images: Tensor) -> Tensor:
        return self.head(self.backbone(images))


def train(
    training_set: TrainingSet,
    backbone: BackboneName,
    weights: Weights | None,
    config: CnnFcConfig,
    progress: Progress,
    checkpoint: Path | None = None,
) -> CoarseModel:
    """Train on all mapping images but those held out.

    Raises:
        TrainingError: see `fit`.
        MapError: a mapping image is damaged.
    """
    if training_set.num_nodes < 1:
        raise TrainingError(f"{NAME}: the map has no nodes")
    torch.manual_seed(config.training.seed)
    network = NodeClassifier(backbone, training_set.num_nodes)
    in_channels_last(network)
    pretrained = [] if weights is None else _load(network, weights)
    images, shape = decode_pictures(training_set)
    pictures = torch.from_numpy(network_pictures(images, shape, config.picture))
    targets = torch.from_numpy(soft_labels(training_set, config.label_spread))
    held_out = hold_out(training_set.node_ids, config.training.held_out, config.training.seed)
    judged = np.flatnonzero(held_out) if held_out.any() else np.arange(len(held_out))

    def loss(rows: Tensor, generator: Generator) -> Tensor:
        outputs = network(augment(pictures[rows], config.augmentation, generator))
        return nn.functional.cross_entropy(outputs.float(), targets[rows])

    def score() -> float:
        return float(nn.functional.cross_entropy(_outputs(network, pictures[judged]), targets[judged]))

    rows = np.flatnonzero(~held_out)
    counts = np.bincount(training_set.node_ids[rows], minlength=training_set.num_nodes)
    balance = 1.0 / counts[training_set.node_ids[rows]]  # every node is shown as often as every other
    done = fit(Task(network, loss, score, rows, balance, pretrained, NAME), config.training, progress, checkpoint)
    rounded_to_half(network)
    labels = torch.from_numpy(training_set.node_ids[judged])
    temperature = calibrated_temperature(_outputs(network, pictures[judged]), labels) if held_out.any() else 1.0
    facts = {"backbone": backbone, "weights": describe(weights), "config": asdict(config), "picture_shape": [shape.width, shape.height]}
    trained = {
        "epochs": len(done.scores),
        "best_epoch": done.best_epoch,
        "stopped_by": done.stopped_by,
        "num_held_out": int(held_out.sum()),
    }
    settings = facts | {"trained": trained, "num_nodes": training_set.num_nodes, "temperature": temperature}
    return CoarseModel(NAME, settings, to_arrays(network))


class CnnFc:
    """The coarse localizer `cnn-fc`.

    Raises:
        MapError: the model's arrays do not belong together.
    """

    def __init__(self, model: CoarseModel) -> None:
        self._picture: PictureConfig = setting(model, "config", CnnFcConfig).picture
        self._shape = PictureShape(*setting(model, "picture_shape", tuple[int, int]))
        self._temperature, num_outputs = setting(model, "temperature", float), setting(model, "num_nodes", int)
        if not 0 < num_outputs <= MAX_OUTPUTS or self._temperature <= 0.0:
            raise MapError(f"the map's coarse localizer {NAME!r} is damaged: {num_outputs} outputs, temperature {self._temperature}")
        try:
            self._predict = Predictor(from_arrays(NodeClassifier(setting(model, "backbone", BackboneName), num_outputs), model.arrays))
        except (KeyError, RuntimeError, ValueError) as error:
            raise MapError(f"the map's coarse localizer {NAME!r} is damaged: {' '.join(str(error).split())[:200]}") from error
        # the node of each output, as its row in the map; -1 of nodes that are no more
        has_rows = "node_ids" in model.arrays
        self._rows = model_array(model, "node_ids", "iu", (num_outputs,)) if has_rows else np.arange(num_outputs)

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """See `CoarseLocalizer.rank`; scores are probabilities. The local features are not looked at."""
        return self.rank_batch([image], num_candidates)[0]

    def rank_batch(self, images: Sequence[Image], num_candidates: int) -> list[list[NodeScore]]:
        """`rank` of many images, which go through the network together."""
        ranked = []
        for row in self.probabilities(images):
            outputs = np.argsort(-row, kind="stable")
            outputs = outputs[self._rows[outputs] >= 0][:num_candidates]
            ranked.append([NodeScore(int(self._rows[output]), float(row[output])) for output in outputs])
        return ranked

    def probabilities(self, images: Sequence[Image]) -> Float32[np.ndarray, "n nodes"]:
        """Of each node, for each image."""
        outputs = self._predict(network_pictures(images, self._shape, self._picture)) / np.float32(self._temperature)
        powers = np.exp(outputs - outputs.max(axis=1, keepdims=True))
        return powers / powers.sum(axis=1, keepdims=True)


open_model = CnnFc


def soft_labels(training_set: TrainingSet, spread: float) -> Float32[np.ndarray, "n nodes"]:
    """The share of each node in each image: a bell curve of how much farther than the nearest it is; one node where `spread` is 0."""
    excess = training_set.node_distances - training_set.node_distances.min(axis=1, keepdims=True)
    if spread <= 0.0:
        shares = np.zeros_like(excess)
        shares[np.arange(len(shares)), training_set.node_ids] = 1.0
        return shares.astype(np.float32)
    shares = np.exp(-0.5 * (excess / (spread * training_set.d_thresh)) ** 2)
    return (shares / shares.sum(axis=1, keepdims=True)).astype(np.float32)


def calibrated_temperature(outputs: Tensor, labels: Tensor) -> float:
    """What to divide the outputs by, so that the labels are as likely as can be (Guo et al. 2017): golden section over its logarithm."""
    low, high, ratio = float(np.log(0.05)), float(np.log(20.0)), (5.0**0.5 - 1.0) / 2.0

    def cost(log_temperature: float) -> float:
        return float(nn.functional.cross_entropy(outputs / float(np.exp(log_temperature)), labels))

    for _ in range(40):
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        low, high = (low, b) if cost(a) < cost(b) else (a, high)
    return float(np.exp(0.5 * (low + high)))


def _outputs(network: nn.Module, pictures: Tensor) -> Tensor:
    network.eval()
    with torch.inference_mode():
        return torch.cat([network(normalize_pictures(batch)).float() for batch in pictures.split(BATCH_SIZE)])


def _cell_head(num_channels: int, num_nodes: int) -> nn.Sequential:
    squeeze = [nn.Conv2d(num_channels, _SQUEEZED, 1), nn.ReLU(True), nn.AdaptiveAvgPool2d((_ROWS, _COLUMNS)), nn.Flatten()]
    return nn.Sequential(*squeeze, nn.Dropout(0.3), nn.Linear(_SQUEEZED * _ROWS * _COLUMNS, num_nodes))


def _load(network: NodeClassifier, weights: Weights) -> list[nn.Parameter]:
    """Put in all weights that fit, which are all but the output layer's; the parameters that got one."""
    parameters = dict(network.backbone.named_parameters())
    fitting = {name: value for name, value in weights.tensors.items() if name in parameters and parameters[name].shape == value.shape}
    network.backbone.load_state_dict(fitting, strict=False)
    return [parameters[name] for name in fitting if "classifier.6" not in name]
