"""Define the layers of EfficientNet-lite0 (Tan & Le 2019, the variant without squeeze and
excitation), in PyTorch.

Batch normalisation is folded into the convolutions, as in inference. The weights are read in this
form.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import pad, relu6

NUM_CHANNELS = 1280
_STEM, _EXPANSION = 32, 6
# For each stage: blocks, kernel, stride of the first block, channels.
_STAGES = (
    (1, 3, 1, 16),
    (2, 3, 2, 24),
    (2, 5, 2, 40),
    (3, 3, 2, 80),
    (3, 5, 1, 112),
    (4, 5, 2, 192),
    (1, 3, 1, 320),
)
# The network's input is (RGB bytes - 127) / 128. Here images are normalised by ImageNet's mean and
# deviation.
_MEAN, _DEVIATION = 127.0, 128.0


def efficientnet_features(mean: tuple[float, ...], deviation: tuple[float, ...]) -> nn.Sequential:
    """Return the stem, 16 blocks and the last convolution. The input images are normalised by
    `mean` and `deviation` (RGB in [0, 1])."""
    layers: list[nn.Module] = [_Stem(mean, deviation)]
    num_channels = _STEM
    for num_blocks, kernel, stride, width in _STAGES:
        for number in range(num_blocks):
            layers.append(
                _Block(
                    num_channels,
                    width,
                    kernel,
                    stride if number == 0 else 1,
                    1 if len(layers) == 1 else _EXPANSION,
                )
            )
            num_channels = width
    return nn.Sequential(
        *layers, nn.Sequential(nn.Conv2d(num_channels, NUM_CHANNELS, 1), nn.ReLU6())
    )


class SameConv(nn.Conv2d):
    """Convolve with TensorFlow's padding: if the padding is odd, the larger half comes after."""

    def forward(self, input: Tensor) -> Tensor:
        """Return the convolution of the padded input."""
        sizes = zip(input.shape[-2:], self.kernel_size, self.stride, strict=True)
        missing = [
            max((-(-length // stride) - 1) * stride + kernel - length, 0)
            for length, kernel, stride in sizes
        ]
        rows, columns = missing
        return super().forward(
            pad(input, (columns // 2, columns - columns // 2, rows // 2, rows - rows // 2))
        )


class _Stem(nn.Module):
    def __init__(self, mean: tuple[float, ...], deviation: tuple[float, ...]) -> None:
        super().__init__()
        self.convolution = SameConv(3, _STEM, 3, stride=2)
        self._scale = [255.0 * value / _DEVIATION for value in deviation]
        self._shift = [(255.0 * value - _MEAN) / _DEVIATION for value in mean]

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
