"""EdgePoint2 (H. Yao et al., 2025, arXiv 2504.17280), written from its description; its weights are
MIT (HITCSC/EdgePoint2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from topoloc_training.networks.layers import ConvNormReLU, Residual, enlarged

STRIDE = 4
"""Pixels from one descriptor of the map to the next."""


@dataclass(frozen=True)
class Widths:
    """Channels of the stem, of the three levels, of a descriptor and of the score's head."""

    stem: int
    half: int
    eighth: int
    coarse: int
    descriptor: int
    score: int


SIZES = {
    "t32": Widths(8, 8, 16, 24, 32, 8),
    "s32": Widths(8, 8, 24, 32, 32, 8),
    "s64": Widths(8, 8, 24, 32, 64, 8),
    "m64": Widths(8, 16, 32, 48, 64, 8),
    "e64": Widths(16, 16, 48, 64, 64, 16),
}


class EdgePoint2(nn.Module):
    """Grey picture to scores and descriptors. Levels at 1/2, 1/8 and 1/32; attributes carry the
    published key names."""

    stride = STRIDE

    def __init__(self, size: str):
        super().__init__()
        widths = SIZES[size]
        channels = widths.half + widths.eighth + widths.coarse
        self.norm = nn.InstanceNorm2d(1)
        self.block1 = nn.Sequential(
            ConvNormReLU(1, widths.stem, 4, 2),
            ConvNormReLU(widths.stem, widths.half),
            Residual(widths.half, widths.half),
        )
        self.block2 = Residual(widths.half, widths.eighth)
        self.block3 = Residual(widths.eighth, widths.coarse)
        self.desc_head = nn.Sequential(
            nn.Conv2d(channels, channels, 1),
            ConvNormReLU(channels, channels, groups=channels // 16),
            nn.Conv2d(channels, widths.descriptor, 1),
        )
        self.conv1 = nn.Conv2d(widths.half, widths.score, 1)
        self.conv2 = nn.Conv2d(widths.eighth, widths.score, 1)
        self.conv3 = nn.Conv2d(widths.coarse, widths.score, 1)
        self.score_head = nn.Sequential(
            nn.Conv2d(widths.score, widths.score, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(widths.score, widths.score, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(widths.score, 4, 3, padding=1),
            nn.PixelShuffle(2),
        )

    def forward(
        self, image: Float[Tensor, "b 1 h w"]
    ) -> tuple[Float[Tensor, "b 1 h w"], Float[Tensor, "b d h4 w4"]]:
        half = self.block1(self.norm(image))
        quarter = functional.avg_pool2d(half, 2)
        eighth = self.block2(functional.avg_pool2d(quarter, 2))
        coarse = self.block3(functional.avg_pool2d(eighth, 4))
        descriptors = self.desc_head(
            torch.cat([quarter, enlarged(eighth, 2), enlarged(coarse, 8)], dim=1)
        )
        # A sum of 1x1 convolutions, enlarged in two steps: 16 times bilinear is not 4 times
        # bilinear twice, so each by itself.
        score = (
            self.conv1(half) + enlarged(self.conv2(eighth), 4) + enlarged(self.conv3(coarse), 16)
        )
        return torch.sigmoid(self.score_head(score)), descriptors
