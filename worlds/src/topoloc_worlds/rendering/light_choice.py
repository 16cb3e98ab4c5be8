"""Choose sampling weights of lights for the position of the camera.

At every bounce a path samples one light. By default Mitsuba samples all lights equally often, which
renders a long street by night as noise. So before each picture the contributions of sun, sky and
lamps are measured at a few hundred points: the points visible to the camera, and points visible
from these.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from topoloc_worlds.rendering.first_hits import FirstHits, find_first_hits
from topoloc_worlds.rendering.mitsuba_scene import lamp_name, lamp_pieces, radiance_of
from topoloc_worlds.scene import Mesh, Scene

_NUM_POINTS = 400
_LIFT = 1e-3  # metres off a surface, so that a ray does not meet it again


class LightChoice:
    """Hold the lights of a scene, and their sampling weights.

    Attributes:
        lamps: lamps and screens, in pieces for `mitsuba_scene.load_scene`.
    """

    def __init__(self, scene: Scene) -> None:
        self.lamps = lamp_pieces(scene)
        self._centres = np.array([_centre(mesh) for _, mesh in self.lamps]).reshape(-1, 3)
        self._powers = np.array(
            [_area(mesh) * float(radiance_of(material).mean()) for material, mesh in self.lamps]
        )
        self._has_sky = scene.sky is not None
        self._sun_direction = scene.sky.sun_direction if scene.sky is not None else None
        self._sun = float(np.mean(scene.sky.sun_irradiance)) if scene.sky is not None else 0.0

    def weights(
        self, loaded: Any, origin: Float64[np.ndarray, "3"], seen: FirstHits
    ) -> dict[str, float]:
        """Return the sampling weight of each light, by the name of Mitsuba's parameter, for a
        camera at `origin` that sees these points.

        The sun gets a half, a quarter or a sixteenth of all samples. The paths of a pixel are
        spread so evenly that exactly this number samples the sun, so sunlight and its shadows have
        no noise.
        """
        points, normals, sky = self._survey(loaded, origin, seen)
        weights: dict[str, float] = {}
        if len(self.lamps):
            offset = self._centres[None] - points[:, None]
            squared = np.sum(offset**2, axis=2) + 0.1
            facing = np.maximum(np.einsum("pli,pi->pl", offset, normals) / np.sqrt(squared), 0.05)
            irradiance = self._powers * np.mean(facing / squared, axis=0)
            irradiance += 0.05 * irradiance.mean() + 1e-9
            weights = {
                f"{lamp_name(i)}.emitter.sampling_weight": float(value)
                for i, value in enumerate(irradiance)
            }
        if self._has_sky:
            weights["sky.sampling_weight"] = max(sky, 0.05 * sum(weights.values()), 1e-9)
        if self._sun_direction is not None:
            others = sum(weights.values())
            sun, on_camera_points = self._sun_on(loaded, points, normals)
            share = (
                1 / 2
                if sun > 0.5 * others
                else 1 / 4
                if on_camera_points or sun > 0.1 * others
                else 1 / 16
            )
            weights["sun.sampling_weight"] = others * share / (1.0 - share)
        return weights

    def _survey(
        self, loaded: Any, origin: Float64[np.ndarray, "3"], seen: FirstHits
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], float]:
        """Points with normals, first those the camera sees, then those these see; and the light of
        the sky on the former."""
        solid = np.flatnonzero(np.any(seen.normal != 0.0, axis=1))
        chosen = (
            solid[np.linspace(0, len(solid) - 1, min(_NUM_POINTS, len(solid))).astype(np.int64)]
            if len(solid)
            else solid
        )
        normals = seen.normal[chosen].astype(np.float64)
        points = origin + seen.position[chosen] + _LIFT * normals
        if not len(chosen):
            return points, normals, 0.0
        around = np.random.default_rng(0).standard_normal((len(chosen), 3))
        directions = normals + around / np.linalg.norm(
            around, axis=1, keepdims=True
        )  # by the cosine with the normal
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
        next_hits = find_first_hits(loaded, points, directions)
        sky = float(np.pi * np.mean(next_hits.emission.mean(axis=1) * next_hits.open))
        second = np.any(next_hits.normal != 0.0, axis=1)
        next_normals = next_hits.normal[second].astype(np.float64)
        next_points = points[second] + next_hits.position[second] + _LIFT * next_normals
        return np.concatenate([points, next_points]), np.concatenate([normals, next_normals]), sky

    def _sun_on(
        self, loaded: Any, points: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"]
    ) -> tuple[float, bool]:
        """Mean light of the sun on the points, and whether any of those that the camera sees has
        some."""
        assert self._sun_direction is not None
        facing = normals @ self._sun_direction
        towards = np.broadcast_to(self._sun_direction, points.shape)
        lit = (
            (facing > 0.0) & (find_first_hits(loaded, points, towards).open > 0.1)
            if len(points)
            else facing > 0.0
        )
        return self._sun * float(np.mean(np.where(lit, facing, 0.0))) if len(points) else 0.0, bool(
            lit[:_NUM_POINTS].any()
        )


def _centre(mesh: Mesh) -> Float64[np.ndarray, "3"]:
    return mesh.vertices[mesh.faces].mean(axis=(0, 1))


def _area(mesh: Mesh) -> float:
    corners = mesh.vertices[mesh.faces]
    return 0.5 * float(
        np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        ).sum()
    )
