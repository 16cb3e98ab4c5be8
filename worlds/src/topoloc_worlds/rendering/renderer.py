"""Render a world from a camera's pose: linear light, and exact depth."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isqrt
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc_worlds.rendering.first_hits import FirstHits, find_first_hits, forget_recordings
from topoloc_worlds.rendering.light_bake import LightBakeConfig, Progress, bake_light
from topoloc_worlds.rendering.light_cache import cached_light
from topoloc_worlds.rendering.light_cells import LightCells, divide_space
from topoloc_worlds.rendering.light_choice import LightChoice
from topoloc_worlds.rendering.light_filter import LightFilterConfig, filter_light
from topoloc_worlds.rendering.light_scene import load_light_scene
from topoloc_worlds.rendering.mitsuba_scene import load_scene
from topoloc_worlds.rendering.shading import Shader
from topoloc_worlds.rendering.variant import LLVM, use_best_variant
from topoloc_worlds.scene import Scene


@dataclass(frozen=True)
class RenderConfig:
    """Define the work spent on a picture.

    Attributes:
        albedo_samples: rays a pixel for colours, edges, screens, sky, sunlight and reflections.
        samples: light paths a pixel if light is not traced in advance. Each of two pictures gets
            half of them, and their difference gives the noise.
        bounces: reflections of light between a lamp and the camera, in such pictures.
        bake: precision of tracing the light of a world in advance.
    """

    albedo_samples: int = 4
    samples: int = 8
    bounces: int = 3
    light_filter: LightFilterConfig = field(default_factory=LightFilterConfig)
    bake: LightBakeConfig = field(default_factory=LightBakeConfig)

    @staticmethod
    def draft() -> RenderConfig:
        """Several times faster, with rougher edges and some blotches in the light."""
        return RenderConfig(
            albedo_samples=1,
            samples=2,
            bounces=2,
            bake=LightBakeConfig(finest=0.06, angle=0.02, rays=8_000, paths=16),
        )


@dataclass(frozen=True, eq=False)
class Rendering:
    """Hold the image and the depth of one camera."""

    radiance: Float32[np.ndarray, "h w 3"]
    """Linear light: red, green, blue."""
    depth: Float32[np.ndarray, "h w"]
    """Metres along the camera's z axis at the pixel centres; NaN in the sky. Through glass it is
    that of the pane."""


class Renderer:
    """Render many pictures of a world that is loaded once.

    The same seed gives the same bytes, in every process with the same variant of Mitsuba.
    `viewpoints` (n, 3) are positions all over the camera's paths. With them, the light on all
    visible surfaces is traced in advance, or read from the cache. Pictures then render fast and
    without noise. Without them, and without LLVM, each picture traces a few light paths and filters
    their noise.

    Raises:
        MissingExtraError: Mitsuba is not installed.
    """

    def __init__(
        self,
        scene: Scene,
        config: RenderConfig | None = None,
        viewpoints: Float64[np.ndarray, "n 3"] | None = None,
        progress: Progress = lambda stage, done, total: None,
    ) -> None:
        self._config = config or RenderConfig()
        vectorised = use_best_variant() == LLVM
        import mitsuba

        self._haze = scene.haze
        self._lights = LightChoice(scene)
        forget_recordings()
        self._scene = load_scene(scene, self._lights.lamps)
        self._parameters = mitsuba.traverse(self._scene)
        self._integrator = _integrator(scene, self._config)
        self._shader: Shader | None = None
        if vectorised and viewpoints is not None:
            self._shader = Shader(
                self._scene, self._known_light(scene, viewpoints, progress), scene.sky
            )

    def render(self, camera: Camera, world_from_cam: Rigid3, seed: int) -> Rendering:
        """Render the view of `camera` from a pose.

        Raises:
            CalibrationError: a camera with distortion, or with pixels that are not square.
        """
        if camera.is_distorted or abs(camera.fx / camera.fy - 1.0) > 1e-6:
            raise CalibrationError(
                "only cameras without distortion and with square pixels are rendered, not"
                f" {camera.model} {camera.params}"
            )
        centres = self._first_hits(camera, world_from_cam, (0.0, 0.0))
        if self._shader is None:
            picture = self._traced(camera, world_from_cam, centres, seed)
        else:
            picture = self._shaded(self._shader, camera, world_from_cam, centres, seed)
        along = _directions_cam(camera, (0.0, 0.0))[:, 2]
        depth = np.where(np.isfinite(centres.distance), centres.distance * along, np.nan).astype(
            np.float32
        )
        return Rendering(picture, depth.reshape(camera.height, camera.width))

    def _known_light(
        self, scene: Scene, viewpoints: Float64[np.ndarray, "n 3"], progress: Progress
    ) -> LightCells:
        bake = self._config.bake
        grid = divide_space(viewpoints, bake.finest, bake.angle)

        def trace() -> LightCells:
            light_scene = load_light_scene(scene, self._lights.lamps)
            return bake_light(light_scene, grid, viewpoints, self._weights_around, bake, progress)

        return cached_light(scene, viewpoints, bake, grid, trace)

    def _weights_around(self, origin: Float64[np.ndarray, "3"]) -> dict[str, float]:
        """Return the sampling weight of each light for all directions from a position."""
        directions = np.random.default_rng(0).standard_normal((_NUM_AROUND, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return self._lights.weights(
            self._scene, origin, find_first_hits(self._scene, origin, directions)
        )

    def _weigh_lights(self, origin: Float64[np.ndarray, "3"], seen: FirstHits) -> None:
        """Set the sampling weights of lights for the visible points."""
        for name, weight in self._lights.weights(self._scene, origin, seen).items():
            self._parameters[name] = weight
        self._parameters.update()

    def _shaded(
        self, shader: Shader, camera: Camera, world_from_cam: Rigid3, centres: FirstHits, seed: int
    ) -> Float32[np.ndarray, "h w 3"]:
        """The picture from light that is known: a few rays a pixel, no paths."""
        origin, shape = world_from_cam.translation, (camera.height, camera.width)
        middle = shader.surface_light(origin, centres, shape)
        total = np.zeros((camera.height * camera.width, 3), np.float32)
        for k, offset_px in enumerate(_offsets(self._config.albedo_samples)):
            directions_world = _directions_cam(camera, offset_px) @ world_from_cam.rotation.T
            hits = (
                self._first_hits(camera, world_from_cam, offset_px)
                if offset_px != (0.0, 0.0)
                else centres
            )
            seen = shader.shade(
                origin, directions_world, hits, middle, np.random.default_rng([seed, k])
            )
            total += self._through_air(seen, hits.clear)
        return (total / self._config.albedo_samples).reshape(*shape, 3)

    def _traced(
        self, camera: Camera, world_from_cam: Rigid3, centres: FirstHits, seed: int
    ) -> Float32[np.ndarray, "h w 3"]:
        """The picture from light paths of its own, their noise filtered."""
        shape = (camera.height, camera.width)
        albedo, emission, clear = self._colours(camera, world_from_cam)
        self._weigh_lights(world_from_cam.translation, centres)
        radiance = self._trace(camera, world_from_cam, seed)
        normal, position = centres.normal.reshape(*shape, 3), centres.position.reshape(*shape, 3)
        light = filter_light(
            radiance,
            albedo,
            normal,
            position,
            centres.mirror.reshape(shape),
            self._config.light_filter,
        )
        return self._through_air(albedo * light + emission, clear)

    def _through_air(
        self, seen: Float32[np.ndarray, "*n 3"], clear: Float32[np.ndarray, "*n"]
    ) -> Float32[np.ndarray, "*n 3"]:
        if self._haze is None:
            return seen
        return clear[..., None] * seen + (1.0 - clear[..., None]) * np.array(
            self._haze.radiance, np.float32
        )

    def _first_hits(
        self, camera: Camera, world_from_cam: Rigid3, offset_px: tuple[float, float]
    ) -> FirstHits:
        directions_world = _directions_cam(camera, offset_px) @ world_from_cam.rotation.T
        haze_range = self._haze.range if self._haze is not None else np.inf
        return find_first_hits(
            self._scene, world_from_cam.translation, directions_world, haze_range
        )

    def _colours(
        self, camera: Camera, world_from_cam: Rigid3
    ) -> tuple[
        Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]
    ]:
        """Albedo, emission and clearness of the air, averaged over each pixel."""
        num, pixels = self._config.albedo_samples, camera.width * camera.height
        albedo, emission, clear = (
            np.zeros((pixels, 3), np.float32),
            np.zeros((pixels, 3), np.float32),
            np.zeros(pixels, np.float32),
        )
        for offset_px in _offsets(num):
            hits = self._first_hits(camera, world_from_cam, offset_px)
            albedo += hits.albedo + hits.sheen
            emission += hits.emission
            clear += hits.clear
        shape = (camera.height, camera.width)
        return (
            (albedo / num).reshape(*shape, 3),
            (emission / num).reshape(*shape, 3),
            (clear / num).reshape(shape),
        )

    def _trace(
        self, camera: Camera, world_from_cam: Rigid3, seed: int
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]]:
        """Return the light that surfaces reflect, in two pictures with independent noise."""
        import mitsuba as mi

        half = _whole_grid(self._config.samples // 2)
        sensor = _sensor(camera, world_from_cam, half)
        seeds = ((seed * _SEED_STEP + k * _HALF_STEP) % 2**32 for k in (0, 1))
        render: Any = mi.render  # its stub knows only the seeds of vectorised code
        first, second = (
            np.array(
                render(
                    self._scene, sensor=sensor, integrator=self._integrator, spp=half, seed=each
                ),
                np.float32,
            )
            for each in seeds
        )
        return first[:, :, :3], second[:, :, :3]


_SEED_STEP, _HALF_STEP = 0x9E3779B1, 0x85EBCA6B
"""Mitsuba gives a pixel the noise of the one before it at the next seed: seeds must lie far apart,
those of the two halves too."""
_NUM_AROUND = 400
_GOLDEN = 0.6180339887498949


def _directions_cam(camera: Camera, offset_px: tuple[float, float]) -> Float64[np.ndarray, "n 3"]:
    """Unit directions through all pixels, row by row, each at the same offset from its centre."""
    x, y = np.meshgrid(
        np.arange(camera.width) + offset_px[0], np.arange(camera.height) + offset_px[1]
    )
    return camera.rays_from_img(np.column_stack([x.ravel(), y.ravel()]))


def _offsets(num: int) -> list[tuple[float, float]]:
    """Return the positions of a pixel's rays in the pixel, on the golden ratio's lattice. For any
    number, both coordinates are evenly spread."""
    return [((k + 0.5) / num - 0.5, (0.5 + k * _GOLDEN) % 1.0 - 0.5) for k in range(num)]


def _whole_grid(samples: int) -> int:
    """The number of samples that Mitsuba's grid of them has, which must not have gaps."""
    side = max(1, isqrt(samples))
    return side * max(1, -(-samples // side))


def _integrator(scene: Scene, config: RenderConfig) -> Any:
    import mitsuba as mi

    # Only this one lets light through panes and between leaves on its way from a lamp, but it takes
    # half as long again.
    see_through = any(
        surface.material.kind == "glass" or surface.material.opacity is not None
        for surface in scene.surfaces
    )
    kind = "volpath" if see_through else "path"
    return mi.load_dict(
        {"type": kind, "max_depth": config.bounces + 1, "rr_depth": 100, "hide_emitters": True}
    )


def _sensor(camera: Camera, world_from_cam: Rigid3, samples: int) -> Any:
    import mitsuba as mi

    film = {
        "type": "hdrfilm",
        "width": camera.width,
        "height": camera.height,
        "pixel_format": "rgb",
        "rfilter": {"type": "box"},
    }
    sensor = {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2.0 * np.arctan(camera.width / (2.0 * camera.fx)))),
        # Mitsuba counts from the image's border, in image sizes, and moves the picture where we
        # move its centre.
        "principal_point_offset_x": 0.5 - (camera.cx + 0.5) / camera.width,
        "principal_point_offset_y": 0.5 - (camera.cy + 0.5) / camera.height,
        "near_clip": 0.01,
        "far_clip": 10000.0,
        # Its cameras look along +z as ours do, but have x to the left and y up.
        "to_world": mi.ScalarTransform4f(world_from_cam.matrix() @ np.diag([-1.0, -1.0, 1.0, 1.0])),
        "film": film,
        "sampler": {"type": "multijitter", "sample_count": samples},
    }
    return mi.load_dict(sensor)
