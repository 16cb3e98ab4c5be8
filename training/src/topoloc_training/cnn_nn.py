"""Rank nodes by the nearest mapping images under whitened features of a pretrained network, pooled
in cells: cnn-nn.

This is the paper's second classifier (section III-B). Features are pooled by the generalised mean
of Radenovic et al. (2018). Several cells are used instead of one, because neighbouring nodes see
the same objects at other image positions. Nothing is trained but the whitening.
"""

from __future__ import annotations

from torch import Tensor, nn

from topoloc.retrieval.coarse import CoarseModel
from topoloc_training.backbones import Backbone
from topoloc_training.classifier_config import BackboneName, CnnNnConfig, PooledNetworkConfig
from topoloc_training.place_vectors import NetworkDescriptorLocalizer, fit_vectors
from topoloc_training.stored_networks import read_setting
from topoloc_training.training_set import Progress, TrainingSet
from topoloc_training.weights import Weights, describe, load_features

# Deeper layers describe objects more and places less. The fifth and sixth of SqueezeNet's fire
# modules rank nodes best.
DEPTHS: dict[BackboneName, int | None] = {
    "squeezenet1_1": 11,
    "vgg11": None,
    "vgg16": None,
    "efficientnet_lite0": 11,
    "compact": None,
}


class PooledFeatures(nn.Module):
    """Pool feature maps over a grid of cells by the generalised mean, into unit vectors."""

    def __init__(
        self, backbone: BackboneName, depth: int | None, rows: int, columns: int, power: float
    ) -> None:
        super().__init__()
        self.backbone = Backbone(backbone, num_outputs=None, depth=depth)
        self.rows, self.columns, self.power = rows, columns, power

    def forward(self, images: Tensor) -> Tensor:
        """Return unit vectors (n, channels * rows * columns) of normalised images (n, 3, h, w)."""
        maps = self.backbone(images).float().clamp(min=1e-4)
        pooled = nn.functional.adaptive_avg_pool2d(maps**self.power, (self.rows, self.columns))
        return nn.functional.normalize((pooled ** (1.0 / self.power)).flatten(1))


def open_model(model: CoarseModel) -> NetworkDescriptorLocalizer:
    """Return the localizer of a stored model. Raises MapError and ConfigError."""
    config = read_setting(model, "config", PooledNetworkConfig)
    network = create_pooled_network(read_setting(model, "backbone", BackboneName), config)
    return NetworkDescriptorLocalizer(model, network, config.picture)


def create_pooled_network(backbone: BackboneName, config: PooledNetworkConfig) -> PooledFeatures:
    """Return the network with random weights."""
    depth = config.depth if config.depth is not None else DEPTHS[backbone]
    return PooledFeatures(backbone, depth, config.grid_rows, config.grid_columns, config.power)


def train(
    training_set: TrainingSet,
    backbone: BackboneName,
    weights: Weights | None,
    config: CnnNnConfig,
    progress: Progress,
) -> CoarseModel:
    """Nothing is trained but the whitening; without weights the features are those of a random
    network, which ranks far worse.

    Raises:
        MapError: a mapping image is damaged.
    """
    network = create_pooled_network(backbone, config)
    if weights is not None:
        load_features(network.backbone, weights)
    return fit_vectors(
        "cnn-nn",
        network,
        training_set,
        config,
        {"backbone": backbone, "weights": describe(weights)},
        progress,
    )
