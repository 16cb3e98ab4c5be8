"""Record CARLA (Dosovitskiy et al., CoRL 2017): stereo, depth and poses along a lane.

The simulator runs synchronously, one step for each frame. The cameras are attached to nothing: they
are placed along the lane, without vehicle and physics, so the same settings give the same
trajectory. CARLA's world is that of Unreal: x forward, y right, z up, left-handed. Y is mirrored.
"""

from __future__ import annotations

import importlib
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
"""The weather of the paper by CARLA's names."""
_MAX_DEPTH_M = 1000.0  # range of the depth camera, and value of the sky
_WARM_UP = 20  # steps until exposure and streamed textures are stable
_STEP_S = 0.1
_CONNECT_S, _ANSWER_S = 5.0, 20.0
_DISABLED_EFFECTS = (
    "lens_k",
    "lens_kcube",
    "lens_x_size",
    "lens_y_size",
    "lens_circle_multiplier",
    "chromatic_aberration_intensity",
    "motion_blur_intensity",  # the cameras do not move between steps
)
_POSITION_TOLERANCE_M = 0.01


@dataclass(frozen=True)
class CarlaConfig:
    """Options of CARLA (metres, degrees)."""

    server: str = "localhost:2000"
    """Address HOST:PORT of the running server."""
    town: str | None = None
    """The town to load, such as Town10HD."""
    weather: Weather = "clear"
    """Weather of the paper: clear noon, cloudy noon, hard rain at noon."""
    start: int = 0
    """Spawn point at the start. The trajectory follows the lane, straight on at junctions."""
    length: float = 300.0
    """Length of the trajectory."""
    spacing: float = 0.5
    """Distance between frames."""
    lane_offset: float = 0.0
    """Offset to the right of the lane's middle, negative to the left."""
    height: float = 1.6
    """Height of the cameras above the lane."""
    baseline: float = 0.5
    """Distance from the left to the right camera."""
    fov: float = 90.0
    """Horizontal field of view."""


def carla_client(server: str) -> tuple[Any, Any]:
    """Return CARLA's package and a connected client. `server`: address HOST:PORT. Raises
    ConfigError: the address is malformed; MissingExtraError: the extra `carla` is not installed;
    RecordingError: no server answers."""
    host, _, port = server.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port[:6]) < 65536:
        raise ConfigError(f"--server {server[:80]} is no HOST:PORT")
    with MissingExtraError.on_import("recording CARLA needs its client", "carla"):
        carla: Any = importlib.import_module("carla")
    client = carla.Client(host, int(port))
    client.set_timeout(_CONNECT_S)
    try:
        client.get_server_version()
    except RuntimeError:
        raise RecordingError(
            f"no CARLA server answers at {server}; start CarlaUE4.sh (or its container) first"
        ) from None
    client.set_timeout(_ANSWER_S)
    return carla, client


def world_from_carla_transform(transform: Any) -> Rigid3:
    """Convert the `carla.Transform` of a camera to its pose. Raises RecordingError if it is no
    pose."""
    try:
        pose = Rigid3.from_matrix(np.array(transform.get_matrix()))
        return PoseConventions(("unreal",)).undo_conventions(pose)
    except TrajectoryError as error:
        raise RecordingError(f"CARLA gave an invalid pose ({error})") from None


def carla_camera(fov_deg: float, size: tuple[int, int]) -> Camera:
    """Return CARLA's pinhole camera. Raises ConfigError if size or field of view is invalid."""
    width, height = size
    if not (width > 0 and height > 0 and 1.0 <= fov_deg <= 170.0):
        raise ConfigError(f"no camera: {width}x{height} pixels, {fov_deg:g} degrees")
    focal = width / (2.0 * math.tan(math.radians(fov_deg) / 2.0))
    return Camera.pinhole(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0)


def carla_frames(
    carla: Any, client: Any, config: CarlaConfig, size: tuple[int, int]
) -> Iterator[StereoFrame]:
    """Yield the frames along a lane. The server's settings are restored at the end. `size`: width
    and height of the images, pixels. Raises ConfigError: a setting is invalid; RecordingError: the
    server lacks the town or the spawn point, does not answer in time, or gives images of another
    step."""
    camera = carla_camera(config.fov, size)
    if not (config.spacing > 0.0 and config.baseline > 0.0 and config.length > 0.0):
        raise ConfigError("--spacing, --length and --baseline must be above 0 m")
    rig = StereoRig.rectified(camera, config.baseline)
    try:
        world = client.load_world(config.town) if config.town is not None else client.get_world()
        with _synchronous_mode(carla, world, config.weather), ExitStack() as stack:
            sensors = [
                stack.enter_context(_spawn_sensor(carla, world, kind, config.fov, size))
                for kind in ("rgb", "rgb", "depth")
            ]
            for index, left in enumerate(_lane_transforms(carla, world, config)):
                right = _offset_transform(carla, left, config.baseline, 0.0)
                for _ in range(_WARM_UP if index == 0 else 0):
                    _capture(world, sensors, [left, right, left])
                images = _capture(world, sensors, [left, right, left])
                yield _make_frame(index, images, camera, rig)
    except RuntimeError as error:  # of the client: time limits and missing data of the server
        reason = " ".join(str(error).split())[:200]
        raise RecordingError(f"CARLA at {config.server}: {reason}") from None


