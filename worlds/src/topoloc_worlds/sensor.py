"""Convert light to the image that a camera stores: exposure, clipping, vignetting, noise, sRGB.

The automatic exposure has the limits of real ones, a longest time and a largest gain. So images of
dark places are dark and noisy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from topoloc_worlds.conditions import Condition
from topoloc_worlds.noise import rng_of

_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)
_SHOULDER = 0.8
"""Output above which highlights are compressed, before they clip."""
_METERED_STEP = 4
_DARKEST = 1e-7


@dataclass(frozen=True)
class SensorConfig:
    """A small global-shutter camera with automatic exposure.

    Attributes:
        sensitivity: linear output (1 is white) per unit of radiance and second at gain 1.
        target: geometric mean of the linear picture that the exposure aims at.
        max_clipped: largest share of the picture, by weight, that may become white for it.
        max_time: longest exposure, seconds.
        max_gain: largest gain; 1 is the sensor's own sensitivity.
        full_well: electrons at white, at gain 1.
        read_noise: standard deviation, electrons.
        vignetting: share of the light that is missing in the corners.
        white_balance_error: standard deviation of the gain of red and blue.
    """

    sensitivity: float = 500.0
    target: float = 0.16
    max_clipped: float = 0.4
    max_time: float = 0.025
    max_gain: float = 24.0
    full_well: float = 12000.0
    read_noise: float = 3.0
    vignetting: float = 0.25
    white_balance_error: float = 0.04


@dataclass(frozen=True)
class Exposure:
    """Hold the exposure of one image or one pair: `time` in seconds."""

    time: float
    gain: float


def choose_exposure(radiance: Float32[np.ndarray, "h w 3"], config: SensorConfig) -> Exposure:
    """The time, then the gain, that bring the picture's centre-weighted geometric mean to the
    target, within the camera's limits.

    The geometric mean hardly heeds how bright a bright window is, so that the room around it stays
    visible and the window saturates, but never more of the picture than `config.max_clipped`.
    """
    luminance = radiance[::_METERED_STEP, ::_METERED_STEP].astype(np.float64) @ _LUMA.astype(
        np.float64
    )
    weight = _centre_weight(luminance.shape)
    mean = float(np.exp(np.sum(weight * np.log(np.maximum(luminance, _DARKEST)))))
    order = np.argsort(luminance, axis=None)
    brighter = 1.0 - np.cumsum(weight.ravel()[order])
    limit = max(
        float(
            luminance.ravel()[order][
                min(int(np.argmax(brighter <= config.max_clipped)), order.size - 1)
            ]
        ),
        _DARKEST,
    )
    needed = min(config.target / mean, 1.0 / limit) / config.sensitivity
    time = min(needed, config.max_time)
    return Exposure(time, min(needed / time, config.max_gain))


def take_picture(
    radiance: Float32[np.ndarray, "h w 3"],
    exposure: Exposure,
    config: SensorConfig,
    rng: np.random.Generator,
    white_balance: Float64[np.ndarray, "3"],
) -> UInt8[np.ndarray, "h w 3"]:
    """The sRGB picture of this light: shot and read noise by the gain, highlights compressed, then
    clipped."""
    height, width = radiance.shape[:2]
    scale = np.float32(config.sensitivity * exposure.time * exposure.gain)
    light = radiance * (scale * _vignetting(height, width, config.vignetting))[:, :, None]
    per_electron = np.float32(exposure.gain / config.full_well)
    variance = (
        np.clip(light, 0.0, 4.0) * per_electron
        + (np.float32(config.read_noise) * per_electron) ** 2
    )
    signal = light + np.sqrt(variance) * rng.standard_normal(light.shape, dtype=np.float32)
    return _encode(signal * white_balance.astype(np.float32))


def white_balance_of(
    condition: Condition, seed: int, config: SensorConfig
) -> Float64[np.ndarray, "3"]:
    """Gains of red, green and blue that the camera has settled on: slightly wrong, each time
    otherwise."""
    red, blue = (
        rng_of(seed, f"white balance/{condition.name}").standard_normal(2)
        * config.white_balance_error
    )
    return np.array([np.exp(red), 1.0, np.exp(blue)])


def _centre_weight(shape: tuple[int, ...]) -> Float64[np.ndarray, "h w"]:
    y, x = (np.linspace(-1.0, 1.0, size) for size in shape)
    weight = 0.3 + np.exp(-1.5 * (x[None, :] ** 2 + y[:, None] ** 2))
    return weight / weight.sum()


def _vignetting(height: int, width: int, missing: float) -> Float32[np.ndarray, "h w"]:
    y, x = (np.arange(size, dtype=np.float32) - (size - 1) / 2 for size in (height, width))
    corner = max(((height - 1) / 2) ** 2 + ((width - 1) / 2) ** 2, 1.0)
    return (1.0 - missing * (x[None, :] ** 2 + y[:, None] ** 2) / corner).astype(np.float32)


def _encode(signal: Float32[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """sRGB (IEC 61966-2-1) of linear values, with a shoulder before white: twice white is white."""
    over = np.clip((signal - _SHOULDER) / (2.0 - _SHOULDER), 0.0, 1.0)
    # The power with which the curve leaves the straight line without a bend.
    power = (2.0 - _SHOULDER) / (1.0 - _SHOULDER)
    compressed = _SHOULDER + (1.0 - _SHOULDER) * (1.0 - (1.0 - over) ** power)
    linear = np.clip(np.where(signal > _SHOULDER, compressed, signal), 0.0, 1.0)
    encoded = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** np.float32(1 / 2.4) - 0.055
    )
    return np.rint(encoded * 255.0).astype(np.uint8)
