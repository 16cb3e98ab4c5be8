"""vlad-nn: NetVLAD of a network's feature maps, whitened; the nodes of the nearest mapping images.

The paper's third classifier (section III-B). The vocabulary comes with the weights where these are a NetVLAD checkpoint, else
it is learnt from the map's own images, as NetVLAD begins its training; it can be tuned to the place by the triplet loss.
"""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from topoloc.places.backbones import Backbone, normalize_pictures
from topoloc.places.classifier_config import BackboneName, VladNnConfig
from topoloc.places.coarse import CoarseModel, setting
from topoloc.places.inference import BATCH_SIZE, rounded_to_half
from topoloc.places.netvlad import NetVlad, learn_words
from topoloc.places.training_set import Progress, RgbPictures, TrainingSet, decode_pictures, network_pictures
from topoloc.places.triplets import tune
from topoloc.places.vector_search import VectorSearch, fit_vectors
from topoloc.places.weights import Weights, describe, load_features

NAME = "vlad-nn"
# NetVLAD takes VGG's last convolution before its rectifier and pooling, as the public checkpoints do.
DEPTHS: dict[BackboneName, int | None] = {"squeezenet1_1": 11, "vgg11": 19, "vgg16": 29, "compact": None}


class VladNetwork(nn.Module):
    """A backbone with a NetVLAD layer."""

    def __init__(self, backbone: BackboneName, depth: int | None, num_clusters: int) -> None:
        super().__init__()
        self.backbone = Backbone(backbone, num_outputs=None, depth=depth)
        self.pool = NetVlad(num_clusters, self.backbone.num_channels)

    def forward(self, images: Tensor) -> Tensor:
        return self.pool(self.backbone(images))


def train(
    training_set: TrainingSet, backbone: BackboneName, weights: Weights | None, config: VladNnConfig, progress: Progress
) -> CoarseModel:
    """Learn the vocabulary if the weights bring none, tune the network if the configuration says so, learn the whitening.

    Raises:
        MapError: a mapping image is damaged.
        TrainingError: the tuning failed.
    """
    depth = config.depth if config.depth is not None else DEPTHS[backbone]
    network = VladNetwork(backbone, depth, config.num_clusters)
    if weights is not None:
        load_features(network.backbone, weights)
    images, shape = decode_pictures(training_set)
    pictures = network_pictures(images, shape, config.picture)
    if weights is not None and weights.netvlad is not None:
        conv, centroids = weights.netvlad["conv.weight"], weights.netvlad["centroids"]
    else:
        centroids, conv = learn_words(_sample_features(network.backbone, pictures, config, progress), config.num_clusters, config.seed)
    network.pool = NetVlad(*centroids.shape)
    network.pool.load_state_dict({"conv.weight": conv, "centroids": centroids})
    if config.tuning.num_epochs > 0:
        tune(network, pictures, training_set, config.tuning, progress)
    fitted = fit_vectors(NAME, rounded_to_half(network), training_set, config.picture, config.dimension, progress)
    facts = {"backbone": backbone, "weights": describe(weights), "config": asdict(config)}
    return fitted.model(facts | {"num_clusters": len(centroids), "trained": config.tuning.num_epochs > 0})


def open_model(model: CoarseModel) -> VectorSearch:
    """The localizer of what `train` made."""
    config = setting(model, "config", VladNnConfig)
    backbone, num_clusters = setting(model, "backbone", BackboneName), setting(model, "num_clusters", int)
    depth = config.depth if config.depth is not None else DEPTHS[backbone]
    return VectorSearch(model, VladNetwork(backbone, depth, min(num_clusters, 4096)), config.picture)


def _sample_features(backbone: Backbone, pictures: RgbPictures, config: VladNnConfig, progress: Progress) -> Float32[np.ndarray, "n c"]:
    """Unit features from all mapping images, a few of each."""
    rng = np.random.default_rng(config.seed)
    samples = []
    backbone.eval()
    with torch.inference_mode():
        for start in range(0, len(pictures), BATCH_SIZE):
            maps = backbone(normalize_pictures(torch.from_numpy(pictures[start : start + BATCH_SIZE])))
            for features in nn.functional.normalize(maps, dim=1).flatten(2).transpose(1, 2).numpy():
                chosen = rng.permutation(len(features))[: config.num_sampled_features]
                samples.append(features[np.sort(chosen)])
            progress(f"{NAME}: words", min(start + BATCH_SIZE, len(pictures)), len(pictures))
    return np.concatenate(samples)
