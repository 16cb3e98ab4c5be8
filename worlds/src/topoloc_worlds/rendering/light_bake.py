"""Tracing the light of a world into its cells, before the first picture is taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from topoloc_worlds.rendering.light_cells import CellGrid, FoundLight, LightCells, LightGatherer

Progress = Callable[[str, int, int], None]
_LIFT = 1e-3  # metres off a surface, so that a ray does not meet it again


@dataclass(frozen=True)
class LightBakeConfig:
    """Define the precision of light tracing.

    Attributes:
        finest: metres, the smallest cells.
        angle: size of cells over their distance.
        rays: rays from each viewpoint into all directions. Light is traced to the points that they
            hit.
        paths: light paths to each such point.
        bounces: reflections on the way from a lamp to that point.
    """

    finest: float = 0.03
    angle: float = 0.012
    rays: int = 24_000
    paths: int = 16
    bounces: int = 4


def bake_light(
    light_scene: Any,
    grid: CellGrid,
    viewpoints: Float64[np.ndarray, "n 3"],
    weigh_lights: Callable[[Float64[np.ndarray, "3"]], dict[str, float]],
    config: LightBakeConfig,
    progress: Progress = lambda stage, done, total: None,
) -> LightCells:
    """Trace the light on all surfaces visible from `viewpoints`. It needs a vectorised variant of
    Mitsuba.

    Args:
        light_scene: from `light_scene.load_light_scene`.
        weigh_lights: sampling weight of each light for the surfaces visible from a viewpoint, by
            the name of Mitsuba's parameter.
        progress: called with ("light", done, total).
    """
    import mitsuba as mi

    parameters = mi.traverse(light_scene)
    gatherer = LightGatherer(grid)
    integrator = mi.load_dict(
        {"type": "path", "max_depth": config.bounces, "rr_depth": 100, "hide_emitters": True}
    )
    sampler = mi.load_dict({"type": "independent"})
    for number, viewpoint in enumerate(viewpoints):
        for name, weight in weigh_lights(viewpoint).items():
            parameters[name] = weight
        parameters.update()
        sampler.seed(number, config.rays * config.paths)
        points, normals, found = _light_seen(
            light_scene,
            integrator,
            sampler,
            viewpoint,
            _directions(number, config.rays),
            config.paths,
        )
        gatherer.add(points, normals, found)
        progress("light", number + 1, len(viewpoints))
    return gatherer.cells()


def _directions(number: int, count: int) -> Float64[np.ndarray, "n 3"]:
    """Evenly over the sphere (a Fibonacci lattice), turned differently for each viewpoint."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    around = np.pi * (1.0 + 5.0**0.5) * k + 2.399963 * number
    ring = np.sqrt(1.0 - z * z)
    return np.column_stack([ring * np.cos(around), ring * np.sin(around), z])


def _light_seen(
    scene: Any,
    integrator: Any,
    sampler: Any,
    viewpoint: Float64[np.ndarray, "3"],
    directions: Float64[np.ndarray, "n 3"],
    paths: int,
) -> tuple[Float64[np.ndarray, "m 3"], Float32[np.ndarray, "m 3"], FoundLight]:
    """Points that rays meet, their normals, and the light there: irradiance over pi, the sun's own
    left out."""
    import drjit as dr
    import mitsuba as mi

    index = dr.arange(mi.UInt32, len(directions) * paths) // paths
    towards = mi.Vector3f(np.ascontiguousarray(directions.T, np.float32))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(*viewpoint.tolist()), towards))
    outward: Any = si.n
    met = si.is_valid()
    normal = dr.select(dr.dot(outward, towards) > 0.0, mi.Vector3f(-outward), mi.Vector3f(outward))
    dr.eval(met, normal, si.p)
    there: Any = dr.zeros(mi.SurfaceInteraction3f, len(directions) * paths)
    facing: Any = dr.gather(mi.Vector3f, normal, index)
    start: Any = dr.gather(mi.Point3f, si.p, index)
    there.n = mi.Normal3f(facing)
    there.p = start + _LIFT * facing
    there.sh_frame = mi.Frame3f(facing)
    active = dr.gather(mi.Bool, met, index)
    lamps, sky = _from_lights(scene, sampler, there, active)
    surfaces = _from_surfaces(scene, integrator, sampler, there, active)
    seen = np.array(met)
    sharp, soft = (_mean(light, paths)[seen] for light in (lamps, sky + surfaces))
    points, normals = np.array(si.p).T.astype(np.float64), np.array(normal).T.astype(np.float32)
    return points[seen], np.ascontiguousarray(normals[seen]), FoundLight(sharp, soft)


def _mean(light: Any, paths: int) -> Float32[np.ndarray, "n 3"]:
    import drjit as dr

    dr.eval(light)  # all three colours in one kernel
    mean = np.array(dr.block_sum(light, paths), np.float32).reshape(3, -1).T / np.float32(paths)
    return np.nan_to_num(mean, nan=0.0, posinf=0.0)  # a path in a million or so


def _from_lights(scene: Any, sampler: Any, si: Any, active: Any) -> tuple[Any, Any]:
    """Return the direct light of lamps and sky."""
    import drjit as dr
    import mitsuba as mi

    sample, radiance = scene.sample_emitter_direction(si, sampler.next_2d(), True, active)
    cosine = dr.maximum(dr.dot(sample.d, si.n), 0.0)
    # The sun has no extent, so that its density is a delta; pictures ask it themselves.
    light = dr.select(active & ~sample.delta, mi.Color3f(radiance * (cosine * dr.inv_pi)), 0.0)
    of_sky = sample.emitter == scene.environment()
    return dr.select(of_sky, mi.Color3f(0.0), light), dr.select(of_sky, light, 0.0)


def _from_surfaces(scene: Any, integrator: Any, sampler: Any, si: Any, active: Any) -> Any:
    import drjit as dr
    import mitsuba as mi

    direction = si.sh_frame.to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
    radiance, _, _ = integrator.sample(scene, sampler, si.spawn_ray(direction), None, active)
    return mi.Color3f(dr.select(active, radiance, 0.0))
