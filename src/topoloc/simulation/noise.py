"""Random numbers by name, and smooth noise: what textures are made of."""

from __future__ import annotations

import zlib

import cv2
import numpy as np
from jaxtyping import Float32


def rng_of(seed: int, name: str) -> np.random.Generator:
    """A generator of its own for each named part of a world: a change of one part leaves all others as they were."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def smooth_noise(rng: np.random.Generator, size: tuple[int, int], sigma_px: float) -> Float32[np.ndarray, "h w"]:
    """Gaussian noise (height, width) of one grain size, mean 0, variance 1; it repeats without a seam."""
    noise = rng.standard_normal(size).astype(np.float32)
    margin = min(int(3 * sigma_px) + 1, min(size))
    padded = np.pad(noise, margin, mode="wrap")
    smooth = cv2.GaussianBlur(padded, (0, 0), sigma_px)[margin:-margin, margin:-margin]
    return (smooth - smooth.mean()) / max(float(smooth.std()), 1e-6)


def fractal_noise(rng: np.random.Generator, size: tuple[int, int], coarsest_px: float, octaves: int = 5) -> Float32[np.ndarray, "h w"]:
    """Noise of several grain sizes, each half as large and half as strong as the one before; mean 0, variance 1."""
    total = np.zeros(size, np.float32)
    for octave in range(octaves):
        sigma = coarsest_px / 2**octave
        if sigma < 0.4:
            break
        total += smooth_noise(rng, size, sigma) / 2**octave
    return (total - total.mean()) / max(float(total.std()), 1e-6)
