"""The loop along a ray, in Mitsuba's own arrays or numbers: the part of `first_hits` that runs once a ray where nothing is vectorised."""

from __future__ import annotations

from typing import Any

from topoloc.simulation.mitsuba_scene import GLASS, KIND, LIGHT, METAL, POLISHED, TINT

_MAX_LAYERS = 12
_FACE_ON = 0.04
"""Share of light that varnish, water or wax reflects face on; Schlick's formula has the rest."""


def follow(scene: Any, origin: Any, direction: Any) -> tuple[Any, ...]:
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


def components(value: Any) -> list[Any]:
    """x, y and z of a vector or colour, or the number itself."""
    return list(value) if hasattr(value, "__len__") and len(value) == 3 and hasattr(value, "x") else [value]


def flat(parts: tuple[Any, ...]) -> list[float]:
    """All numbers of what `follow` found along one ray."""
    return [float(component) for part in parts for component in components(part)]
