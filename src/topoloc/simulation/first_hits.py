"""What rays meet first: the surface's own colour, its own light, how far it is. No noise in any of it.

A picture is `albedo * light + emission` at every pixel. Albedo and emission carry all textures, edges and screens, and cost one
ray a sample; the light on the surfaces carries the noise of path tracing, and may be filtered without blurring any of that.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64

from topoloc.simulation.first_hits_kernels import components, flat, follow

_SKY_HEIGHT = 0.3
"""Air gets clear at this height, as a share of the range of sight: sky seen upwards keeps its clouds in haze."""


@dataclass(frozen=True, eq=False)
class FirstHits:
    """One entry a ray. Where a ray goes through glass or a gap between leaves, it is what lies behind, weighted by what gets through."""

    albedo: Float32[np.ndarray, "n 3"]
    """Share of light sent back: the colour of matt surfaces, with what their coat or a pane in front of them reflects."""
    emission: Float32[np.ndarray, "n 3"]
    """Light of lamps, screens and the sky."""
    normal: Float32[np.ndarray, "n 3"]
    """Unit normal of the first surface that is not glass (of the pane, where only sky is behind it); 0 in the sky."""
    position: Float32[np.ndarray, "n 3"]
    """Where that surface is met, relative to the camera, in world axes."""
    distance: Float32[np.ndarray, " n"]
    """Metres to the first surface, glass included; infinite in the sky."""
    mirror: Bool[np.ndarray, " n"]
    """Metal or glass: what is seen there lies somewhere else."""
    open: Float32[np.ndarray, " n"]
    """Share of the ray that reaches the sky."""
    clear: Float32[np.ndarray, " n"]
    """Share of the light that comes through haze."""


def find_first_hits(
    scene: Any, origin: Float64[np.ndarray, "*n 3"], directions_world: Float64[np.ndarray, "n 3"], haze_range: float = inf
) -> FirstHits:
    """Follow one ray a row of `directions_world` (unit vectors) from `origin`, one for all or one for each."""
    import drjit as dr
    import mitsuba as mi

    start = origin.astype(np.float32)
    rays = np.ascontiguousarray(directions_world, np.float32)
    if not dr.is_jit_v(mi.Float):
        starts = np.broadcast_to(start, rays.shape)
        found = [flat(follow(scene, mi.Point3f(o), mi.Vector3f(d))) for o, d in zip(starts, rays, strict=True)]
        rows = np.array(found, np.float32).reshape(-1, 15)
    else:
        columns = follow(scene, mi.Point3f(np.ascontiguousarray(start.T)), mi.Vector3f(np.ascontiguousarray(rays.T)))
        dr.eval(*columns)  # all in one kernel
        rows = np.stack([np.broadcast_to(np.array(column), len(rays)) for part in columns for column in components(part)], axis=1)
    return _from_rows(rows, rays, haze_range)


def _from_rows(rows: Float32[np.ndarray, "n 15"], rays: Float32[np.ndarray, "n 3"], haze_range: float) -> FirstHits:
    distance = np.where(rows[:, 12] > 0.0, rows[:, 12], np.float32(inf))
    facing = np.einsum("ni,ni->n", rows[:, 6:9], rays)
    normal = np.where(facing[:, None] > 0.0, -rows[:, 6:9], rows[:, 6:9])
    through = np.minimum(distance, _SKY_HEIGHT * haze_range / np.maximum(rays[:, 2], 1e-3)) if haze_range < inf else distance
    clear = np.exp(-through / haze_range) if haze_range < inf else np.ones_like(distance)
    return FirstHits(rows[:, :3], rows[:, 3:6], normal, rows[:, 9:12], distance, rows[:, 13] > 0.5, rows[:, 14], clear.astype(np.float32))
