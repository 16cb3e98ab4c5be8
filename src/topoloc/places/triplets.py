"""Tuning a place vector to a place: the triplet loss of NetVLAD (Arandjelovic et al. 2016, Eq. 7).

For each image the most similar one of those taken nearby must be more similar than every image taken elsewhere; the hardest
of these are sought anew in every epoch.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor, nn

from topoloc.errors import TrainingError
from topoloc.places.backbones import normalize_pictures
from topoloc.places.classifier_config import TripletConfig
from topoloc.places.inference import BATCH_SIZE
from topoloc.places.training_set import Progress, RgbPictures, TrainingSet


def tune(network: nn.Module, pictures: RgbPictures, training_set: TrainingSet, config: TripletConfig, progress: Progress) -> list[float]:
    """Tune the layers of `network` that come last (see `TripletConfig.num_tuned`); the mean loss of each epoch.

    Raises:
        TrainingError: no image has both a neighbour and one elsewhere, or the loss is not finite.
    """
    near, far = _pairs(training_set, config)
    rows = np.flatnonzero(near.any(axis=1) & far.any(axis=1))
    if len(rows) == 0:
        raise TrainingError("no triplets to tune with: all images are of one spot, or each is alone")
    tuned = [parameter for layer in _last_layers(network, config.num_tuned) for parameter in layer.parameters()]
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
            negatives = np.argsort(-np.where(far[row], similar, -np.inf), kind="stable")[: min(config.num_negatives, int(far[row].sum()))]
            loss = _loss(network, pictures[[row, positive, *negatives]], config.margin)
            if not torch.isfinite(loss):
                raise TrainingError(f"the triplet loss is not finite in epoch {epoch + 1}: a lower learning rate may help")
            if loss.item() > 0.0:
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                optimizer.step()
            total += loss.item()
            progress(f"triplets, epoch {epoch + 1}", done + 1, len(rows))
        losses.append(total / len(rows))
    network.requires_grad_(False)
    return losses


def _loss(network: nn.Module, pictures: RgbPictures, margin: float) -> Tensor:
    """Of one image, one near it, and others from elsewhere, in this order."""
    vectors = network(normalize_pictures(torch.from_numpy(pictures)))
    squares = ((vectors[1:] - vectors[0]) ** 2).sum(dim=1)
    return torch.relu(margin + squares[0] - squares[1:]).sum()


def _pairs(training_set: TrainingSet, config: TripletConfig) -> tuple[Bool[np.ndarray, "n n"], Bool[np.ndarray, "n n"]]:
    """Which images were taken near which, and which elsewhere, by D_total of Eq. 1 between them."""
    distances = training_set.image_distances()
    near = distances <= config.near * training_set.d_thresh
    np.fill_diagonal(near, False)
    return near, distances > config.far * training_set.d_thresh


def _vectors(network: nn.Module, pictures: RgbPictures) -> Float32[np.ndarray, "n d"]:
    with torch.inference_mode():
        batches = [pictures[start : start + BATCH_SIZE] for start in range(0, len(pictures), BATCH_SIZE)]
        return np.concatenate([network(normalize_pictures(torch.from_numpy(batch))).numpy() for batch in batches])


def _last_layers(network: nn.Module, number: int) -> list[nn.Module]:
    """The pooling layer and the last `number` layers with weights before it."""
    features = [layer for layer in network.get_submodule("backbone.features").children() if any(True for _ in layer.parameters())]
    return [network.get_submodule("pool"), *features[len(features) - number :]]
