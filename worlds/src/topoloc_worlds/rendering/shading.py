"""Compute the radiance of rays if the light on all surfaces is known: colours, light, direct sun,
and one reflection."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from topoloc_worlds.rendering.first_hits import FirstHits, find_first_hits, open_towards
from topoloc_worlds.rendering.light_cells import LightCells, light_at
from topoloc_worlds.scene import Sky

_LIFT = 1e-3
_FAINTEST_SHEEN = 0.01
_SAME_NORMAL, _SAME_PLANE = 0.99, 2e-3


@dataclass(frozen=True, eq=False)
class SurfaceLight:
    """Hold the light on the surfaces at the centres of the pixels."""

    hits: FirstHits
    light: Float32[np.ndarray, "n 3"]
    """Irradiance over pi, the sun's own left out."""
    sun: Float32[np.ndarray, " n"]
    """Share of the sun that is not hidden."""
    at_shadow: Bool[np.ndarray, " n"]
    """Where a shadow's border is near."""


class Shader:
    """Shade a world with known light."""

    def __init__(self, loaded: Any, cells: LightCells, sky: Sky | None) -> None:
        self._loaded, self._cells = loaded, cells
        self._sun_direction = sky.sun_direction if sky is not None else None
        self._sun = np.array(
            sky.sun_irradiance if sky is not None else (0.0, 0.0, 0.0), np.float32
        ) / np.float32(np.pi)

    def surface_light(
        self, origin: Float64[np.ndarray, "3"], hits: FirstHits, shape: tuple[int, int]
    ) -> SurfaceLight:
        """Light at the middles of all pixels of a picture of `shape`, for `shade` to start from."""
        points = origin + hits.position.astype(np.float64)
        everywhere = np.ones(len(points), bool)
        sun = self._sun_on(points, hits.normal, everywhere)
        around = np.ones((3, 3), np.uint8)
        picture = sun.reshape(shape)
        at_shadow = (cv2.dilate(picture, around) != cv2.erode(picture, around)).ravel()
        return SurfaceLight(hits, light_at(self._cells, points, hits.normal), sun, at_shadow)

    def shade(
        self,
        origin: Float64[np.ndarray, "3"],
        directions_world: Float64[np.ndarray, "n 3"],
        hits: FirstHits,
        middle: SurfaceLight,
        rng: np.random.Generator,
    ) -> Float32[np.ndarray, "n 3"]:
        """Return radiance along rays from `origin`, one a pixel, with known first hits.

        Args:
            middle: light at the centres of the same pixels. A ray that hits the same surface has
                the same light.
            rng: spreads the reflections of rough mirrors.
        """
        elsewhere = _on_other_surface(hits, middle.hits)
        points = origin + hits.position.astype(np.float64)
        light = middle.light.copy()
        light[elsewhere] = light_at(self._cells, points[elsewhere], hits.normal[elsewhere])
        sun = middle.sun.copy()
        unsure = elsewhere | middle.at_shadow
        sun[unsure] = self._sun_on(points, hits.normal, unsure)
        seen = hits.emission + hits.albedo * self._together(light, sun, hits.normal)
        shiny = np.flatnonzero(hits.sheen.max(axis=1) > _FAINTEST_SHEEN)
        if len(shiny):
            seen[shiny] += hits.sheen[shiny] * self._mirrored(
                origin, directions_world[shiny], hits, shiny, rng
            )
        return seen

    def _mirrored(
        self,
        origin: Float64[np.ndarray, "3"],
        towards: Float64[np.ndarray, "m 3"],
        hits: FirstHits,
        shiny: Int64[np.ndarray, " m"],
        rng: np.random.Generator,
    ) -> Float32[np.ndarray, "m 3"]:
        """Return the reflections of mirrors. Mirrors seen in mirrors are dim: they reflect only
        their own light."""
        normals = hits.sheen_normal[shiny].astype(np.float64)
        points = origin + towards * hits.sheen_distance[shiny, None] + _LIFT * normals
        away = towards - 2.0 * np.einsum("ni,ni->n", towards, normals)[:, None] * normals
        there = find_first_hits(
            self._loaded, points, _spread(away, normals, hits.roughness[shiny], rng)
        )
        points_there = points + there.position
        light = light_at(self._cells, points_there, there.normal)
        sun = self._sun_on(points_there, there.normal, np.ones(len(light), bool))
        return there.emission + (there.albedo + there.sheen) * self._together(
            light, sun, there.normal
        )

    def _together(
        self,
        light: Float32[np.ndarray, "n 3"],
        sun: Float32[np.ndarray, " n"],
        normals: Float32[np.ndarray, "n 3"],
    ) -> Float32[np.ndarray, "n 3"]:
        if self._sun_direction is None:
            return light
        facing = np.maximum(normals @ self._sun_direction.astype(np.float32), 0.0)
        return light + (facing * sun)[:, None] * self._sun

    def _sun_on(
        self,
        points: Float64[np.ndarray, "n 3"],
        normals: Float32[np.ndarray, "n 3"],
        wanted: Bool[np.ndarray, " n"],
    ) -> Float32[np.ndarray, " m"]:
        """Return the visible share of the sun at selected points, 0 on surfaces turned away."""
        sun = np.zeros(len(points), np.float32)
        if self._sun_direction is not None:
            lit = np.flatnonzero(wanted & (normals @ self._sun_direction.astype(np.float32) > 0.0))
            if len(lit):
                sun[lit] = open_towards(
                    self._loaded, points[lit] + _LIFT * normals[lit], self._sun_direction
                )
        return sun[wanted]


def _on_other_surface(hits: FirstHits, middle: FirstHits) -> Bool[np.ndarray, " n"]:
    """Return whether a ray misses the plane of the surface at its pixel's centre."""
    turned = np.einsum("ni,ni->n", hits.normal, middle.normal) < _SAME_NORMAL
    off = np.abs(np.einsum("ni,ni->n", hits.position - middle.position, middle.normal))
    return turned | (off > _SAME_PLANE * np.abs(middle.position).max(axis=1))


def _spread(
    directions: Float64[np.ndarray, "n 3"],
    normals: Float64[np.ndarray, "n 3"],
    roughness: Float32[np.ndarray, " n"],
    rng: np.random.Generator,
) -> Float64[np.ndarray, "n 3"]:
    """Directions tilted at random, twice as far as the facets of a rough surface are, and none into
    the surface."""
    tilted = directions + np.sqrt(2.0) * roughness[:, None] * rng.standard_normal(directions.shape)
    below = np.einsum("ni,ni->n", tilted, normals) < 1e-3
    tilted[below] = directions[below]
    return tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
