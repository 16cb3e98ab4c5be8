"""Variation of training pictures: other light, other lens, something in the way, a slightly other
view; whole batches at once."""

from __future__ import annotations

import math

import torch
from torch import Generator, Tensor, nn

from topoloc_training.backbones import normalize_images
from topoloc_training.classifier_config import AugmentationConfig


def augment(pictures: Tensor, config: AugmentationConfig, generator: Generator) -> Tensor:
    """Bytes (n, h, w, 3), varied each in its own way: normalised images (n, 3, h, w) for a
    network."""
    images = pictures.permute(0, 3, 1, 2).float() / 255.0
    images = _moved(images, config, generator)
    images = _relit(images, config, generator)
    images = _blurred(images, config, generator)
    images = _occluded(images, config, generator)
    return normalize_images(images.permute(0, 2, 3, 1) * 255.0).contiguous(
        memory_format=torch.channels_last
    )


def _uniform(num: int, size: float, generator: Generator) -> Tensor:
    """(n, 1, 1, 1) numbers of [-size, size]."""
    return (2.0 * torch.rand(num, 1, 1, 1, generator=generator) - 1.0) * size


def _moved(images: Tensor, config: AugmentationConfig, generator: Generator) -> Tensor:
    """Cut at the sides and turned about the middle, in one resampling."""
    n, _, height, width = images.shape
    sides = torch.rand(n, 4, generator=generator) * config.crop  # left, right, top, bottom
    turn = (2.0 * torch.rand(n, generator=generator) - 1.0) * math.radians(config.rotation_deg)
    across, down = 1.0 - sides[:, 0] - sides[:, 1], 1.0 - sides[:, 2] - sides[:, 3]
    shift_x, shift_y = sides[:, 0] - sides[:, 1], sides[:, 2] - sides[:, 3]
    cos, sin, aspect = torch.cos(turn), torch.sin(turn), height / width
    rows = [
        torch.stack([cos * across, -sin * down * aspect, shift_x], 1),
        torch.stack([sin * across / aspect, cos * down, shift_y], 1),
    ]
    grid = nn.functional.affine_grid(torch.stack(rows, 1), list(images.shape), align_corners=False)
    return nn.functional.grid_sample(images, grid, padding_mode="border", align_corners=False)


def _relit(images: Tensor, config: AugmentationConfig, generator: Generator) -> Tensor:
    """Gamma, contrast about the mean, brightness, and a cast of each colour."""
    n = len(images)
    images = images.clamp(1e-4, 1.0) ** torch.exp(_uniform(n, config.gamma, generator))
    mean = images.mean(dim=(1, 2, 3), keepdim=True)
    images = mean + (images - mean) * torch.exp(_uniform(n, config.contrast, generator))
    cast = 1.0 + (2.0 * torch.rand(n, 3, 1, 1, generator=generator) - 1.0) * config.colour_cast
    return (images * cast * torch.exp(_uniform(n, config.brightness, generator))).clamp(0.0, 1.0)


def _blurred(images: Tensor, config: AugmentationConfig, generator: Generator) -> Tensor:
    """Some pictures, out of focus."""
    chosen = (torch.rand(len(images), generator=generator) < config.blur).nonzero().flatten()
    if len(chosen) == 0:
        return images
    soft = nn.functional.avg_pool2d(images[chosen], 3, stride=1, padding=1, count_include_pad=False)
    return images.index_copy(
        0, chosen, nn.functional.avg_pool2d(soft, 3, stride=1, padding=1, count_include_pad=False)
    )


def _occluded(images: Tensor, config: AugmentationConfig, generator: Generator) -> Tensor:
    """Some pictures, with a rectangle of one colour before them, of up to a third of each side."""
    n, _, height, width = images.shape
    hidden = (torch.rand(n, generator=generator) < config.occlusion).view(n, 1, 1, 1)
    centre, half = (
        torch.rand(n, 2, generator=generator),
        torch.rand(n, 2, generator=generator) / 6.0,
    )
    rows = torch.linspace(0.0, 1.0, height).view(1, 1, height, 1)
    columns = torch.linspace(0.0, 1.0, width).view(1, 1, 1, width)
    inside = ((rows - centre[:, 0].view(n, 1, 1, 1)).abs() < half[:, 0].view(n, 1, 1, 1)) & (
        (columns - centre[:, 1].view(n, 1, 1, 1)).abs() < half[:, 1].view(n, 1, 1, 1)
    )
    colour = torch.rand(n, 3, 1, 1, generator=generator)
    return torch.where(inside & hidden, colour, images)
