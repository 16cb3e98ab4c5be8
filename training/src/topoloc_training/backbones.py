"""Define the backbone networks of the learned coarse localizers, in PyTorch.

They are VGG-11, VGG-16 (Simonyan & Zisserman 2014), SqueezeNet 1.1 (Iandola et al. 2016),
EfficientNet-lite0, and a small network for training from scratch.

Layers of the first three have torchvision's names and order, so that torchvision's ImageNet weights
load unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import pad, relu6

from topoloc_training.classifier_config import BackboneName

# Statistics of ImageNet, for the pretrained networks. The input is (RGB in [0, 1] - mean)
# / deviation.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_DEVIATION = (0.229, 0.224, 0.225)
NUM_IMAGENET_CLASSES = 1000
NUM_CHANNELS = 512
"""Channels of the last feature maps of VGG and SqueezeNet."""

# Channels of the convolutions. 0 is a pooling.
_VGG_LAYERS = {
    "vgg11": (64, 0, 128, 0, 256, 256, 0, 512, 512, 0, 512, 512, 0),
    "vgg16": (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512, 0),
}
_COMPACT_LAYERS = (24, 48, 96, 128, 128)
VGG_GRID = 7
"""Rows and columns to which VGG's features are pooled before its classifier."""
# EfficientNet-lite0: channels of the last feature maps and of the first ones.
_EFFICIENTNET_CHANNELS = 1280
_STEM, _EXPANSION = 32, 6
# For each stage: blocks, kernel, stride of the first block, channels.
_STAGES = (
    *((1, 3, 1, 16), (2, 3, 2, 24), (2, 5, 2, 40), (3, 3, 2, 80)),
    *((3, 5, 1, 112), (4, 5, 2, 192), (1, 3, 1, 320)),
)
# The network's input is (RGB bytes - 127) / 128. Here images are normalised by ImageNet's mean and
# deviation.
_MEAN, _DEVIATION = 127.0, 128.0


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
        # They never decrease.
        self.num_channels = max(_num_channels(layer) for layer in self.features.children())
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
        expanded = [torch.relu(self.expand1x1(squeezed)), torch.relu(self.expand3x3(squeezed))]
        return torch.cat(expanded, dim=1)


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
        return _efficientnet_features()
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
    modules: list[nn.Module] = [nn.Conv2d(3, 64, 3, stride=2), nn.ReLU(True)]
    for pooled in (
        ((64, 16, 64), (128, 16, 64)),
        ((128, 32, 128), (256, 32, 128)),
        ((256, 48, 192), (384, 48, 192), (384, 64, 256), (512, 64, 256)),
    ):
        modules += [nn.MaxPool2d(3, stride=2, ceil_mode=True), *(_Fire(*sizes) for sizes in pooled)]
    return nn.Sequential(*modules)


def _vgg_features(layers: Sequence[int]) -> nn.Sequential:
    modules: list[nn.Module] = []
    num_channels = 3
    for layer in layers:
        if layer > 0:
            modules += [nn.Conv2d(num_channels, layer, 3, padding=1), nn.ReLU(True)]
            num_channels = layer
        else:
            modules.append(nn.MaxPool2d(2, stride=2))
    return nn.Sequential(*modules)


def _classifier(name: BackboneName, num_outputs: int) -> nn.Sequential:
    mean = nn.AdaptiveAvgPool2d(1)
    if name == "squeezenet1_1":
        convolution = nn.Conv2d(NUM_CHANNELS, num_outputs, 1)
        return nn.Sequential(nn.Dropout(0.5), convolution, nn.ReLU(True), mean)
    if name == "compact":
        return nn.Sequential(nn.Dropout(0.5), nn.Conv2d(_COMPACT_LAYERS[-1], num_outputs, 1), mean)
    if name == "efficientnet_lite0":
        convolution = nn.Conv2d(_EFFICIENTNET_CHANNELS, num_outputs, 1)
        return nn.Sequential(nn.Dropout(0.2), convolution, mean)
    wide = 4096
    first = [nn.Linear(512 * VGG_GRID**2, wide), nn.ReLU(True), nn.Dropout(0.5)]
    second = [nn.Linear(wide, wide), nn.ReLU(True), nn.Dropout(0.5)]
    return nn.Sequential(*first, *second, nn.Linear(wide, num_outputs))


def _efficientnet_features() -> nn.Sequential:
    """Return the stem, 16 blocks and the last convolution of EfficientNet-lite0 (Tan & Le 2019, the
    variant without squeeze and excitation).

    Batch normalisation is folded into the convolutions, as in inference. The weights are read in
    this form.
    """
    layers: list[nn.Module] = [_Stem()]
    num_channels = _STEM
    for num_blocks, kernel, stride, width in _STAGES:
        for number in range(num_blocks):
            expansion = 1 if len(layers) == 1 else _EXPANSION
            own_stride = stride if number == 0 else 1
            layers.append(_Block(num_channels, width, kernel, own_stride, expansion))
            num_channels = width
    last = nn.Sequential(nn.Conv2d(num_channels, _EFFICIENTNET_CHANNELS, 1), nn.ReLU6())
    return nn.Sequential(*layers, last)


class SameConv(nn.Conv2d):
    """Convolve with TensorFlow's padding: if the padding is odd, the larger half comes after."""

    def forward(self, input: Tensor) -> Tensor:
        """Return the convolution of the padded input."""
        sizes = zip(input.shape[-2:], self.kernel_size, self.stride, strict=True)
        rows, columns = (
            max((-(-length // stride) - 1) * stride + kernel - length, 0)
            for length, kernel, stride in sizes
        )
        sides = columns // 2, columns - columns // 2, rows // 2, rows - rows // 2
        return super().forward(pad(input, sides))


class _Stem(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.convolution = SameConv(3, _STEM, 3, stride=2)
        self._scale = [255.0 * value / _DEVIATION for value in IMAGENET_DEVIATION]
        self._shift = [(255.0 * value - _MEAN) / _DEVIATION for value in IMAGENET_MEAN]

    def forward(self, images: Tensor) -> Tensor:
        scale, shift = (
            torch.tensor(values, dtype=images.dtype, device=images.device)[:, None, None]
            for values in (self._scale, self._shift)
        )
        return relu6(self.convolution(images * scale + shift))


class _Block(nn.Module):
    """Expand the channels, filter each one separately, and project them. The input is added if it
    has the shape of the output."""

    def __init__(
        self, num_inputs: int, num_outputs: int, kernel: int, stride: int, expansion: int
    ) -> None:
        super().__init__()
        width = expansion * num_inputs
        self.expand = None if expansion == 1 else nn.Conv2d(num_inputs, width, 1)
        self.depthwise = SameConv(width, width, kernel, stride=stride, groups=width)
        self.project = nn.Conv2d(width, num_outputs, 1)
        self.out_channels, self._has_skip = num_outputs, stride == 1 and num_inputs == num_outputs

    def forward(self, maps: Tensor) -> Tensor:
        spread = maps if self.expand is None else relu6(self.expand(maps))
        drawn = self.project(relu6(self.depthwise(spread)))
        return maps + drawn if self._has_skip else drawn
