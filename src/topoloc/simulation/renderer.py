"""From a world and a camera's pose to what the camera sees: linear light, and exact depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from topoloc.errors import CalibrationError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.simulation.mitsuba_scene import load_scene
from topoloc.simulation.scene import Scene
from topoloc.simulation.variant import use_best_variant


@dataclass(frozen=True)
class RenderConfig:
    """How much work goes into a picture."""

    samples: int = 16
    bounces: int = 4

    @staticmethod
    def draft() -> RenderConfig:
        """About ten times faster."""
        return RenderConfig(samples=2, bounces=3)


@dataclass(frozen=True, eq=False)
class Rendering:
    """What one camera sees."""

    radiance: Float32[np.ndarray, "h w 3"]
    """Linear light."""
    depth: Float32[np.ndarray, "h w"]
    """Metres along the camera's z axis at the pixel centres; NaN in the sky."""


class Renderer:
    """A world loaded once, for many pictures."""

    def __init__(self, scene: Scene, config: RenderConfig | None = None) -> None:
        self._config = config or RenderConfig()
        use_best_variant()
        self._scene = load_scene(scene)

    def render(self, camera: Camera, world_from_cam: Rigid3, seed: int) -> Rendering:
        """One picture."""
        import mitsuba as mi

        path = mi.load_dict({"type": "path", "max_depth": self._config.bounces + 1})
        radiance = mi.render(self._scene, sensor=_sensor(camera, world_from_cam), integrator=path, spp=self._config.samples, seed=seed)
        depths = mi.load_dict({"type": "aov", "aovs": "d:depth"})
        distance = mi.render(self._scene, sensor=_sensor(camera, world_from_cam, centred=True), integrator=depths, spp=1, seed=seed)
        grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).reshape(-1, 2)
        along = camera.rays_from_img(grid.astype(np.float64))[:, 2].reshape(camera.height, camera.width)
        depth = np.asarray(distance, np.float64)[:, :, -1] * along
        depth[depth == 0.0] = np.nan
        return Rendering(np.array(radiance, np.float32)[:, :, :3], depth.astype(np.float32))


def _sensor(camera: Camera, world_from_cam: Rigid3, centred: bool = False):  # noqa: ANN202
    import mitsuba as mi

    if camera.is_distorted or abs(camera.fx / camera.fy - 1.0) > 1e-9:
        raise CalibrationError(f"only undistorted cameras with square pixels can be rendered, not {camera.model} {camera.params}")
    # Mitsuba's cameras look along +z with x to the left and y up.
    to_world = world_from_cam.matrix() @ np.diag([-1.0, -1.0, 1.0, 1.0])
    sensor = {
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2.0 * np.arctan(camera.width / (2.0 * camera.fx)))),
        "principal_point_offset_x": -((camera.cx + 0.5) / camera.width - 0.5),
        "principal_point_offset_y": -((camera.cy + 0.5) / camera.height - 0.5),
        "near_clip": 0.01,
        "far_clip": 10000.0,
        "to_world": mi.ScalarTransform4f(to_world),
        "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "pixel_format": "rgb", "rfilter": {"type": "box"}},
        "sampler": {"type": "stratified", "jitter": False, "sample_count": 1} if centred else {"type": "independent"},
    }
    return mi.load_dict(sensor)
