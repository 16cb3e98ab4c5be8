"""The NetVLAD layer (Arandjelovic et al. 2016): VLAD with soft assignment, as a layer of a network.

Parameters carry the names of the public PyTorch implementation (`conv.weight`, `centroids`), whose checkpoints load as they are.
"""

from __future__ import annotations

import math

import faiss
import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

# The second nearest word's share in a feature, on average over the features that the words were learnt from.
SECOND_SHARE = 0.01


class NetVlad(nn.Module):
    """Feature maps (n, c, h, w) -> unit vectors (n, k * c): residuals from each word, summed, each word's sum normalised."""

    def __init__(self, num_clusters: int, num_channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(num_channels, num_clusters, 1, bias=False)
        self.centroids = nn.Parameter(torch.zeros(num_clusters, num_channels))

    def forward(self, maps: Tensor) -> Tensor:
        maps = nn.functional.normalize(maps.float(), dim=1)
        shares = torch.softmax(self.conv(maps.to(self.conv.weight.dtype)).float(), dim=1).flatten(2)
        sums = torch.bmm(shares, maps.flatten(2).transpose(1, 2)) - shares.sum(dim=2, keepdim=True) * self.centroids.float()
        return nn.functional.normalize(nn.functional.normalize(sums, dim=2).flatten(1))


def learn_words(features: Float32[np.ndarray, "n c"], num_clusters: int, seed: int) -> tuple[Tensor, Tensor]:
    """Centroids (k, c) and assignment weights (k, c, 1, 1) from unit features of the mapping images; fewer words where there are few.

    Weights are the unit centroids, scaled so that the second nearest word gets one hundredth of the nearest one's share on average.
    """
    num_clusters = max(1, min(num_clusters, len(features) // 40))
    kmeans = faiss.Kmeans(features.shape[1], num_clusters, niter=20, seed=seed + 1, min_points_per_centroid=1)
    kmeans.train(np.ascontiguousarray(features))
    assert kmeans.centroids is not None
    centroids = np.asarray(kmeans.centroids, np.float32).reshape(num_clusters, -1)
    directions = centroids / np.maximum(np.linalg.norm(centroids, axis=1, keepdims=True), 1e-6)
    cosines = np.sort(features @ directions.T, axis=1)
    lead = float(np.mean(cosines[:, -1] - cosines[:, -2])) if num_clusters > 1 else 1.0
    sharpness = -math.log(SECOND_SHARE) / max(lead, 1e-4)
    return torch.from_numpy(centroids), torch.from_numpy(sharpness * directions).reshape(*directions.shape, 1, 1)
