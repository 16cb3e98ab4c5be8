"""Find the first surface that each ray hits: its colour, its emission, its distance. All are free
of noise.

A picture is `albedo * light + emission` at every pixel, plus the reflection of `sheen`. Albedo and
emission have all textures, edges and screens, and cost one ray a sample. The light on the surfaces
can be traced in advance, or filtered, without blurring these.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import inf
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64

from topoloc_worlds.rendering.first_hits_kernels import (
    NUM_COLUMNS,
    NUM_NUMBERS,
    NUM_VECTORS,
    flat,
    follow,
    let_through,
)

_SKY_HEIGHT = 0.3
"""Air gets clear at this height, as a share of the range of sight: sky seen upwards keeps its
clouds in haze."""


@dataclass(frozen=True, eq=False)
class FirstHits:
    """Hold one entry a ray. Behind glass or a gap between leaves, the hits are weighted by the
    transmitted share."""

    albedo: Float32[np.ndarray, "n 3"]
    """Share of light sent back to all sides: the colour of matt surfaces, and of what mirrors too
    roughly to show a picture."""
    emission: Float32[np.ndarray, "n 3"]
    """Light of lamps, screens and the sky."""
    normal: Float32[np.ndarray, "n 3"]
    """Unit normal of the first surface that is not glass (of the pane, where only sky is behind
    it); 0 in the sky."""
    position: Float32[np.ndarray, "n 3"]
    """Where that surface is met, relative to the camera, in world axes."""
    distance: Float32[np.ndarray, " n"]
    """Metres to the first surface, glass included; infinite in the sky."""
    sheen: Float32[np.ndarray, "n 3"]
    """Share of light reflected as by a mirror: by metal, by a coat of varnish or water, by a pane
    of glass."""
    sheen_normal: Float32[np.ndarray, "n 3"]
    """Unit normal of the first surface with a sheen; 0 where there is none."""
    sheen_distance: Float32[np.ndarray, " n"]
    """Metres to that surface."""
    roughness: Float32[np.ndarray, " n"]
    """Of that surface."""
    mirror: Bool[np.ndarray, " n"]
    """Metal or glass: what is seen there lies somewhere else."""
    open: Float32[np.ndarray, " n"]
    """Share of the ray that reaches the sky."""
    clear: Float32[np.ndarray, " n"]
    """Share of the light that comes through haze."""


def find_first_hits(
    scene: Any,
    origin: Float64[np.ndarray, "*n 3"],
    directions_world: Float64[np.ndarray, "n 3"],
    haze_range: float = inf,
) -> FirstHits:
    """Follow one ray a row of `directions_world` (unit vectors) from `origin`, one for all or one
    for each."""
    import drjit as dr
    import mitsuba as mi

    start = origin.astype(np.float32)
    rays = np.ascontiguousarray(directions_world, np.float32)
    if not dr.is_jit_v(mi.Float):
        starts = np.broadcast_to(start, rays.shape)
        each = [
            flat(follow(scene, mi.Point3f(o), mi.Vector3f(d)))
            for o, d in zip(starts, rays, strict=True)
        ]
        rows = np.array(each, np.float32).reshape(-1, NUM_COLUMNS)
        columns = [
            *np.split(rows[:, :-NUM_NUMBERS], NUM_VECTORS, axis=1),
            *rows[:, -NUM_NUMBERS:].T,
        ]
    else:
        origins = mi.Point3f(np.ascontiguousarray(start.T))
        dr.make_opaque(
            origins
        )  # a value that the code would contain costs a compilation for every picture
        found = _recorded_in(scene, follow)(
            scene, origins, mi.Vector3f(np.ascontiguousarray(rays.T))
        )
        dr.eval(*found)  # all in one kernel
        columns = [_array(part, len(rays)) for part in found]
    return _first_hits(columns, rays, haze_range)


def _array(part: Any, count: int) -> Float32[np.ndarray, "n *width"]:
    """A Dr.Jit vector or number for each ray, in rows."""
    array = np.array(part, np.float32)
    if array.shape[-1] != count:  # the same for all rays
        array = np.broadcast_to(array, (*array.shape[:-1], count))
    return np.ascontiguousarray(array.T)


def open_towards(
    scene: Any, points: Float64[np.ndarray, "n 3"], direction_world: Float64[np.ndarray, "3"]
) -> Float32[np.ndarray, " n"]:
    """Share of the light from infinitely far away that reaches each point, through panes and
    between leaves. Vectorised variants only."""
    import mitsuba as mi

    starts = mi.Point3f(np.ascontiguousarray(points.T, np.float32))
    ray = mi.Ray3f(starts, mi.Vector3f(*direction_world.tolist()))
    return np.array(_recorded_in(scene, let_through)(scene, ray), np.float32)


def forget_recordings() -> None:
    """Clear cached data before a scene is loaded. A new scene may have the memory address of an old
    one, and Mitsuba's recorded code would confuse them."""
    _recorded.cache_clear()


def _recorded_in(scene: Any, function: Callable[..., Any]) -> Callable[..., Any]:
    """Recorded, but for an empty scene: there Dr.Jit misses the surfaces of any other scene that is
    still alive, and refuses."""
    return _recorded(function) if len(scene.shapes()) else function


@cache
def _recorded(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same, but Python runs it only once for a scene: its kernels are recorded and launched
    again, which saves half of the time."""
    import drjit as dr

    # Where lamps are weighed anew for each picture (light that is not known beforehand), a
    # recording serves but one picture.
    return dr.freeze(function, limit=8, warn_after=1_000_000_000)


def _first_hits(
    columns: list[np.ndarray], rays: Float32[np.ndarray, "n 3"], haze_range: float
) -> FirstHits:
    (
        albedo,
        emission,
        normal,
        position,
        sheen,
        sheen_normal,
        distance,
        mirror,
        sheen_distance,
        roughness,
        sky,
    ) = columns
    distance = np.where(distance > 0.0, distance, np.float32(inf))
    through = (
        np.minimum(distance, _SKY_HEIGHT * haze_range / np.maximum(rays[:, 2], 1e-3))
        if haze_range < inf
        else distance
    )
    clear = np.exp(-through / haze_range) if haze_range < inf else np.ones_like(distance)
    return FirstHits(
        albedo=albedo,
        emission=emission,
        normal=_towards_eye(normal, rays),
        position=position,
        distance=distance,
        sheen=sheen,
        sheen_normal=_towards_eye(sheen_normal, rays),
        sheen_distance=sheen_distance,
        roughness=roughness,
        mirror=mirror > 0.5,
        open=sky,
        clear=clear.astype(np.float32),
    )


def _towards_eye(
    normal: Float32[np.ndarray, "n 3"], rays: Float32[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 3"]:
    away = np.einsum("ni,ni->n", normal, rays) > 0.0
    normal[away] *= -1.0
    return normal
