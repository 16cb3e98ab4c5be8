"""Rank nodes by the nearest mapping images under whitened NetVLAD of a network's feature maps:
vlad-nn.

This is the paper's third classifier (section III-B). If the weights are a NetVLAD checkpoint, the
vocabulary comes with them. Otherwise it is learned from the map's images, as in NetVLAD's
initialisation. It can be fine-tuned to the place with the triplet loss.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from topoloc.retrieval.backbones import Backbone
from topoloc.retrieval.coarse import CoarseModel, read_setting
from topoloc.retrieval.inference import NetworkDescriptorLocalizer
from topoloc.retrieval.network_images import BackboneName, VladNetworkConfig

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
