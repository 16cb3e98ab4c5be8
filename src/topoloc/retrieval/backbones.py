"""Define the backbone networks of the learned coarse localizers, in PyTorch.

They are VGG-11, VGG-16 (Simonyan & Zisserman 2014), SqueezeNet 1.1 (Iandola et al. 2016),
EfficientNet-lite0 (`efficientnet.py`), and a small network for training from scratch.

Layers of the first three have torchvision's names and order, so that torchvision's ImageNet weights
load unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from topoloc.retrieval.efficientnet import NUM_CHANNELS as EFFICIENTNET_CHANNELS
from topoloc.retrieval.efficientnet import efficientnet_features
from topoloc.retrieval.network_config import BackboneName

# Statistics of ImageNet, for the pretrained networks. The input is (RGB in [0, 1] - mean)
# / deviation.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_DEVIATION = (0.229, 0.224, 0.225)
NUM_IMAGENET_CLASSES = 1000
NUM_CHANNELS = 512
"""Channels of the last feature maps of VGG and SqueezeNet."""

_POOL = "M"
_VGG_LAYERS: dict[str, tuple[int | str, ...]] = {
    "vgg11": (64, _POOL, 128, _POOL, 256, 256, _POOL, 512, 512, _POOL, 512, 512, _POOL),
    "vgg16": (
        64,
        64,
        _POOL,
        128,
        128,
        _POOL,
        256,
        256,
        256,
        _POOL,
        512,
        512,
        512,
        _POOL,
        512,
        512,
        512,
        _POOL,
    ),
}
_COMPACT_LAYERS = (24, 48, 96, 128, 128)
VGG_GRID = 7
"""Rows and columns to which VGG's features are pooled before its classifier."""


class Backbone(nn.Module):
    """Hold a network in torchvision's layout: `features` (convolutions), then `classifier`.

    Without `num_outputs` (None) there is no classifier, which has nine tenths of VGG's weights.
    `depth` is the number of layers of `features` to keep. `num_channels` is that of the feature
    maps.
    """

    def __init__(
        self,
        name: BackboneName,
        num_outputs: int | None = NUM_IMAGENET_CLASSES,
        depth: int | None = None,
    ) -> None:
        super().__init__()
        self.name: BackboneName = name
        self.features = nn.Sequential(*list(_features(name))[:depth])
        self.num_channels = max(
            _num_channels(layer) for layer in self.features.children()
        )  # they never decrease
        self.classifier = None if num_outputs is None else _classifier(name, num_outputs)

    def forward(self, images: Tensor, first: int = 0) -> Tensor:
        """Return the outputs (n, num_outputs) of normalised images (n, 3, h, w), or feature maps
        (n, c, h', w') without a classifier.

        With `first`, `images` are the outputs of the layers of `features` before that one.
        """
        maps = self.features[first:](images)
        if self.classifier is None:
            return maps
        if not has_wide_classifier(self.name):
            return self.classifier(maps).flatten(1)
        return self.classifier(nn.functional.adaptive_avg_pool2d(maps, VGG_GRID).flatten(1))


def has_wide_classifier(name: BackboneName) -> bool:
    """Return whether the classifier uses the positions of features, like VGG's, and not their mean
    over the image."""
    return name in _VGG_LAYERS


def normalize_images(rgb_images: Tensor) -> Tensor:
    """Convert RGB bytes (n, h, w, 3) to the networks' input: float32 (n, 3, h, w), channels last in
    memory."""
    mean = torch.tensor(IMAGENET_MEAN, device=rgb_images.device) * 255.0
    deviation = torch.tensor(IMAGENET_DEVIATION, device=rgb_images.device) * 255.0
    return ((rgb_images - mean) / deviation).permute(0, 3, 1, 2)


