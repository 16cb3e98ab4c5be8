"""Generate random numbers by name, and smooth noise for textures."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
from jaxtyping import Float32


def rng_of(seed: int, name: str) -> np.random.Generator:
    """A generator of its own for each named part of a world: a change of one part leaves all others
    as they were."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def smooth_noise(
    rng: np.random.Generator, size: tuple[int, int], sigma_px: float
) -> Float32[np.ndarray, "h w"]:
    """Gaussian noise (height, width) of one grain size, mean 0, variance 1; it repeats without a
    seam."""
    coarse = sigma_px / _FINEST_GRAIN_PX
    smooth = (
        _blurred_noise(rng, size, sigma_px)
        if coarse < 2.0
        else _enlarged(_coarse_noise(rng, size, coarse), size)
    )
    return (smooth - smooth.mean()) / max(float(smooth.std()), 1e-6)


_FINEST_GRAIN_PX = 2.5
"""Grain that still has no steps when it is enlarged: coarser noise is drawn small, which is many
times faster than a wide filter."""


def _coarse_noise(
    rng: np.random.Generator, size: tuple[int, int], reduction: float
) -> Float32[np.ndarray, "h w"]:
    height, width = (max(4, round(side / reduction)) for side in size)
    return _blurred_noise(rng, (height, width), _FINEST_GRAIN_PX)


def _blurred_noise(
    rng: np.random.Generator, size: tuple[int, int], sigma_px: float
) -> Float32[np.ndarray, "h w"]:
    noise = rng.standard_normal(size).astype(np.float32)
    margin = min(int(3 * sigma_px) + 1, min(size))
    padded = np.pad(noise, margin, mode="wrap")
    return cv2.GaussianBlur(padded, (0, 0), sigma_px)[margin:-margin, margin:-margin]


def _enlarged(
    noise: Float32[np.ndarray, "h w"], size: tuple[int, int]
) -> Float32[np.ndarray, "h2 w2"]:
    """Cubic interpolation that goes on at the other side beyond an edge."""
    y, x = (
        np.arange(large, dtype=np.float32) * np.float32(small / large)
        for large, small in zip(size, noise.shape, strict=True)
    )
    columns, rows = np.meshgrid(x + 3.0, y + 3.0)
    return cv2.remap(np.pad(noise, 3, mode="wrap"), columns, rows, cv2.INTER_CUBIC).astype(
        np.float32, copy=False
    )


def fractal_noise(
    rng: np.random.Generator, size: tuple[int, int], coarsest_px: float | int, octaves: int = 5
) -> Float32[np.ndarray, "h w"]:
    """Noise of several grain sizes, each half as large and half as strong as the one before; mean
    0, variance 1."""
    total = np.zeros(size, np.float32)
    for octave in range(octaves):
        sigma = coarsest_px / 2**octave
        if sigma < 0.4:
            break
        total += smooth_noise(rng, size, sigma) / 2**octave
    return (total - total.mean()) / max(float(total.std()), 1e-6)
