"""cnn-nn is taught: nothing is trained but the whitening of a pretrained network's features."""

from __future__ import annotations

from topoloc.retrieval.cnn_nn import create_pooled_network
from topoloc.retrieval.coarse import CoarseModel
from topoloc.retrieval.network_images import BackboneName
from topoloc_training.classifier_config import CnnNnConfig
from topoloc_training.place_vectors import fit_vectors
from topoloc_training.training_set import Progress, TrainingSet
from topoloc_training.weights import Weights, describe, load_features


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