class _Fire(nn.Module):
    """Implement SqueezeNet's module: many channels are reduced to few, then expanded by parallel
    1x1 and 3x3 convolutions."""

    def __init__(self, num_inputs: int, num_squeezed: int, num_expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(num_inputs, num_squeezed, 1)
        self.expand1x1 = nn.Conv2d(num_squeezed, num_expanded, 1)
        self.expand3x3 = nn.Conv2d(num_squeezed, num_expanded, 3, padding=1)

    def forward(self, maps: Tensor) -> Tensor:
        squeezed = torch.relu(self.squeeze(maps))
        return torch.cat(
            [torch.relu(self.expand1x1(squeezed)), torch.relu(self.expand3x3(squeezed))], dim=1
        )


def _num_channels(layer: nn.Module) -> int:
    if isinstance(layer, _Fire):
        return layer.expand1x1.out_channels + layer.expand3x3.out_channels
    if isinstance(layer, nn.Sequential):
        return max(_num_channels(part) for part in layer)
    return getattr(layer, "out_channels", 0)


def _features(name: BackboneName) -> nn.Sequential:
    if name == "compact":
        return _compact_features()
    if name == "efficientnet_lite0":
        return efficientnet_features(IMAGENET_MEAN, IMAGENET_DEVIATION)
    return _squeezenet_features() if name == "squeezenet1_1" else _vgg_features(_VGG_LAYERS[name])


def _compact_features() -> nn.Sequential:
    """Return five convolutions with batch normalisation, for fast training from scratch. Each but
    the last halves the image."""
    modules: list[nn.Module] = []
    num_channels = 3
    for number, width in enumerate(_COMPACT_LAYERS):
        stride = 1 if number + 1 == len(_COMPACT_LAYERS) else 2
        convolution = nn.Conv2d(num_channels, width, 3, stride=stride, padding=1, bias=False)
        modules += [convolution, nn.BatchNorm2d(width), nn.ReLU(True)]
        num_channels = width
    return nn.Sequential(*modules)


def _squeezenet_features() -> nn.Sequential:
    def pool() -> nn.MaxPool2d:
        return nn.MaxPool2d(3, stride=2, ceil_mode=True)

    fires = [
        _Fire(*sizes) for sizes in ((64, 16, 64), (128, 16, 64), (128, 32, 128), (256, 32, 128))
    ]
    last = [
        _Fire(*sizes) for sizes in ((256, 48, 192), (384, 48, 192), (384, 64, 256), (512, 64, 256))
    ]
    return nn.Sequential(
        nn.Conv2d(3, 64, 3, stride=2),
        nn.ReLU(True),
        pool(),
        *fires[:2],
        pool(),
        *fires[2:],
        pool(),
        *last,
    )


def _vgg_features(layers: Sequence[int | str]) -> nn.Sequential:
    modules: list[nn.Module] = []
    num_channels = 3
    for layer in layers:
        if isinstance(layer, int):
            modules += [nn.Conv2d(num_channels, layer, 3, padding=1), nn.ReLU(True)]
            num_channels = layer
        else:
            modules.append(nn.MaxPool2d(2, stride=2))
    return nn.Sequential(*modules)


def _classifier(name: BackboneName, num_outputs: int) -> nn.Sequential:
    if name == "squeezenet1_1":
        return nn.Sequential(
            nn.Dropout(0.5),
            nn.Conv2d(NUM_CHANNELS, num_outputs, 1),
            nn.ReLU(True),
            nn.AdaptiveAvgPool2d(1),
        )
    if name == "compact":
        return nn.Sequential(
            nn.Dropout(0.5), nn.Conv2d(_COMPACT_LAYERS[-1], num_outputs, 1), nn.AdaptiveAvgPool2d(1)
        )
    if name == "efficientnet_lite0":
        return nn.Sequential(
            nn.Dropout(0.2),
            nn.Conv2d(EFFICIENTNET_CHANNELS, num_outputs, 1),
            nn.AdaptiveAvgPool2d(1),
        )
    wide = 4096
    hidden = [
        nn.Linear(512 * VGG_GRID**2, wide),
        nn.ReLU(True),
        nn.Dropout(0.5),
        nn.Linear(wide, wide),
        nn.ReLU(True),
        nn.Dropout(0.5),
    ]
    return nn.Sequential(*hidden, nn.Linear(wide, num_outputs))
