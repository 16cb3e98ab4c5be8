"""Frames of CARLA (Dosovitskiy et al., CoRL 2017): stereo, depth and pose along a lane, by CARLA's
own client.

The simulator runs synchronously: one step a frame, and what each camera saw in that very step. The
cameras hang on nothing; they stand where the lane is, `spacing_m` further on each step, at a height
above it and beside its middle. No vehicle, no physics: the same settings give the same way.

CARLA's world is Unreal's: x forward, y right, z up, left-handed. Ours mirrors y.
"""

from __future__ import annotations

import math
import queue
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from topoloc import (
    Camera,
    ConfigError,
    DepthImage,
    Image,
    MissingExtraError,
    PoseConventions,
    RecordingError,
    Rigid3,
    StereoFrame,
    StereoRig,
    TrajectoryError,
)

Weather = Literal["clear", "cloudy", "rain"]
WEATHERS: dict[Weather, str] = {
    "clear": "ClearNoon",
    "cloudy": "CloudyNoon",
    "rain": "HardRainNoon",
}
"""The paper's three, by CARLA's names."""
_MAX_DEPTH_M = 1000.0  # the depth camera's whole range: sky
_WARM_UP = 20  # steps until exposure and streamed textures have settled
_STEP_S = 0.1
_CONNECT_S = 5.0
_DISABLED_EFFECTS = (
    "lens_k",
    "lens_kcube",
    "lens_x_size",
    "lens_y_size",
    "lens_circle_multiplier",
    "chromatic_aberration_intensity",
)
_DISABLED_EFFECTS += (
    "motion_blur_intensity",
)  # the cameras do not move between steps, they are put elsewhere
_POSITION_TOLERANCE_M = 0.01


@dataclass(frozen=True)
class CarlaConfig:
    """What is recorded, and where; metres, degrees, pixels."""

    host: str = "localhost"
    port: int = 2000
    town: str | None = None
    weather: Weather = "clear"
    start: int = 0
    length_m: float = 300.0
    spacing_m: float = 0.5
    lane_offset_m: float = 0.0
    height_m: float = 1.6
    baseline_m: float = 0.5
    width: int = 800
    height: int = 600
    fov_deg: float = 90.0
    timeout_s: float = 20.0


def carla_client(config: CarlaConfig) -> tuple[Any, Any]:
    """CARLA's package, and its client, connected.

    Raises:
        MissingExtraError: the extra `carla` is not installed.
        RecordingError: no server answers.
    """
    try:
        import carla  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingExtraError(
            "recording CARLA needs its client: pip install 'topoloc[carla]'"
        ) from None
    client = carla.Client(config.host, config.port)
    client.set_timeout(_CONNECT_S)
    try:
        client.get_server_version()
    except RuntimeError:
        raise RecordingError(
            f"no CARLA server answers at {config.host}:{config.port}; start CarlaUE4.sh (or its"
            " container) first"
        ) from None
    client.set_timeout(config.timeout_s)
    return carla, client


def world_from_carla_transform(transform: Any) -> Rigid3:
    """The pose in our axes of a camera that stands in CARLA as this `carla.Transform`. Raises
    RecordingError: it is no pose."""
    try:
        pose = Rigid3.from_matrix(np.array(transform.get_matrix()))
        return PoseConventions(("unreal",)).undo_conventions(pose)
    except TrajectoryError as error:
        raise RecordingError(f"CARLA gave a camera no pose ({error})") from None


def carla_camera(config: CarlaConfig) -> Camera:
    """The pinhole that CARLA's cameras are. Raises ConfigError: of no size, or of no angle."""
    if not (config.width > 0 and config.height > 0 and 1.0 <= config.fov_deg <= 170.0):
        raise ConfigError(
            f"no camera: {config.width}x{config.height} pixels, {config.fov_deg:g} degrees"
        )
    focal = config.width / (2.0 * math.tan(math.radians(config.fov_deg) / 2.0))
    return Camera.pinhole(
        config.width,
        config.height,
        focal,
        focal,
        (config.width - 1) / 2.0,
        (config.height - 1) / 2.0,
    )


def carla_frames(carla: Any, client: Any, config: CarlaConfig) -> Iterator[StereoFrame]:
    """Frame by frame along the lane from spawn point `start` on; the server is left as it was when
    the iterator is closed.

    Raises:
        ConfigError: a setting makes no sense; RecordingError: the server lacks the town or the
            spawn point, does not answer in time, or gives pictures of another step.
    """
    camera = carla_camera(config)
    if not (config.spacing_m > 0.0 and config.baseline_m > 0.0 and config.length_m > 0.0):
        raise ConfigError(
            "the spacing of the frames, the length of the way and the baseline must be above 0 m"
        )
    rig = StereoRig.rectified(camera, config.baseline_m)
    try:
        world = client.load_world(config.town) if config.town is not None else client.get_world()
        with _synchronous_mode(carla, world, config.weather), ExitStack() as stack:
            shots = _SensorReader(
                world,
                [
                    stack.enter_context(_spawn_sensor(carla, world, kind, config))
                    for kind in ("rgb", "rgb", "depth")
                ],
                config.timeout_s,
            )
            for index, transform in enumerate(_lane_transforms(carla, world, config)):
                places = [
                    transform,
                    _offset_transform(carla, transform, config.baseline_m, 0.0),
                    transform,
                ]
                for _ in range(_WARM_UP if index == 0 else 0):
                    shots.capture(places)
                yield _make_frame(index, shots.capture(places), camera, rig)
    except RuntimeError as error:  # the client's own, of time limits and of what the server lacks
        raise RecordingError(
            f"CARLA at {config.host}:{config.port}: {' '.join(str(error).split())[:200]}"
        ) from None


