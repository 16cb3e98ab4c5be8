"""Define the network `topoloc-net`: from a grey image to key point scores and 64-number
descriptors, on two CPU cores.

The run time of such networks (ONNX Runtime, one thread) is mostly in the fine levels. With equal
multiplications, a 3x3 convolution of 8 channels at half resolution costs twice as much as one of 32
channels at an eighth. So half resolution has one strided convolution alone, and the depth is at 1/8
and 1/16. Descriptors get their fine detail from one 1x1 convolution at a quarter. Scores are
computed there from the output of half resolution, and unfolded.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from topoloc_training.networks.layers import ConvNormReLU, Residual, enlarged

KIND = "topoloc-net"
DIMENSION = 64
STRIDE = 4
_SCORE_WIDTH = 40
_SHADOWS = 0.002  # grey below this is noise; also keeps the root's slope finite


class TopolocNet(nn.Module):
    """Levels at 1/4 (16 channels), 1/8 (32), 1/16 (64) and 1/32 (64), added up from coarse to
    fine."""

    stride = STRIDE
    outputs = ("scores", "descriptors", "places")

    def __init__(self):
        super().__init__()
        self.norm = nn.InstanceNorm2d(1)
        self.quarter = nn.Sequential(
            ConvNormReLU(1, 16, 4, 2), ConvNormReLU(16, 16, 3, 2), ConvNormReLU(16, 16)
        )
        self.eighth = nn.Sequential(ConvNormReLU(16, 32, 3, 2), Residual(32, 32))
        self.sixteenth = nn.Sequential(ConvNormReLU(32, 64, 3, 2), Residual(64, 64))
        self.context = nn.Sequential(nn.AvgPool2d(2), ConvNormReLU(64, 64))
        self.lateral = nn.Conv2d(32, 64, 1)
        self.across = nn.Conv2d(64, 64, 1)
        self.fusion = ConvNormReLU(64, 64, groups=4)
        self.coarse_descriptor = nn.Conv2d(64, DIMENSION, 1)
        self.fine_descriptor = nn.Conv2d(16, DIMENSION, 1)
        self.detail_score = nn.Conv2d(16, _SCORE_WIDTH, 2, stride=2)
        self.fine_score = nn.Conv2d(16, _SCORE_WIDTH, 1)
        self.coarse_score = nn.Conv2d(64, _SCORE_WIDTH, 1)
        self.score = nn.Sequential(
            nn.BatchNorm2d(_SCORE_WIDTH),
            nn.ReLU(),
            ConvNormReLU(_SCORE_WIDTH, _SCORE_WIDTH, 1, padding=0),
            nn.Conv2d(_SCORE_WIDTH, 16, 1),
            nn.PixelShuffle(4),
        )

    def maps(self, image: Float[Tensor, "b 1 h w"]) -> tuple[Tensor, Tensor]:
        """Score logits and descriptors, as they are trained."""
        return self._maps(image)[:2]

    def _maps(
        self, image: Float[Tensor, "b 1 h w"]
    ) -> tuple[
        Float[Tensor, "b 1 h w"], Float[Tensor, "b 64 h4 w4"], Float[Tensor, "b 64 h16 w16"]
    ]:
        # The root evens out photon noise and keeps lamps from pressing a night picture into the
        # lowest greys.
        grey = self.norm(torch.sqrt(image + _SHADOWS))
        stem, *deeper = self.quarter
        half = stem(grey)
        quarter = half
        for layer in deeper:
            quarter = layer(quarter)
        eighth = self.eighth(quarter)
        places = self.sixteenth(eighth)
        sixteenth = places + enlarged(self.context(places), 2)
        fused = self.fusion(
            functional.relu(self.lateral(eighth) + enlarged(self.across(sixteenth), 2))
        )
        descriptors = enlarged(self.coarse_descriptor(fused), 2) + self.fine_descriptor(quarter)
        logits = self.score(
            enlarged(self.coarse_score(fused), 2)
            + self.fine_score(quarter)
            + self.detail_score(half)
        )
        return logits, descriptors, places

    def forward(self, image: Float[Tensor, "b 1 h w"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return scores, descriptors, and the level used for place recognition, which is the most
        stable one at night."""
        logits, descriptors, places = self._maps(image)
        return torch.sigmoid(logits), descriptors, places


def follow(average: nn.Module, network: nn.Module, kept: float) -> None:
    """Move the average toward the network."""
    with torch.no_grad():
        for old, new in zip(
            average.state_dict().values(), network.state_dict().values(), strict=True
        ):
            if old.dtype.is_floating_point:
                old.lerp_(new, 1 - kept)
            else:
                old.copy_(new)
