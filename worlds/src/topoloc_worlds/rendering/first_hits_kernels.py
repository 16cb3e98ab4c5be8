"""Follow a ray with Mitsuba's arrays or with numbers. Without vectorisation this part of
`first_hits` runs once a ray."""

from __future__ import annotations

from typing import Any

from topoloc_worlds.rendering.mitsuba_scene import (
    GLASS,
    KIND,
    LIGHT,
    METAL,
    POLISHED,
    ROUGHNESS,
    TINT,
)

NUM_VECTORS, NUM_NUMBERS = 6, 5
NUM_COLUMNS = 3 * NUM_VECTORS + NUM_NUMBERS
_MAX_LAYERS = 12
_TOO_ROUGH = 0.12
"""Mirrors rougher than this show no picture."""
_FACE_ON = 0.04
"""Share of light that varnish, water or wax reflects face on; Schlick's formula has the rest."""


def follow(scene: Any, origin: Any, direction: Any) -> tuple[Any, ...]:
    """The loop along a ray, or along an array of rays, as the variant has it. Returns `NUM_COLUMNS`
    numbers a ray."""
    import drjit as dr
    import mitsuba as mi

    width = dr.width(direction)
    nothing, black = dr.zeros(mi.Float, width), dr.zeros(mi.Color3f, width)
    vector = dr.zeros(mi.Vector3f, width)
    ray = mi.Ray3f(mi.Point3f(origin + vector), mi.Vector3f(direction))
    colours = (
        black,
        mi.Color3f(black),
        vector,
        mi.Vector3f(vector),
        mi.Color3f(black),
        mi.Vector3f(vector),
    )
    found = (*colours, *(mi.Float(nothing) for _ in range(5)))
    state = (
        nothing == 0.0,
        mi.UInt32(dr.zeros(mi.UInt32, width)),
        ray,
        mi.Float(nothing + 1.0),
        *found,
    )

    def go_on(active: Any, layer: Any, ray: Any, through: Any, *found: Any) -> tuple[Any, ...]:
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        if dr.is_jit_v(mi.Float) or hit:
            gap, met = _add_surface(si, hit, ray, origin, through, *found[:-1])
            found = (*met, found[-1])
            through_behind = dr.select(hit, through * gap, 0.0)
            ray_behind = si.spawn_ray(ray.d)
        else:
            through_behind, ray_behind = mi.Float(0.0), ray
        sky = scene.environment()
        missed = active & ~hit if dr.is_jit_v(mi.Float) else active and not hit
        if sky is not None and (dr.is_jit_v(mi.Float) or missed):
            seen = mi.Color3f(sky.eval(si, missed))
            found = (found[0], found[1] + dr.select(missed, through * seen, 0.0), *found[2:])
        found = (*found[:-1], found[-1] + dr.select(missed, through, 0.0))
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
    sheen: Any,
    sheen_normal: Any,
    distance: Any,
    mirror: Any,
    sheen_distance: Any,
    roughness: Any,
) -> tuple[Any, tuple[Any, ...]]:
    """Return the contribution of one surface to a ray, and the transmitted share of light."""
    import drjit as dr
    import mitsuba as mi

    bsdf = si.shape.bsdf()
    kind = si.shape.eval_attribute_1(KIND, si, hit)
    gap = bsdf.eval_null_transmission(si, hit).x
    share = dr.select(hit, through * (1.0 - gap), 0.0)
    cosine = dr.dot(si.n, ray.d)
    own, mirrored, rough = _answers(si, hit, bsdf, kind, cosine)
    # One mirror a ray shows its picture: the first that is smooth enough. All others only send
    # light back.
    shown = hit & (rough < _TOO_ROUGH) & (sheen_distance == 0.0) & (dr.max(share * mirrored) > 0.0)
    albedo += share * dr.select(shown, own, own + mirrored)
    sheen = dr.select(shown, share * mirrored, sheen)
    sheen_normal = dr.select(shown, mi.Vector3f(si.n), sheen_normal)
    sheen_distance = dr.select(shown, dr.norm(mi.Vector3f(si.p - origin)), sheen_distance)
    roughness = dr.select(shown, rough, roughness)
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
    return gap, (
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
    )


def _answers(si: Any, hit: Any, bsdf: Any, kind: Any, cosine: Any) -> tuple[Any, Any, Any]:
    """Shares of light that a surface sends back to all sides, and that it mirrors; and how rough a
    mirror it is."""
    import drjit as dr
    import mitsuba as mi

    black = mi.Color3f(0.0)
    coat = _FACE_ON + (1.0 - _FACE_ON) * (1.0 - dr.abs(cosine)) ** 5
    own = mi.Color3f(bsdf.eval_diffuse_reflectance(si, hit))
    own = dr.select(kind == POLISHED, own * (1.0 - coat), own)
    own = dr.select((kind == METAL) | (kind == GLASS) | (kind == LIGHT), black, own)
    mirrored = dr.select(kind == POLISHED, mi.Color3f(coat), black)
    mirrored = dr.select(
        kind == METAL, mi.Color3f(si.shape.eval_attribute_3(TINT, si, hit)), mirrored
    )
    mirrored = dr.select(kind == GLASS, mi.Color3f(1.0), mirrored)
    return own, mirrored, si.shape.eval_attribute_1(ROUGHNESS, si, hit)


def let_through(scene: Any, ray: Any) -> Any:
    """Return the share of light that passes along each ray of an array; 0 behind a solid
    surface."""
    import drjit as dr
    import mitsuba as mi

    def go_on(active: Any, layer: Any, ray: Any, left: Any) -> tuple[Any, ...]:
        si = scene.ray_intersect(ray, active)
        met = active & si.is_valid()
        gap = dr.select(met, si.bsdf().eval_null_transmission(si, met).x, 1.0)
        behind = si.spawn_ray(ray.d)
        behind.maxt = dr.maximum(ray.maxt - si.t, 0.0)
        return met & (gap > 0.01) & (layer < _MAX_LAYERS), layer + 1, behind, left * gap

    width = dr.width(ray)
    state = (
        dr.full(mi.Bool, True, width),
        dr.zeros(mi.UInt32, width),
        ray,
        dr.ones(mi.Float, width),
    )
    return dr.while_loop(state, lambda active, *_: active, go_on)[3]


def flat(parts: tuple[Any, ...]) -> list[float]:
    """Return all numbers that `follow` found along one ray."""
    return [
        float(component)
        for part in parts
        for component in (part if hasattr(part, "x") else (part,))
    ]
