"""Define the data of a world: meshes with materials, and a sky. Metres, world z up, light in
arbitrary linear units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

Color = tuple[float, float, float]
"""Red, green, blue in [0, 1] as a picture file has them (sRGB), so that colours can be picked from
photographs."""
Picture = UInt8[np.ndarray, "h w 3"]
"""An sRGB picture used as a texture."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in the world. A face is seen from both sides; counter-clockwise corners give the
    outward normal.

    `uv` are texture coordinates: (0, 0) is the top left corner of the picture, (1, 1) the bottom
    right one; beyond, it repeats.
    """

    vertices: Float64[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    uv: Float64[np.ndarray, "n 2"]


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface answers to light.

    matt      diffuse
    polished  diffuse below a clear coat of `roughness`: varnish, waxed floors, wet asphalt, car
    paint metal     reflects only, tinted by `color` glass     a thin pane: reflects at a slant,
    else lets through light     gives light: `radiance` times `color`; reflects nothing
    """

    kind: Literal["matt", "polished", "metal", "glass", "light"]
    color: Picture | Color = (0.5, 0.5, 0.5)
    roughness: float = 0.1
    radiance: float = 0.0
    opacity: UInt8[np.ndarray, "h w"] | None = None
    """Holes in the surface (leaves, railings): 0 is nothing there, 255 is there; spread over it as
    `color` is."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh of one material. Names are for people and tests; several surfaces may share one."""

    name: str
    mesh: Mesh
    material: Material


@dataclass(frozen=True, eq=False)
class Sky:
    """Light from infinitely far away.

    `radiance` is a linear picture of all directions: row 0 is the zenith, the last row the nadir;
    the columns go round, column 0 looks along +x, a quarter of the way on along +y.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    sun_direction: Float64[np.ndarray, "3"] | None = None
    """Unit vector towards the sun, which is not in the picture; None where there is none or it is
    hidden."""
    sun_irradiance: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Haze:
    """Air that is not clear: a share exp(-distance / range) of the light comes through, the rest is
    replaced by `radiance`."""

    range: float
    radiance: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Scene:
    """All that a camera can see under one condition."""

    surfaces: tuple[Surface, ...]
    sky: Sky | None = None
    haze: Haze | None = None
