"""cnn-nn: features of a pretrained network, pooled in cells and whitened; the nodes of the nearest mapping images.

The paper's second classifier (section III-B). Features are pooled by the generalised mean of Radenovic et al. (2018), in a
few cells instead of one: neighbouring nodes see the same things, at other places of the picture.
"""

from __future__ import annotations

from torch import Tensor, nn

from topoloc.places.backbones import Backbone
from topoloc.places.classifier_config import BackboneName, CnnNnConfig
from topoloc.places.coarse import CoarseModel, setting
from topoloc.places.training_set import Progress, TrainingSet
from topoloc.places.vector_search import VectorSearch, fit_vectors
from topoloc.places.weights import Weights, describe, load_features

NAME = "cnn-nn"

# Deeper layers know more of things and less of places: the fifth and sixth of SqueezeNet's fire modules rank nodes best.
DEPTHS: dict[BackboneName, int | None] = {"squeezenet1_1": 11, "vgg11": None, "vgg16": None, "compact": None}


class PooledFeatures(nn.Module):
    """Feature maps pooled over a grid of cells by the generalised mean; unit vectors."""

    def __init__(self, backbone: BackboneName, depth: int | None, rows: int, columns: int, power: float) -> None:
        super().__init__()
        self.backbone = Backbone(backbone, num_outputs=None, depth=depth)
        self.rows, self.columns, self.power = rows, columns, power

    def forward(self, images: Tensor) -> Tensor:
        """(n, channels * rows * columns) of normalised images (n, 3, h, w)."""
        maps = self.backbone(images).float().clamp(min=1e-4)
        pooled = nn.functional.adaptive_avg_pool2d(maps**self.power, (self.rows, self.columns)) ** (1.0 / self.power)
        return nn.functional.normalize(pooled.flatten(1))


def train(
    training_set: TrainingSet, backbone: BackboneName, weights: Weights | None, config: CnnNnConfig, progress: Progress
) -> CoarseModel:
    """Nothing is trained but the whitening; without weights the features are those of a random network, which ranks far worse.

    Raises:
        MapError: a mapping image is damaged.
    """
    network = _network(backbone, config)
    if weights is not None:
        load_features(network.backbone, weights)
    return fit_vectors(NAME, network, training_set, config, {"backbone": backbone, "weights": describe(weights)}, progress)


def open_model(model: CoarseModel) -> VectorSearch:
    """The localizer of what `train` made."""
    config = setting(model, "config", CnnNnConfig)
    return VectorSearch(model, _network(setting(model, "backbone", BackboneName), config), config.picture)


def _network(backbone: BackboneName, config: CnnNnConfig) -> PooledFeatures:
    depth = config.depth if config.depth is not None else DEPTHS[backbone]
    return PooledFeatures(backbone, depth, config.grid_rows, config.grid_columns, config.power)
