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

from topoloc.simulation.mitsuba_scene import GLASS, KIND, LIGHT, METAL, POLISHED, TINT

_MAX_LAYERS = 12
_FACE_ON = 0.04
"""Share of light that varnish, water or wax reflects face on; Schlick's formula has the rest."""
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
        found = [_flat(_follow(scene, mi.Point3f(o), mi.Vector3f(d))) for o, d in zip(starts, rays, strict=True)]
        rows = np.array(found, np.float32).reshape(-1, 15)
    else:
        columns = _follow(scene, mi.Point3f(np.ascontiguousarray(start.T)), mi.Vector3f(np.ascontiguousarray(rays.T)))
        dr.eval(*columns)  # all in one kernel
        rows = np.stack([np.broadcast_to(np.array(column), len(rays)) for part in columns for column in _components(part)], axis=1)
    return _from_rows(rows, rays, haze_range)


def _components(value: Any) -> list[Any]:
    return list(value) if hasattr(value, "__len__") and len(value) == 3 and hasattr(value, "x") else [value]


def _flat(parts: tuple[Any, ...]) -> list[float]:
    return [float(component) for part in parts for component in _components(part)]


def _from_rows(rows: Float32[np.ndarray, "n 15"], rays: Float32[np.ndarray, "n 3"], haze_range: float) -> FirstHits:
    distance = np.where(rows[:, 12] > 0.0, rows[:, 12], np.float32(inf))
    facing = np.einsum("ni,ni->n", rows[:, 6:9], rays)
    normal = np.where(facing[:, None] > 0.0, -rows[:, 6:9], rows[:, 6:9])
    through = np.minimum(distance, _SKY_HEIGHT * haze_range / np.maximum(rays[:, 2], 1e-3)) if haze_range < inf else distance
    clear = np.exp(-through / haze_range) if haze_range < inf else np.ones_like(distance)
    return FirstHits(rows[:, :3], rows[:, 3:6], normal, rows[:, 9:12], distance, rows[:, 13] > 0.5, rows[:, 14], clear.astype(np.float32))


def _follow(scene: Any, origin: Any, direction: Any) -> tuple[Any, ...]:
    """The loop along a ray, or along an array of rays, as the variant has it. Returns 15 numbers a ray."""
    import drjit as dr
    import mitsuba as mi

    width = dr.width(direction)
    nothing, black = dr.zeros(mi.Float, width), dr.zeros(mi.Color3f, width)
    vector = dr.zeros(mi.Vector3f, width)
    ray = mi.Ray3f(mi.Point3f(origin + vector), mi.Vector3f(direction))
    found = (black, mi.Color3f(black), vector, mi.Vector3f(vector), mi.Float(nothing), mi.Float(nothing), mi.Float(nothing))
    state = (nothing == 0.0, mi.UInt32(dr.zeros(mi.UInt32, width)), ray, mi.Float(nothing + 1.0), *found)

    def go_on(active: Any, layer: Any, ray: Any, through: Any, *found: Any) -> tuple[Any, ...]:
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        if dr.is_jit_v(mi.Float) or hit:
            gap, met = _add_surface(si, hit, ray, origin, through, *found[:6])
            found = (*met, found[6])
            through_behind = dr.select(hit, through * gap, 0.0)
            ray_behind = si.spawn_ray(ray.d)
        else:
            through_behind, ray_behind = mi.Float(0.0), ray
        sky = scene.environment()
        missed = active & ~hit if dr.is_jit_v(mi.Float) else active and not hit
        if sky is not None and (dr.is_jit_v(mi.Float) or missed):
            seen = mi.Color3f(sky.eval(si, missed))
            found = (found[0], found[1] + dr.select(missed, through * seen, 0.0), *found[2:])
        found = (*found[:6], found[6] + dr.select(missed, through, 0.0))
        on = active & (through_behind > 0.01) & (layer < _MAX_LAYERS)
        return on, layer + 1, ray_behind, through_behind, *found

    return dr.while_loop(state, lambda active, *_: active, go_on)[4:]


def _add_surface(
    si: Any,
    hit: Any,
    ray: Any,
    origin: Any,
    through: Any,
    albedo: Any,
    emission: Any,
    normal: Any,
    position: Any,
    distance: Any,
    mirror: Any,
) -> tuple[Any, tuple[Any, ...]]:
    """What one surface adds to what was found along a ray so far; also the share of light that passes it."""
    import drjit as dr
    import mitsuba as mi

    bsdf = si.shape.bsdf()
    kind = si.shape.eval_attribute_1(KIND, si, hit)
    gap = bsdf.eval_null_transmission(si, hit).x
    share = dr.select(hit, through * (1.0 - gap), 0.0)
    cosine = dr.dot(si.n, ray.d)
    coat = _FACE_ON + (1.0 - _FACE_ON) * (1.0 - dr.abs(cosine)) ** 5
    own = mi.Color3f(bsdf.eval_diffuse_reflectance(si, hit))
    own = dr.select(kind == POLISHED, own * (1.0 - coat) + coat, own)
    own = dr.select(kind == METAL, mi.Color3f(si.shape.eval_attribute_3(TINT, si, hit)), own)
    own = dr.select(kind == GLASS, mi.Color3f(1.0), own)
    albedo += dr.select(kind == LIGHT, mi.Color3f(0.0), share * own)
    shines = hit & (kind == LIGHT) & (cosine < 0.0)
    if dr.is_jit_v(mi.Float) or shines:
        emission += share * dr.select(shines, mi.Color3f(si.shape.emitter().eval(si, shines)), 0.0)
    solid = hit & ((gap < 0.5) | (kind == GLASS))
    path = mi.Vector3f(si.p - origin)
    distance = dr.select(solid & (distance == 0.0), dr.norm(path), distance)
    guide = solid & ((kind != GLASS) | (dr.squared_norm(normal) == 0.0))
    normal = dr.select(guide, mi.Vector3f(si.n), normal)
    position = dr.select(guide, path, position)
    mirror = dr.select(solid & ((kind == GLASS) | (kind == METAL)), 1.0, mirror)
    return gap, (albedo, emission, normal, position, distance, mirror)
