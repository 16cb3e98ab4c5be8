"""XFeat (G. Potje et al., CVPR 2024, arXiv 2404.19174), written from its description; its weights
are Apache-2.0 (verlab)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from topoloc_training.networks.layers import ConvNormReLU, enlarged

STRIDE = 8
"""Pixels from one descriptor of the map to the next; also the side of a cell of the key point
head."""

_LARGEST_LOGIT = 80.0

UNUSED = ("fine_matcher.",)
"""Keys of the published file that this network leaves out: the matcher of coarse matches."""


def _chain(*layers: tuple[int, int, int, int]) -> nn.Sequential:
    """Layers of (inputs, outputs, kernel, stride)."""
    return nn.Sequential(
        *(
            ConvNormReLU(i, o, kernel, stride, kernel // 2, affine=False)
            for i, o, kernel, stride in layers
        )
    )


def _bilinear_weights() -> Float[Tensor, "64 1 3 3"]:
    """Return the bilinear weights of the cell and its eight neighbours for each pixel of the cell,
    with centres at half numbers."""
    offset = (torch.arange(STRIDE) + 0.5) / STRIDE - 0.5
    along = torch.stack([(-offset).clamp(min=0), 1 - offset.abs(), offset.clamp(min=0)], dim=1)
    return torch.einsum("yi,xj->yxij", along, along).reshape(STRIDE * STRIDE, 1, 3, 3)


class XFeat(nn.Module):
    """Grey picture to scores and descriptors; attributes carry the published key names."""

    stride = STRIDE

    def __init__(self):
        super().__init__()
        self.norm = nn.InstanceNorm2d(1)
        self.skip1 = nn.Sequential(nn.AvgPool2d(4), nn.Conv2d(1, 24, 1))
        self.block1 = _chain((1, 4, 3, 1), (4, 8, 3, 2), (8, 8, 3, 1), (8, 24, 3, 2))
        self.block2 = _chain((24, 24, 3, 1), (24, 24, 3, 1))
        self.block3 = _chain((24, 64, 3, 2), (64, 64, 3, 1), (64, 64, 1, 1))
        self.block4 = _chain((64, 64, 3, 2), (64, 64, 3, 1), (64, 64, 3, 1))
        self.block5 = _chain((64, 128, 3, 2), (128, 128, 3, 1), (128, 128, 3, 1), (128, 64, 1, 1))
        self.block_fusion = nn.Sequential(
            *_chain((64, 64, 3, 1), (64, 64, 3, 1)), nn.Conv2d(64, 64, 1)
        )
        self.heatmap_head = nn.Sequential(
            *_chain((64, 64, 1, 1), (64, 64, 1, 1)), nn.Conv2d(64, 1, 1), nn.Sigmoid()
        )
        self.keypoint_head = nn.Sequential(
            *_chain((64, 64, 1, 1), (64, 64, 1, 1), (64, 64, 1, 1)), nn.Conv2d(64, 65, 1)
        )

    def maps(
        self, image: Float[Tensor, "b 1 h w"]
    ) -> tuple[
        Float[Tensor, "b 64 h8 w8"], Float[Tensor, "b 65 h8 w8"], Float[Tensor, "b 1 h8 w8"]
    ]:
        """Descriptors, key point logits (pixels of a cell row by row, then "none"), reliability."""
        grey = self.norm(image)
        eighth = self.block3(self.block2(self.block1(grey) + self.skip1(grey)))
        sixteenth = self.block4(eighth)
        coarse = self.block5(sixteenth)
        features = self.block_fusion(eighth + enlarged(sixteenth, 2) + enlarged(coarse, 4))
        # The head's first 1x1 convolution sees the 64 pixels of a cell as channels: one of 8x8
        # pixels and stride 8.
        first, *others = self.keypoint_head
        assert isinstance(first, ConvNormReLU)
        cells = functional.conv2d(
            grey,
            dict(first.named_parameters())["layer.0.weight"].view(64, 1, STRIDE, STRIDE),
            stride=STRIDE,
        )
        logits = nn.Sequential(*list(first.layer)[1:], *others)(cells)
        return features, logits, self.heatmap_head(features)

    def forward(
        self, image: Float[Tensor, "b 1 h w"]
    ) -> tuple[Float[Tensor, "b 1 h w"], Float[Tensor, "b 64 h8 w8"]]:
        features, logits, reliability = self.maps(image)
        # Softmax over the channels, written out: ONNX Runtime's own turns the whole map round
        # twice, at four times the cost. The logits of a trained network are far from float32's
        # limit (e^88); the bound keeps an
        # odd picture finite.
        shares = torch.exp(logits.clamp(max=_LARGEST_LOGIT))
        # Reliability is enlarged cell by cell, as channels: the same bilinear weights, without a
        # map of one channel at full size.
        around = functional.pad(reliability, (1, 1, 1, 1), mode="replicate")
        cells = shares[:, :64] * (
            functional.conv2d(around, _bilinear_weights()) / shares.sum(dim=1, keepdim=True)
        )
        return functional.pixel_shuffle(cells, STRIDE), features
