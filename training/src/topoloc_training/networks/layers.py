"""Layers that the networks of local features share."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional


class ConvNormReLU(nn.Module):
    """A convolution without bias, batch norm, ReLU. `affine`: whether the norm has a scale and a
    shift of its own."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int = 3,
        stride: int = 1,
        padding: int = 1,
        groups: int = 1,
        affine: bool = True,
    ):
        super().__init__()
        convolution = nn.Conv2d(inputs, outputs, kernel, stride, padding, groups=groups, bias=False)
        self.layer = nn.Sequential(convolution, nn.BatchNorm2d(outputs, affine=affine), nn.ReLU())

    def forward(self, features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h2 w2"]:
        return self.layer(features)


class Residual(nn.Module):
    """Apply two 3x3 convolutions with batch norm beside the identity, or beside a 1x1 convolution
    if the number of channels changes."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.layer = nn.Sequential(
            nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(),
            nn.Conv2d(outputs, outputs, 3, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
        )
        self.skip = nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1)

    def forward(self, features: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h w"]:
        return functional.relu(self.layer(features) + self.skip(features))


def enlarged(features: Float[Tensor, "b c h w"], factor: int) -> Float[Tensor, "b c h2 w2"]:
    """Bilinearly, pixel centres at half numbers."""
    return functional.interpolate(
        features, scale_factor=factor, mode="bilinear", align_corners=False
    )