def _capture(
    world: Any, sensors: list[tuple[Any, queue.Queue[Any]]], transforms: list[Any]
) -> list[Any]:
    """Place the sensors, run a step, and return their images of this step."""
    for (sensor, _), transform in zip(sensors, transforms, strict=True):
        sensor.set_transform(transform)
    step = world.tick()
    return [_next_image(images, step) for _, images in sensors]


def _next_image(images: queue.Queue[Any], step: int) -> Any:
    while True:
        try:
            image = images.get(timeout=_ANSWER_S)
        except queue.Empty:
            fault = f"CARLA gave no image of step {step} within {_ANSWER_S:g} s"
            raise RecordingError(fault) from None
        if image.frame == step:
            return image
        if image.frame > step:
            raise RecordingError(
                f"CARLA gave an image of step {image.frame} instead of {step}: does another client"
                " run steps?"
            )


@contextmanager
def _synchronous_mode(carla: Any, world: Any, weather: Weather) -> Iterator[None]:
    """Run the server in steps, with this weather. Restore its settings at the end."""
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
    carla: Any, world: Any, kind: str, fov_deg: float, size: tuple[int, int]
) -> Iterator[tuple[Any, queue.Queue[Any]]]:
    """Yield a camera and the queue of its images."""
    blueprint = world.get_blueprint_library().find(f"sensor.camera.{kind}")
    wanted = {"image_size_x": size[0], "image_size_y": size[1], "fov": fov_deg}
    for name, value in (wanted | dict.fromkeys(_DISABLED_EFFECTS, 0)).items():
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
    """Yield the transforms of the left camera until the lane ends, straight on at junctions."""
    town = world.get_map()
    starts = town.get_spawn_points()
    if not 0 <= config.start < len(starts):
        raise RecordingError(f"spawn point {config.start} of {len(starts)} in {town.name}")
    here = town.get_waypoint(starts[config.start].location)
    for _ in range(math.floor(config.length / config.spacing) + 1):
        yield _offset_transform(carla, here.transform, config.lane_offset, config.height)
        ahead = here.next(config.spacing)
        if not ahead:
            return
        here = min(ahead, key=_heading_change(here))


def _heading_change(here: Any) -> Callable[[Any], float]:
    yaw = here.transform.rotation.yaw
    return lambda ahead: abs((ahead.transform.rotation.yaw - yaw + 180.0) % 360.0 - 180.0)


def _offset_transform(carla: Any, transform: Any, right_m: float, up_m: float) -> Any:
    """Return a transform moved to the right and up (metres)."""
    here, right = transform.location, transform.get_right_vector()
    x, y, z = here.x + right_m * right.x, here.y + right_m * right.y, here.z + right_m * right.z
    return carla.Transform(carla.Location(x, y, z + up_m), transform.rotation)


def _make_frame(index: int, images: list[Any], camera: Camera, rig: StereoRig) -> StereoFrame:
    left, right, depth = images
    world_from_cam = world_from_carla_transform(left.transform)
    world_from_right = world_from_carla_transform(right.transform)
    right_in_left = world_from_cam.inverse().apply(world_from_right.translation)
    if np.abs(right_in_left - np.array([rig.baseline, 0.0, 0.0])).max() > _POSITION_TOLERANCE_M:
        raise RecordingError(f"CARLA's cameras had wrong positions in step {left.frame}")
    t_ns, metric = round(left.timestamp * 1e9), DepthImage(_depth_in_metres(depth), camera)
    return StereoFrame(
        f"{index:06d}", t_ns, _to_rgb(left), camera, _to_rgb(right), rig, metric, world_from_cam
    )


def _to_rgb(image: Any) -> Image:
    return np.ascontiguousarray(_to_bgra(image)[:, :, 2::-1])


def _depth_in_metres(image: Any) -> Float32[np.ndarray, "h w"]:
    """Return depth along z, NaN for the sky. It is coded in 24 bits, red the lowest byte."""
    blue, green, red = (_to_bgra(image)[:, :, channel].astype(np.float64) for channel in range(3))
    depth = (red + 256.0 * green + 65536.0 * blue) / (2.0**24 - 1.0) * _MAX_DEPTH_M
    return np.where(depth < _MAX_DEPTH_M, depth, np.nan).astype(np.float32)


def _to_bgra(image: Any) -> np.ndarray:
    return np.frombuffer(image.raw_data, np.uint8).reshape(image.height, image.width, 4)
