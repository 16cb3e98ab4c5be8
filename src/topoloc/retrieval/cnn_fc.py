"""Rank nodes with a classification network that has one output per node, trained on the mapping
images: cnn-fc.

This is the paper's first classifier (section III-A): VGG-11 with its last layer replaced, or a
smaller backbone. Each image is labelled with its nearest node by Eq. 1 (position and heading).
Scores are probabilities, calibrated on images held out of the training.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from torch import Tensor, nn

from topoloc.errors import MapError
from topoloc.features.features import Features
from topoloc.node_ids import Row
from topoloc.retrieval.backbones import Backbone, has_wide_classifier
from topoloc.retrieval.coarse import CoarseModel, Image, NodeScore, model_array, read_setting
from topoloc.retrieval.inference import Predictor, load_network_weights
from topoloc.retrieval.network_images import (
    BackboneName,
    ClassifierNetworkConfig,
    ImageShape,
    prepare_network_images,
)

NAME = "cnn-fc"
MAX_OUTPUTS = 100_000
_SQUEEZED, _ROWS, _COLUMNS = 64, 4, 5


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


open_model = CnnFc


def _grid_pooling_head(num_channels: int, num_nodes: int) -> nn.Sequential:
    squeeze = nn.Conv2d(num_channels, _SQUEEZED, 1), nn.ReLU(True)
    pool = nn.AdaptiveAvgPool2d((_ROWS, _COLUMNS)), nn.Flatten()
    linear = nn.Linear(_SQUEEZED * _ROWS * _COLUMNS, num_nodes)
    return nn.Sequential(*squeeze, *pool, nn.Dropout(0.3), linear)
