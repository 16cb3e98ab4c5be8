"""Define the losses of the network: distance to the teacher's descriptors and scores, and contrast
of points across light.

Descriptors (b, n, c) are of unit length, one row a point.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

_TEMPERATURE = 0.06
_PEAK_WEIGHT = 30.0
_CELL = 8
_LEAST_PEAK = 0.05


def sampled(
    maps: Float[Tensor, "b c hs ws"], pixels: Float[Tensor, "b n 2"], stride: int
) -> Float[Tensor, "b n c"]:
    """Unit descriptors at pixels (x, y) of the picture, bilinearly."""
    size = pixels.new_tensor([maps.shape[3], maps.shape[2]]) * stride
    grid = (2 * pixels + 1) / size - 1
    values = functional.grid_sample(
        maps, grid[:, :, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return functional.normalize(values[..., 0].transpose(1, 2), dim=2)


def likeness(
    ours: Float[Tensor, "b n c"], theirs: Float[Tensor, "b n c"], valid: Bool[Tensor, "b n"]
) -> Float[Tensor, ""]:
    """One less the mean cosine."""
    return ((1 - (ours * theirs).sum(2)) * valid).sum() / valid.sum().clamp(min=1)


def told_apart(
    first: Float[Tensor, "b n c"],
    second: Float[Tensor, "b n c"],
    valid: Bool[Tensor, "b n"],
    near: Bool[Tensor, "b n n"],
) -> Float[Tensor, ""]:
    """InfoNCE both ways: a point of `first` must find its own row of `second` among the picture's
    others.

    `near`: pairs of points so close together that neither may count as the other's rival (never on
    the diagonal).
    """
    likes = first @ second.transpose(1, 2) / _TEMPERATURE
    likes = likes.masked_fill(near | ~(valid[:, :, None] & valid[:, None, :]), -1e4)
    diagonal = torch.diagonal(likes, dim1=1, dim2=2)
    lost = torch.logsumexp(likes, 2) + torch.logsumexp(likes, 1) - 2 * diagonal
    return (lost * valid).sum() / (2 * valid.sum().clamp(min=1))


def placed(
    logits: Float[Tensor, "b 1 h w"],
    target: Float[Tensor, "b 1 h w"],
    inside: Bool[Tensor, "b 1 h w"],
) -> Float[Tensor, ""]:
    """Return the cross entropy of a key point's pixel among the 64 of its 8x8 cell. Cells are
    weighted by their key point's score."""
    scores, best = functional.pixel_unshuffle(target, _CELL).max(dim=1)
    weight = (
        scores
        * (scores > _LEAST_PEAK)
        * (functional.pixel_unshuffle(inside.float(), _CELL).amin(dim=1) > 0)
    )
    lost = functional.cross_entropy(
        functional.pixel_unshuffle(logits, _CELL), best, reduction="none"
    )
    return (lost * weight).sum() / weight.sum().clamp(min=1)


def peaks(
    logits: Float[Tensor, "b 1 h w"],
    target: Float[Tensor, "b 1 h w"],
    inside: Bool[Tensor, "b 1 h w"],
) -> Float[Tensor, ""]:
    """Cross-entropy against the teacher's scores, key points weighted up as they are few."""
    lost = functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
    weight = (1 + _PEAK_WEIGHT * target) * inside
    return (lost * weight).sum() / weight.sum().clamp(min=1)
