"""Rank nodes by the nearest mapping images under whitened NetVLAD of a network's feature maps:
vlad-nn.

This is the paper's third classifier (section III-B). If the weights are a NetVLAD checkpoint, the
vocabulary comes with them. Otherwise it is learned from the map's images, as in NetVLAD's
initialisation. It can be fine-tuned to the place with the triplet loss.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor, nn

from topoloc.errors import TrainingError
from topoloc.retrieval.coarse import CoarseModel
from topoloc.retrieval.descriptor_index import learn_visual_words
from topoloc_training.backbones import Backbone, normalize_images
from topoloc_training.classifier_config import (
    BackboneName,
    TripletConfig,
    VladNetworkConfig,
    VladNnConfig,
)
from topoloc_training.inference import BATCH_SIZE
from topoloc_training.network_images import RgbImages, prepare_network_images
from topoloc_training.place_vectors import NetworkDescriptorLocalizer, fit_vectors
from topoloc_training.stored_networks import read_setting, rounded_to_half
from topoloc_training.training_set import Progress, TrainingSet, decode_pictures
from topoloc_training.weights import Weights, describe, load_features

NAME = "vlad-nn"
# The second nearest word's share in a feature, on average over the features that the words were
# learnt from.
SECOND_SHARE = 0.01
# NetVLAD uses VGG's last convolution before its rectifier and pooling, like the public checkpoints.
DEPTHS: dict[BackboneName, int | None] = {
    "squeezenet1_1": 11,
    "vgg11": 19,
    "vgg16": 29,
    "efficientnet_lite0": 11,
    "compact": None,
}


class NetVlad(nn.Module):
    """Map feature maps (n, c, h, w) to unit vectors (n, k * c): residuals from each word, summed,
    and each word's sum normalised.

    VLAD with soft assignment (Arandjelovic et al. 2016). Parameters have the names of the public
    PyTorch implementation, so that its checkpoints load unchanged.
    """

    def __init__(self, num_clusters: int, num_channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(num_channels, num_clusters, 1, bias=False)
        self.centroids = nn.Parameter(torch.zeros(num_clusters, num_channels))

    def forward(self, maps: Tensor) -> Tensor:
        """Return the unit vectors of feature maps."""
        maps = nn.functional.normalize(maps.float(), dim=1)
        shares = torch.softmax(self.conv(maps.to(self.conv.weight.dtype)).float(), dim=1).flatten(2)
        sums = torch.bmm(shares, maps.flatten(2).transpose(1, 2))
        sums = sums - shares.sum(dim=2, keepdim=True) * self.centroids.float()
        return nn.functional.normalize(nn.functional.normalize(sums, dim=2).flatten(1))


class VladNetwork(nn.Module):
    """Combine a backbone with a NetVLAD layer."""

    def __init__(self, backbone: BackboneName, depth: int | None, num_clusters: int) -> None:
        super().__init__()
        self.backbone = Backbone(backbone, num_outputs=None, depth=depth)
        self.pool = NetVlad(num_clusters, self.backbone.num_channels)

    def forward(self, images: Tensor) -> Tensor:
        """Return the unit vectors of normalised images (n, 3, h, w)."""
        return self.pool(self.backbone(images))


def open_model(model: CoarseModel) -> NetworkDescriptorLocalizer:
    """Return the localizer of a stored model. Raises MapError and ConfigError."""
    config = read_setting(model, "config", VladNetworkConfig)
    backbone = read_setting(model, "backbone", BackboneName)
    num_clusters = min(read_setting(model, "num_clusters", int), 4096)
    depth = config.depth if config.depth is not None else DEPTHS[backbone]
    network = VladNetwork(backbone, depth, num_clusters)
    return NetworkDescriptorLocalizer(model, network, config.picture)


def train(
    training_set: TrainingSet,
    backbone: BackboneName,
    weights: Weights | None,
    config: VladNnConfig,
    progress: Progress,
) -> CoarseModel:
    """Learn the vocabulary if the weights have none, tune the network if configured, learn the
    whitening.

    Raises:
        MapError: a mapping image is damaged.
        TrainingError: the tuning failed.
    """
    depth = config.depth if config.depth is not None else DEPTHS[backbone]
    network = VladNetwork(backbone, depth, config.num_clusters)
    if weights is not None:
        load_features(network.backbone, weights)
    images, shape = decode_pictures(training_set)
    pictures = prepare_network_images(images, shape, config.picture)
    if weights is not None and weights.netvlad is not None:
        conv, centroids = weights.netvlad["conv.weight"], weights.netvlad["centroids"]
    else:
        centroids, conv = learn_words(
            _sample_features(network.backbone, pictures, config, progress),
            config.num_clusters,
            config.seed,
        )
    network.pool = NetVlad(*centroids.shape)
    network.pool.load_state_dict({"conv.weight": conv, "centroids": centroids})
    if config.tuning.num_epochs > 0:
        tune(network, pictures, training_set, config.tuning, progress)
    facts = {
        "backbone": backbone,
        "weights": describe(weights),
        "num_clusters": len(centroids),
        "trained": config.tuning.num_epochs > 0,
    }
    return fit_vectors(NAME, rounded_to_half(network), training_set, config, facts, progress)


def learn_words(
    features: Float32[np.ndarray, "n c"], num_clusters: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Return centroids (k, c) and assignment weights (k, c, 1, 1) from unit features of the mapping
    images, with fewer words for few features.

    Weights are the unit centroids, scaled so that the second nearest word gets one hundredth of the
    nearest one's share on average.
    """
    centroids = learn_visual_words(features, num_clusters, seed)
    directions = centroids / np.maximum(np.linalg.norm(centroids, axis=1, keepdims=True), 1e-6)
    cosines = np.sort(features @ directions.T, axis=1)
    lead = float(np.mean(cosines[:, -1] - cosines[:, -2])) if len(centroids) > 1 else 1.0
    sharpness = -math.log(SECOND_SHARE) / max(lead, 1e-4)
    return torch.from_numpy(centroids), torch.from_numpy(sharpness * directions).reshape(
        *directions.shape, 1, 1
    )


