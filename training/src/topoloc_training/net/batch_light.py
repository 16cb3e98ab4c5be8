"""Change the light of a batch of pictures on any device: `light.py` for many pictures at once.

Pictures are (b, 1, h, w) in [0, 1]. Each has a strength in [0, 1], which gives the chance and the
size of each change. All numbers come from the generator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor
from torch.nn import functional

Pictures = Float[Tensor, "b 1 h w"]
PerPicture = Float[Tensor, "b 1 1 1"]
_LAMPS = 3
_BLOCK = 8  # of JPEG


@dataclass(frozen=True)
class Draws:
    """Draw numbers for each picture of a batch, on the device of the generator."""

    generator: Generator
    count: int

    def uniform(self, low: float | Tensor, high: float | Tensor, each: int = 1) -> Tensor:
        """Return numbers (b, each, 1, 1)."""
        device = self.generator.device
        drawn = torch.rand(self.count, each, 1, 1, device=device, generator=self.generator)
        return low + (high - low) * drawn

    def normal(self, *shape: int) -> Tensor:
        """Return numbers (b, *shape) of mean 0 and deviation 1."""
        device = self.generator.device
        return torch.randn(self.count, *shape, device=device, generator=self.generator)

    def flags(self, chance: float | Tensor) -> Bool[Tensor, "b 1 1 1"]:
        """Return True with this chance."""
        return self.uniform(0.0, 1.0) < chance


def change_light(
    pictures: Pictures, strength: Float[Tensor, " b"], generator: Generator
) -> Pictures:
    """Return the pictures in another light, blurred, noisy and stored, as `light.changed` does."""
    draws, strength = Draws(generator, len(pictures)), strength[:, None, None, None]
    amount = 0.3 + 0.9 * strength * draws.uniform(0.0, 1.0)
    relit = pictures * torch.exp(amount * _smooth_fields(pictures, draws))
    result = torch.where(draws.flags(0.8 * strength), relit, pictures)
    result = torch.where(draws.flags(0.5 * strength), result * _shadows(result, draws), result)
    kind, is_on = draws.uniform(0.0, 1.0), draws.flags(0.7 * strength)
    for low, high, change in _WEATHERS:
        chosen = (is_on & (kind >= low) & (kind < high)).flatten()
        if bool(chosen.any()):
            some = Draws(generator, int(chosen.sum()))
            result = result.index_put((chosen,), change(result[chosen], some))
    blurred = _blurred(result, draws, strength)
    result = torch.where(draws.flags(0.3 + 0.3 * strength), blurred, result)
    result = _exposed(result, draws, strength)
    return torch.where(draws.flags(0.25 * strength), _compressed(result, draws), result)


def _smooth_fields(pictures: Pictures, draws: Draws) -> Pictures:
    """Return smooth noise of unit deviation, 3 or 6 cells along the width."""
    fields = [
        functional.interpolate(
            draws.normal(1, rows, columns), pictures.shape[2:], mode="bicubic", align_corners=False
        )
        for rows, columns in ((2, 3), (5, 6))
    ]
    return torch.where(draws.flags(0.5), *fields)


def _coordinates(pictures: Pictures) -> tuple[Float[Tensor, "1 1 h 1"], Float[Tensor, "1 1 1 w"]]:
    height, width = pictures.shape[2:]
    y = torch.arange(height, device=pictures.device, dtype=torch.float32)[None, None, :, None]
    return y / height, torch.arange(width, device=pictures.device)[None, None, None] / width


def _shadows(pictures: Pictures, draws: Draws) -> Pictures:
    """Return a factor that is another one inside of a triangle with soft edges."""
    y, x = _coordinates(pictures)
    inside = torch.ones_like(pictures)
    for _ in range(3):
        angle, offset = draws.uniform(0.0, 2 * math.pi), draws.uniform(-0.1, 0.5)
        away = (x - 0.5) * torch.cos(angle) + (y - 0.5) * torch.sin(angle) + offset
        inside = inside * torch.sigmoid(away * draws.uniform(30.0, 300.0))
    return torch.exp(inside * (-0.3 + 0.7 * draws.normal(1, 1, 1)))


def _night(pictures: Pictures, draws: Draws) -> Pictures:
    """Return little light, with lamps that shine into the picture, and vignetting."""
    y, x = _coordinates(pictures)
    ratio = pictures.shape[2] / pictures.shape[3]
    across = x - draws.uniform(-0.2, 1.2, _LAMPS)
    down = ratio * (y - draws.uniform(-0.3, 1.1, _LAMPS))
    distance = across**2 + down**2
    is_lit = draws.uniform(0.0, 1.0, _LAMPS) < 0.5
    lamps = draws.uniform(0.2, 1.2, _LAMPS) * torch.exp(
        -distance / draws.uniform(0.1, 0.6, _LAMPS) ** 2
    )
    shines = is_lit & (draws.uniform(0.0, 1.0, _LAMPS) < 0.6)
    glare = draws.uniform(0.2, 1.0, _LAMPS) * torch.exp(
        -distance / draws.uniform(0.01, 0.06, _LAMPS) ** 2
    )
    light = draws.uniform(0.03, 0.3) + (lamps * is_lit).sum(1, keepdim=True)
    light = light * (1 - draws.uniform(0.0, 0.9) * ((x - 0.5) ** 2 + (y - 0.5) ** 2))
    dark = pictures.clamp(min=1e-4) ** draws.uniform(1.0, 1.5) * light
    return dark + (glare * shines).sum(1, keepdim=True)


def _fog(pictures: Pictures, draws: Draws, thickest: float = 0.85) -> Pictures:
    """Return the pictures blended with one grey, most where they would be far away."""
    y = 2 * _coordinates(pictures)[0] - 1
    far = torch.exp(-(((y - draws.uniform(-0.5, 0.3)) / draws.uniform(0.4, 1.2)) ** 2))
    veil = draws.uniform(0.1, thickest) * far * (1 + 0.3 * _smooth_fields(pictures, draws))
    veil = veil.clamp(0.0, 0.9)
    return pictures * (1 - veil) + draws.uniform(0.3, 0.9) * veil


def _rain(pictures: Pictures, draws: Draws) -> Pictures:
    """Return the pictures with streaks, a veil and less contrast."""
    result = torch.where(draws.flags(0.7), _fog(pictures, draws, 0.4), pictures)
    count = draws.uniform(20.0, 200.0) / (pictures.shape[2] * pictures.shape[3])
    drops = (draws.normal(1, *pictures.shape[2:]).abs() > _two_sided(count)).float()
    length = draws.uniform(6.0, 30.0)
    down, across = _frequencies(pictures)
    streak = torch.sinc(length * (down + 0.25 * draws.normal(1, 1, 1) * across))
    streaks = _filtered(drops * length, streak * torch.exp(-2 * (0.7 * math.pi * across) ** 2))
    return result + streaks.clamp(min=0) * draws.uniform(0.05, 0.35)


def _two_sided(share: Tensor) -> Tensor:
    return math.sqrt(2.0) * torch.erfinv(1 - share)


def _wet(pictures: Pictures, draws: Draws) -> Pictures:
    """Return darker surfaces, whose contrast turns at the middle greys."""
    level, slope = draws.uniform(0.2, 0.7), draws.uniform(3.0, 8.0)
    return pictures * (0.45 + 0.55 * torch.sigmoid(slope * (pictures - level)))


_WEATHERS = ((0.0, 0.55, _night), (0.55, 0.75, _rain), (0.75, 0.9, _fog), (0.9, 1.0, _wet))
"""Each with its part of the chances."""


def _frequencies(pictures: Pictures) -> tuple[Tensor, Tensor]:
    height, width = pictures.shape[2:]
    down = torch.fft.fftfreq(height, device=pictures.device)[None, None, :, None]
    return down, torch.fft.rfftfreq(width, device=pictures.device)[None, None, None]


def _filtered(pictures: Pictures, transfer: Tensor) -> Pictures:
    spectrum = torch.fft.rfft2(pictures) * transfer
    return torch.fft.irfft2(spectrum, s=pictures.shape[2:])


def _blurred(pictures: Pictures, draws: Draws, strength: PerPicture) -> Pictures:
    """Return the pictures out of focus, or moved."""
    down, across = _frequencies(pictures)
    sigma, angle = draws.uniform(0.4, 1.6), draws.uniform(0.0, math.pi)
    length = draws.uniform(2.0, 8.0 + 6.0 * strength)
    focus = torch.exp(-2 * (math.pi * sigma) ** 2 * (down**2 + across**2))
    motion = torch.sinc(length * (torch.cos(angle) * across + torch.sin(angle) * down))
    transfer = torch.where(draws.flags(0.5), focus, motion)
    return _filtered(pictures, transfer).clamp(min=0.0)


def _exposed(pictures: Pictures, draws: Draws, strength: PerPicture) -> Pictures:
    """Return the pictures by a camera's exposure, noise, curve, clipping and eight bits."""
    light = pictures.clamp(min=1e-6) ** 2.2
    wanted = torch.exp(-1.9 + (0.2 + 0.5 * strength) * draws.normal(1, 1, 1))
    light = light * (wanted / (light.mean((2, 3), keepdim=True) + 1e-6)).clamp(0.05, 20.0)
    electrons = torch.exp(draws.uniform(torch.log(4000 / (1 + 60 * strength)), math.log(4000.0)))
    read = draws.uniform(1.0, 4.0) / electrons
    noise = draws.normal(1, *pictures.shape[2:])
    light = light + noise * torch.sqrt(light.clamp(max=1.0) / electrons + read**2)
    power = 1 / draws.uniform(2.2 - 0.6 * strength, 2.2 + 0.6 * strength)
    return torch.round(light.clamp(1e-6, 1.0) ** power * 255) / 255


def _compressed(pictures: Pictures, draws: Draws) -> Pictures:
    """Return the pictures after JPEG of low or middle quality: blocks of coarse frequencies."""
    k = torch.arange(_BLOCK, device=pictures.device, dtype=torch.float32)
    waves = torch.cos(math.pi / _BLOCK * (k[None] + 0.5) * k[:, None]) * math.sqrt(2 / _BLOCK)
    waves[0] /= math.sqrt(2.0)
    step = (8 + 6 * (k[:, None] + k)) / 255 * draws.uniform(0.2, 2.0)[..., None, None]
    rows, columns = (side // _BLOCK for side in pictures.shape[2:])
    blocks = pictures.reshape(len(pictures), rows, _BLOCK, columns, _BLOCK).transpose(2, 3)
    parts = waves @ blocks @ waves.T
    step = step.reshape(len(pictures), 1, 1, _BLOCK, _BLOCK)
    restored = waves.T @ (torch.round(parts / step) * step) @ waves
    return restored.transpose(2, 3).reshape(pictures.shape).clamp(0.0, 1.0)
