"""One frame of a recording: rendered, rained upon, and taken by the sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc_worlds.conditions import Condition
from topoloc_worlds.noise import rng_of
from topoloc_worlds.rendering.renderer import Renderer, Rendering
from topoloc_worlds.routes import Route, velocity_at, world_from_cam_at
from topoloc_worlds.sensor import SensorConfig, choose_exposure, take_picture, white_balance_of
from topoloc_worlds.weather import Drops, draw_lens_drops, draw_rain, falling_drops


@dataclass(frozen=True, eq=False)
class Shooting:
    """Hold the common settings of all frames of a recording.

    Attributes:
        renderer: the world under `condition`.
        baseline: metres to the right camera; None without one.
        num_renderings: moments of the exposure over which the light is averaged; 1 has no motion
            blur.
        lens_drops: drops on each lens.
        rain: whether the condition's rain falls here.
    """

    renderer: Renderer
    condition: Condition
    route: Route
    camera: Camera
    baseline: float | None
    sensor: SensorConfig
    num_renderings: int = 1
    lens_drops: int = 0
    rain: bool = False


@dataclass(frozen=True, eq=False)
class Shot:
    """The pictures of one moment; `depth` is the left camera's, metres, NaN in the sky."""

    left: UInt8[np.ndarray, "h w 3"]
    right: UInt8[np.ndarray, "h w 3"] | None
    depth: Float32[np.ndarray, "h w"]


def shoot(shooting: Shooting, index: int) -> Shot:
    """Take frame `index`: the same bytes whenever and in whatever order frames are taken. Both
    pictures share one exposure."""
    t = index * shooting.route.config.spacing / shooting.route.config.speed
    seed = shooting.route.config.seed
    middle = _render(shooting, t, "left", index, 0)
    exposure = choose_exposure(middle.radiance, shooting.sensor)
    white_balance = white_balance_of(shooting.condition, seed, shooting.sensor)
    drops = _drops(shooting, t, index)
    pictures: dict[str, UInt8[np.ndarray, "h w 3"]] = {}
    for side in ("left", "right") if shooting.baseline is not None else ("left",):
        rendering = middle if side == "left" else _render(shooting, t, side, index, 0)
        light = _while_open(shooting, t, side, index, exposure.time, rendering.radiance)
        if drops is not None:
            light = draw_rain(
                light,
                rendering.depth,
                shooting.camera,
                _cam_from_left(shooting, side),
                drops,
                exposure.time,
            )
        if shooting.lens_drops:
            light = draw_lens_drops(light, shooting.lens_drops, rng_of(seed, f"lens drops/{side}"))
        noise = rng_of(seed, f"sensor/{index}/{side}")
        pictures[side] = take_picture(light, exposure, shooting.sensor, noise, white_balance)
    return Shot(pictures["left"], pictures.get("right"), middle.depth)


def _render(shooting: Shooting, t: float, side: str, index: int, moment: int) -> Rendering:
    world_from_cam = world_from_cam_at(shooting.route, t) @ _cam_from_left(shooting, side).inverse()
    seed = int(
        rng_of(shooting.route.config.seed, f"render/{index}/{side}/{moment}").integers(2**31)
    )
    return shooting.renderer.render(shooting.camera, world_from_cam, seed)


def _while_open(
    shooting: Shooting,
    t: float,
    side: str,
    index: int,
    time: float,
    middle: Float32[np.ndarray, "h w 3"],
) -> Float32[np.ndarray, "h w 3"]:
    """The mean light of the moments of an exposure around `t`; `middle` is that of the moment in
    the middle."""
    num = shooting.num_renderings
    total = np.zeros(middle.shape, np.float64)
    for moment in range(num):
        offset = (moment + 0.5) / num - 0.5
        total += (
            middle
            if offset == 0.0
            else _render(shooting, t + offset * time, side, index, moment + 1).radiance
        )
    return (total / num).astype(np.float32)


def _drops(shooting: Shooting, t: float, index: int) -> Drops | None:
    if not (shooting.rain and shooting.condition.rain):
        return None
    rng = rng_of(shooting.route.config.seed, f"rain/{index}")
    pose, velocity = world_from_cam_at(shooting.route, t), velocity_at(shooting.route, t)
    return falling_drops(shooting.condition.rain, shooting.camera, pose, velocity, rng)


def _cam_from_left(shooting: Shooting, side: str) -> Rigid3:
    shift: Float64[np.ndarray, "3"] = np.zeros(3)
    if side == "right" and shooting.baseline is not None:
        shift[0] = -shooting.baseline
    return Rigid3(np.eye(3), shift)