def _sample_features(
    backbone: Backbone, pictures: RgbImages, config: VladNnConfig, progress: Progress
) -> Float32[np.ndarray, "n c"]:
    """Unit features from all mapping images, a few of each."""
    rng = np.random.default_rng(config.seed)
    samples = []
    backbone.eval()
    with torch.inference_mode():
        for start in range(0, len(pictures), BATCH_SIZE):
            maps = backbone(
                normalize_images(torch.from_numpy(pictures[start : start + BATCH_SIZE]))
            )
            for features in nn.functional.normalize(maps, dim=1).flatten(2).transpose(1, 2).numpy():
                chosen = rng.permutation(len(features))[: config.num_sampled_features]
                samples.append(features[np.sort(chosen)])
            progress(f"{NAME}: words", min(start + BATCH_SIZE, len(pictures)), len(pictures))
    return np.concatenate(samples)


def tune(
    network: nn.Module,
    pictures: RgbImages,
    training_set: TrainingSet,
    config: TripletConfig,
    progress: Progress,
) -> list[float]:
    """Tune the layers of `network` that come last (see `TripletConfig.num_tuned`); the mean loss of
    each epoch.

    The triplet loss of NetVLAD (Eq. 7): for each image the most similar one of those taken nearby
    must be more similar than every image taken elsewhere; the hardest of these are sought anew in
    every epoch.

    Raises:
        TrainingError: no image has both a neighbour and one elsewhere, or the loss is not finite.
    """
    near, far = _pairs(training_set, config)
    rows = np.flatnonzero(near.any(axis=1) & far.any(axis=1))
    if len(rows) == 0:
        raise TrainingError(
            "no triplets to tune with: all images are of one spot, or each is alone"
        )
    tuned = [
        parameter
        for layer in _last_layers(network, config.num_tuned)
        for parameter in layer.parameters()
    ]
    optimizer = torch.optim.AdamW(tuned, lr=config.learning_rate, weight_decay=1e-3)
    rng = np.random.default_rng(config.seed)
    network.requires_grad_(False)
    for parameter in tuned:
        parameter.requires_grad_(True)
    losses = []
    for epoch in range(config.num_epochs):
        vectors = _vectors(network, pictures)
        total = 0.0
        for done, row in enumerate(rng.permutation(rows)):
            similar = vectors @ vectors[row]
            positive = int(np.argmax(np.where(near[row], similar, -np.inf)))
            negatives = np.argsort(-np.where(far[row], similar, -np.inf), kind="stable")[
                : min(config.num_negatives, int(far[row].sum()))
            ]
            loss = _loss(network, pictures[[row, positive, *negatives]], config.margin)
            if not torch.isfinite(loss):
                raise TrainingError(
                    f"the triplet loss is not finite in epoch {epoch + 1}: a lower learning rate"
                    " may help"
                )
            if loss.item() > 0.0:
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                optimizer.step()
            total += loss.item()
            progress(f"triplets, epoch {epoch + 1}", done + 1, len(rows))
        losses.append(total / len(rows))
    network.requires_grad_(False)
    return losses


def _loss(network: nn.Module, pictures: RgbImages, margin: float) -> Tensor:
    """Of one image, one near it, and others from elsewhere, in this order."""
    vectors = network(normalize_images(torch.from_numpy(pictures)))
    squares = ((vectors[1:] - vectors[0]) ** 2).sum(dim=1)
    return torch.relu(margin + squares[0] - squares[1:]).sum()


def _pairs(
    training_set: TrainingSet, config: TripletConfig
) -> tuple[Bool[np.ndarray, "n n"], Bool[np.ndarray, "n n"]]:
    """Which images were taken near which, and which elsewhere, by D_total of Eq. 1 between them."""
    distances = training_set.image_distances()
    near = distances <= config.near * training_set.d_thresh
    np.fill_diagonal(near, False)
    return near, distances > config.far * training_set.d_thresh


def _vectors(network: nn.Module, pictures: RgbImages) -> Float32[np.ndarray, "n d"]:
    with torch.inference_mode():
        batches = [
            pictures[start : start + BATCH_SIZE] for start in range(0, len(pictures), BATCH_SIZE)
        ]
        return np.concatenate(
            [network(normalize_images(torch.from_numpy(batch))).numpy() for batch in batches]
        )


def _last_layers(network: nn.Module, number: int) -> list[nn.Module]:
    """The pooling layer and the last `number` layers with weights before it."""
    features = [
        layer
        for layer in network.get_submodule("backbone.features").children()
        if any(True for _ in layer.parameters())
    ]
    return [network.get_submodule("pool"), *features[len(features) - number :]]