class _SensorReader:
    """The sensors, and what they saw in a step."""

    def __init__(
        self, world: Any, sensors: list[tuple[Any, queue.Queue[Any]]], timeout_s: float
    ) -> None:
        self._world, self._sensors, self._timeout_s = world, sensors, timeout_s

    def capture(self, transforms: list[Any]) -> list[Any]:
        """Each sensor's picture of the next step, taken from these places."""
        for (sensor, _), transform in zip(self._sensors, transforms, strict=True):
            sensor.set_transform(transform)
        step = self._world.tick()
        return [self._next_image(images, step) for _, images in self._sensors]

    def _next_image(self, images: queue.Queue[Any], step: int) -> Any:
        while True:
            try:
                picture = images.get(timeout=self._timeout_s)
            except queue.Empty:
                raise RecordingError(
                    f"CARLA gave no picture of step {step} for {self._timeout_s:g} s"
                ) from None
            if picture.frame == step:
                return picture
            if picture.frame > step:
                raise RecordingError(
                    f"CARLA gave a picture of step {picture.frame} instead of {step}: is another"
                    " client ticking it?"
                )


@contextmanager
def _synchronous_mode(carla: Any, world: Any, weather: Weather) -> Iterator[None]:
    """The server steps when it is told to; afterwards as before."""
    before, settings = world.get_settings(), world.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, _STEP_S
    world.apply_settings(settings)
    try:
        world.set_weather(getattr(carla.WeatherParameters, WEATHERS[weather]))
        yield
    finally:
        world.apply_settings(before)


@contextmanager
def _spawn_sensor(
    carla: Any, world: Any, kind: str, config: CarlaConfig
) -> Iterator[tuple[Any, queue.Queue[Any]]]:
    """A camera that stands anywhere, and the queue of its pictures."""
    blueprint = world.get_blueprint_library().find(f"sensor.camera.{kind}")
    wanted = {
        "image_size_x": config.width,
        "image_size_y": config.height,
        "fov": config.fov_deg,
    } | dict.fromkeys(_DISABLED_EFFECTS, 0)
    for name, value in wanted.items():
        if blueprint.has_attribute(name):
            blueprint.set_attribute(name, str(value))
    sensor, images = world.spawn_actor(blueprint, carla.Transform()), queue.Queue[Any]()
    sensor.listen(images.put)
    try:
        yield sensor, images
    finally:
        sensor.stop()
        sensor.destroy()


def _lane_transforms(carla: Any, world: Any, config: CarlaConfig) -> Iterator[Any]:
    """Where the left camera stands, frame by frame; the way ends where the lane does. At junctions
    it goes straight on."""
    town = world.get_map()
    starts = town.get_spawn_points()
    if not 0 <= config.start < len(starts):
        raise RecordingError(f"spawn point {config.start} of {len(starts)} in {town.name}")
    here = town.get_waypoint(starts[config.start].location)
    for _ in range(math.floor(config.length_m / config.spacing_m) + 1):
        yield _offset_transform(carla, here.transform, config.lane_offset_m, config.height_m)
        ahead = here.next(config.spacing_m)
        if not ahead:
            return
        here = min(ahead, key=_heading_change(here))


def _heading_change(here: Any) -> Callable[[Any], float]:
    yaw = here.transform.rotation.yaw
    return lambda ahead: abs((ahead.transform.rotation.yaw - yaw + 180.0) % 360.0 - 180.0)


def _offset_transform(carla: Any, transform: Any, right_m: float, up_m: float) -> Any:
    """The same orientation, metres to the right and up."""
    location, right = transform.location, transform.get_right_vector()
    moved = carla.Location(
        location.x + right_m * right.x,
        location.y + right_m * right.y,
        location.z + right_m * right.z + up_m,
    )
    return carla.Transform(moved, transform.rotation)


def _make_frame(index: int, images: list[Any], camera: Camera, rig: StereoRig) -> StereoFrame:
    left, right, depth = images
    world_from_cam, world_from_right = (
        world_from_carla_transform(left.transform),
        world_from_carla_transform(right.transform),
    )
    right_in_left = world_from_cam.inverse().apply(world_from_right.translation)
    if np.abs(right_in_left - np.array([rig.baseline, 0.0, 0.0])).max() > _POSITION_TOLERANCE_M:
        raise RecordingError(
            f"CARLA's cameras did not stand where they were put in step {left.frame}"
        )
    t_ns = round(left.timestamp * 1e9)
    seen = DepthImage(_depth_in_metres(depth), camera)
    return StereoFrame(
        f"{index:06d}", t_ns, _to_rgb(left), camera, _to_rgb(right), rig, seen, world_from_cam
    )


def _to_rgb(picture: Any) -> Image:
    return np.ascontiguousarray(_to_bgra(picture)[:, :, 2::-1])


def _depth_in_metres(picture: Any) -> Float32[np.ndarray, "h w"]:
    """Depth along z: 24 bits of a kilometre, red the least; NaN for the sky."""
    blue, green, red = (_to_bgra(picture)[:, :, channel].astype(np.float64) for channel in range(3))
    depth = (red + 256.0 * green + 65536.0 * blue) / (2.0**24 - 1.0) * _MAX_DEPTH_M
    return np.where(depth < _MAX_DEPTH_M, depth, np.nan).astype(np.float32)


def _to_bgra(picture: Any) -> np.ndarray:
    return np.frombuffer(picture.raw_data, np.uint8).reshape(picture.height, picture.width, 4)
