"""The sky over a world: clear with the sun, overcast, dusk, night; one formula each, brightness
from the condition.

Clear and overcast skies follow the distributions of the CIE general sky (CIE S 011/E:2003, types 12
and 1).
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64

from topoloc_worlds.conditions import Condition
from topoloc_worlds.noise import fractal_noise, rng_of
from topoloc_worlds.scene import Sky

_HEIGHT, _WIDTH = 128, 256
_SUN_IRRADIANCE = np.array([12.0, 11.0, 9.5])
_DUSK = 0.05
"""Share of a clear noon below which the sun has set."""
_TOWN_GLOW = 2e-4
_GROUND = np.array([0.13, 0.12, 0.09])
"""Albedo of the land below the horizon: grass, roads and roofs seen from afar."""


def sky_of(condition: Condition, seed: int) -> Sky:
    """The sky of a place under a condition: mean radiance above the horizon is the condition's
    daylight (1 is a clear noon).

    The sun stands at the same point whenever it shines, so that its shadows are part of the place;
    clouds are the seed's too.
    """
    directions = _directions()
    to_sun = _sun_direction(seed)
    rng = rng_of(seed, f"sky/{condition.name}")
    if condition.daylight <= 0.0:
        upper, level = _night(directions), _TOWN_GLOW
    elif condition.daylight <= _DUSK:
        upper, level = _dusk(directions, to_sun), condition.daylight
    elif condition.sun:
        upper, level = _clear(directions, to_sun, rng), condition.daylight
    else:
        upper, level = (
            _overcast(directions, rng, contrast=0.12 if condition.wet else 0.22),
            condition.daylight,
        )
    radiance = upper * (level / _mean_radiance(upper, directions))
    if not condition.sun:
        return Sky(_above_land(radiance, directions, np.zeros(3)))
    irradiance = _SUN_IRRADIANCE * condition.daylight
    r, g, b = irradiance.tolist()
    return Sky(_above_land(radiance, directions, irradiance * to_sun[2]), to_sun, (r, g, b))


def _sun_direction(seed: int) -> Float64[np.ndarray, "3"]:
    rng = rng_of(seed, "sun")
    azimuth, elevation = rng.uniform(0.0, 2 * np.pi), np.radians(rng.uniform(34.0, 48.0))
    return np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )


def _directions() -> Float64[np.ndarray, "h w 3"]:
    """Unit vector of every pixel of the picture of all directions."""
    polar = (np.arange(_HEIGHT) + 0.5)[:, None] * (np.pi / _HEIGHT)
    azimuth = np.arange(_WIDTH)[None, :] * (2 * np.pi / _WIDTH)
    return np.stack(
        np.broadcast_arrays(
            np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)
        ),
        axis=-1,
    )


def _solid_angle(directions: Float64[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "h w"]:
    return np.hypot(directions[..., 0], directions[..., 1]) * (2 * np.pi**2 / (_HEIGHT * _WIDTH))


def _mean_radiance(
    radiance: Float[np.ndarray, "h w 3"], directions: Float64[np.ndarray, "h w 3"]
) -> float:
    """Mean of the half above the horizon, all colours together."""
    weight = _solid_angle(directions) * (directions[..., 2] > 0.0)
    return float(np.sum(radiance.mean(axis=-1) * weight) / np.sum(weight))


def _clear(
    directions: Float64[np.ndarray, "h w 3"],
    to_sun: Float64[np.ndarray, "3"],
    rng: np.random.Generator,
) -> Float64[np.ndarray, "h w 3"]:
    up = np.maximum(directions[..., 2], 0.02)
    cos_from_sun = np.clip(directions @ to_sun, -1.0, 1.0)
    from_sun = np.arccos(cos_from_sun)
    gradation = 1.0 - np.exp(-0.32 / up)
    scattering = (
        1.0 + 10.0 * (np.exp(-3.0 * from_sun) - np.exp(-1.5 * np.pi)) + 0.45 * cos_from_sun**2
    )
    white = np.clip(np.exp(-3.5 * up) * 0.8 + 0.35 * np.exp(-4.0 * from_sun), 0.0, 1.0)[..., None]
    blue = (1.0 - white) * np.array([0.42, 0.75, 1.55]) + white * np.array([1.02, 1.02, 1.0])
    sky = (gradation * scattering)[..., None] * blue
    noise = _cloud_layer(directions, rng)
    cover = np.clip((noise - 0.55) / 0.9, 0.0, 0.95)[..., None]
    puffs = sky.mean(axis=(0, 1)).max() * (1.55 - 0.35 * cover) * np.array([1.0, 1.0, 1.01])
    return sky * (1.0 - cover) + puffs * cover


def _overcast(
    directions: Float64[np.ndarray, "h w 3"], rng: np.random.Generator, contrast: float
) -> Float64[np.ndarray, "h w 3"]:
    up = np.maximum(directions[..., 2], 0.0)
    structure = np.exp(contrast * _cloud_layer(directions, rng))
    return (((1.0 + 2.0 * up) / 3.0) * structure)[..., None] * np.array([0.97, 1.0, 1.05])


def _dusk(
    directions: Float64[np.ndarray, "h w 3"], to_sun: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "h w 3"]:
    """Make the sky just after sunset: a warm band above the sun's last position, blue overhead."""
    up = np.maximum(directions[..., 2], 0.0)
    west = to_sun[:2] / np.linalg.norm(to_sun[:2])
    facing = 0.5 + 0.5 * (directions[..., :2] @ west) / np.maximum(
        np.hypot(directions[..., 0], directions[..., 1]), 1e-9
    )
    glow = (np.exp(-6.0 * up) * (0.25 + 1.75 * facing**3))[..., None] * np.array([1.5, 0.85, 0.45])
    return glow + (0.35 + 0.3 * np.exp(-2.0 * up))[..., None] * np.array([0.45, 0.65, 1.2])


def _night(directions: Float64[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "h w 3"]:
    """The lamps of a town behind the horizon."""
    up = np.maximum(directions[..., 2], 0.0)
    return (0.12 + np.exp(-5.0 * up))[..., None] * np.array([1.25, 0.95, 0.75])


def _cloud_layer(
    directions: Float64[np.ndarray, "h w 3"], rng: np.random.Generator
) -> Float32[np.ndarray, "h w"]:
    """Noise on a flat layer overhead, as seen from below: smaller towards the horizon; mean about
    0, variance about 1."""
    size = 512
    noise = fractal_noise(rng, (size, size), coarsest_px=40.0)
    scale = 90.0 / (np.maximum(directions[..., 2], 0.0) + 0.18)
    x, y = ((directions[..., axis] * scale % size).astype(np.float32) for axis in (0, 1))
    return cv2.remap(noise, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP).astype(np.float32)


def _above_land(
    radiance: Float64[np.ndarray, "h w 3"],
    directions: Float64[np.ndarray, "h w 3"],
    sun: Float64[np.ndarray, "3"],
) -> Float32[np.ndarray, "h w 3"]:
    """The sky with flat land below it, lit by the sky and by `sun` (irradiance on level ground)."""
    up = directions[..., 2]
    onto_land = _solid_angle(directions) * np.maximum(up, 0.0)
    land = _GROUND / np.pi * (np.einsum("hwc,hw->c", radiance, onto_land) + sun)
    return np.where(up[..., None] > 0.0, radiance, land).astype(np.float32)
