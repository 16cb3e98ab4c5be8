"""Filter the noise of the light on surfaces: average along each surface, but not across edges or
borders of shadows.

An edge-avoiding a-trous wavelet filter (Dammertz et al., HPG 2010) is guided by normals and planes.
The variance of the brightness separates shadows from noise (Schied et al., *Spatiotemporal
variance-guided filtering*, 2017). It comes from two pictures of the same view with independent
noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from topoloc_worlds.rendering.light_filter_kernels import spread_light

_DARKEST = 2e-3
"""Albedo below which the light on a surface cannot be told from its colour."""


_COARSE_LEVELS = 2
_ANY_CONTRAST = 1e12
Guides = tuple[
    Float32[np.ndarray, "3 h w"], Float32[np.ndarray, "3 h w"], Float32[np.ndarray, "h w"]
]
"""Normals, positions, and how far off its plane a pixel's surface reaches."""
State = tuple[Float32[np.ndarray, "3 h w"], Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]
"""Light, how much it can be trusted, and the variance of its brightness."""


@dataclass(frozen=True)
class LightFilterConfig:
    """Define the filter of light.

    Attributes:
        levels: passes. Each doubles the reach, which starts at one pixel.
        mirror_levels: passes for mirrors and panes, because normals and planes do not describe
            their reflections.
        contrast: largest difference of brightness taken as noise, in standard deviations of the
            noise.
        flatness: largest distance of a point to a pixel's plane, as a share of its distance to the
            camera.
        firefly: light above this many times the mean around it, and above this many times the other
            picture's, is cut off.
    """

    levels: int = 5
    mirror_levels: int = 3
    contrast: float = 5.0
    flatness: float = 0.01
    firefly: float = 30.0


def filter_light(
    radiance: tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]],
    albedo: Float32[np.ndarray, "h w 3"],
    normal: Float32[np.ndarray, "h w 3"],
    position: Float32[np.ndarray, "h w 3"],
    mirror: Bool[np.ndarray, "h w"],
    config: LightFilterConfig,
) -> Float32[np.ndarray, "h w 3"]:
    """Return the light on the surfaces (radiance over albedo) without its noise.

    Args:
        radiance: two pictures of the light that surfaces reflect, with independent noise.
        normal: unit normals. Pixels without a surface have 0 and stay unchanged.
        position: points relative to the camera (metres).
        mirror: pixels that get the first `mirror_levels` passes alone.
    """
    reflecting = np.maximum(albedo, _DARKEST)
    first, second = (
        _without_fireflies(picture / reflecting, other / reflecting, config)
        for picture, other in (radiance, radiance[::-1])
    )
    light = np.ascontiguousarray((0.5 * (first + second)).transpose(2, 0, 1))
    difference = 0.5 * (first - second).sum(axis=2)
    weight = albedo.mean(axis=2) + np.float32(_DARKEST)
    squared = difference * difference
    variance = np.maximum(cv2.blur(squared * weight, (7, 7)) / cv2.blur(weight, (7, 7)), squared)
    normals, positions = (
        np.ascontiguousarray(picture.transpose(2, 0, 1)) for picture in (normal, position)
    )
    reach = np.maximum(np.float32(config.flatness) * np.linalg.norm(position, axis=2), 1e-4).astype(
        np.float32
    )
    state = (light, weight, variance)
    guides = (normals, positions, reach)
    still = np.zeros_like(weight)
    coarse = state
    for level in range(
        _COARSE_LEVELS
    ):  # what to compare at first: single pixels are too noisy for that
        coarse = _spread(coarse, coarse, guides, still, 2**level, _ANY_CONTRAST)
    for level in range(config.levels):
        if level == config.mirror_levels:
            still = mirror.astype(np.float32)
        state = _spread(
            state,
            coarse if level < _COARSE_LEVELS else state,
            guides,
            still,
            2**level,
            config.contrast,
        )
    return np.ascontiguousarray(state[0].transpose(1, 2, 0))


def _spread(
    state: State,
    compared: State,
    guides: Guides,
    still: Float32[np.ndarray, "h w"],
    step: int,
    contrast: float,
) -> State:
    light, weight, variance = state
    brightness, doubt = (
        compared[0].sum(axis=0),
        np.maximum(cv2.GaussianBlur(compared[2], (3, 3), 0), compared[2]),
    )
    normal, position, reach = guides
    out = (np.empty_like(light), np.empty_like(weight), np.empty_like(variance))
    spread_light(
        light,
        brightness,
        weight,
        variance,
        doubt,
        normal,
        position,
        reach,
        still,
        step,
        np.float32(contrast**2),
        out[0],
        out[1],
        out[2],
    )
    return out


def _without_fireflies(
    light: Float32[np.ndarray, "h w 3"],
    other: Float32[np.ndarray, "h w 3"],
    config: LightFilterConfig,
) -> Float32[np.ndarray, "h w 3"]:
    """Rare paths that found a lamp by luck, seen in one of two pictures only, cut down to the
    brightness around them."""
    brightness, brightness_other = light.sum(axis=2), other.sum(axis=2)
    around = cv2.blur(np.minimum(brightness, brightness_other), (7, 7))
    limit = np.float32(config.firefly) * np.maximum(around, brightness_other) + np.float32(1e-6)
    return (
        light
        * np.minimum(1.0, limit / np.maximum(brightness, 1e-12)).astype(np.float32)[:, :, None]
    )
