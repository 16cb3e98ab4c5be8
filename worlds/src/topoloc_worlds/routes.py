"""Convert a closed line on the ground to the path of a camera in time, with the sway of a walker or
a car.

The path is a function of time, because motion blur needs poses between frames. It is smooth: a
Gaussian kernel rounds the line's corners, and the sway is band-limited, with the bands and sizes of
human gait and of a car on its springs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64

from topoloc.errors import TopolocError
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc_worlds.noise import rng_of

Motion = Literal["walk", "drive"]

_STEPS_PER_RADIUS = 40
_SIGMA_PER_RADIUS = 1.13
"""A right angle smoothed by a Gaussian of this width (in radii) has a smallest radius of curvature
of 1."""
_NUM_WAVES = 16
_AXES = ("forward", "left", "up", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class RouteConfig:
    """Define the motion along the closed line of a world.

    Attributes:
        laps: rounds of the line; fractions are allowed.
        length: metres along the line instead of `laps`.
        num_frames: stop after this number of frames.
        spacing: metres between frames on the straight. Frames come closer in bends, because motion
            is slower there.
        speed: metres a second on the straight. With `spacing` it gives the frame rate.
        start: metres along the line from its first corner to the first frame.
        lateral: metres to the left of the line, in the direction of travel.
        reverse: go round in the opposite direction.
        look: radians that the camera is turned to the left of the direction of travel.
        motion: kind of sway.
        wobble: size of the sway, 1 is natural, 0 none.
        shake: size of the faster tremble of a hand-held camera, 1 is natural, 0 none.
        corner_radius: smallest radius of the bends, metres.
        turn_rate: approximate largest change of direction, radians a second. Motion slows down in
            bends.
        seed: another seed is another walk on the same line.
        mounting: rows of the 3x4 matrix rig_from_cam of a camera on a rig, whose frame then moves
            along the line.
    """

    laps: float = 1.0
    length: float | None = None
    num_frames: int | None = None
    spacing: float = 0.1
    speed: float = 0.5
    start: float = 0.0
    lateral: float = 0.0
    reverse: bool = False
    look: float = 0.0
    motion: Motion = "walk"
    wobble: float = 1.0
    shake: float = 0.0
    corner_radius: float = 0.5
    turn_rate: float = float(np.radians(40.0))
    seed: int = 0
    mounting: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        positive = {
            "laps": self.laps,
            "spacing": self.spacing,
            "speed": self.speed,
            "corner radius": self.corner_radius,
        }
        positive |= {
            "turn rate": self.turn_rate,
            "length": self.length,
            "number of frames": self.num_frames,
        }
        for name, value in positive.items():
            if value is not None and not 0 < value < np.inf:
                raise TopolocError(f"route: the {name} must be positive, not {value:g}")
        for name, value in {"wobble": self.wobble, "shake": self.shake}.items():
            if not 0 <= value < np.inf:
                raise TopolocError(f"route: the {name} cannot be {value:g}")


@dataclass(frozen=True)
class _Band:
    """Movement along one axis: root mean square (metres or radians) of waves between two
    frequencies (Hz)."""

    axis: str
    low_hz: float
    high_hz: float
    rms: float


def _deg(angle: float) -> float:
    return float(np.radians(angle))


_SWAY: dict[Motion, tuple[_Band, ...]] = {
    # Slow wandering of body and gaze, then the steps: up and down with each, from side to side with
    # every second one.
    "walk": (
        _Band("forward", 0.1, 0.4, 0.02),
        _Band("left", 0.05, 0.3, 0.045),
        _Band("up", 0.05, 0.3, 0.01),
        _Band("yaw", 0.05, 0.4, _deg(2.5)),
        _Band("pitch", 0.05, 0.4, _deg(1.5)),
        _Band("roll", 0.05, 0.4, _deg(0.8)),
        _Band("left", 0.75, 0.95, 0.012),
        _Band("up", 1.5, 1.9, 0.012),
        _Band("yaw", 0.75, 0.95, _deg(0.5)),
        _Band("pitch", 1.5, 1.9, _deg(0.4)),
        _Band("roll", 0.75, 0.95, _deg(0.5)),
    ),
    "drive": (
        _Band("left", 0.02, 0.1, 0.1),
        _Band("up", 0.8, 1.6, 0.01),
        _Band("yaw", 0.05, 0.3, _deg(0.3)),
        _Band("pitch", 0.8, 1.6, _deg(0.25)),
        _Band("roll", 0.5, 1.2, _deg(0.3)),
    ),
}
_TREMBLE = (
    *(_Band(axis, 3.0, 7.0, _deg(0.35)) for axis in ("roll", "pitch", "yaw")),
    *(_Band(axis, 2.0, 5.0, 0.003) for axis in ("forward", "left", "up")),
)


@dataclass(frozen=True, eq=False)
class _Waves:
    """Cosines of one axis each: ``amplitude * cos(omega * t + phase)``."""

    axis_idx: np.ndarray
    amplitude: Float64[np.ndarray, " w"]
    omega: Float64[np.ndarray, " w"]
    phase: Float64[np.ndarray, " w"]


@dataclass(frozen=True, eq=False)
class Route:
    """Hold a camera's path in time, for `world_from_cam_at` and `frame_poses`.

    `points` are one lap, closed (the last is the first again), and `yaw` the direction there.
    `travelled` is the distance (metres) to each point, `paced` the distance that the same time
    would give at the speed of the straight.
    """

    config: RouteConfig
    camera_height: float
    points: Float64[np.ndarray, "n 2"]
    yaw: Float64[np.ndarray, " n"]
    travelled: Float64[np.ndarray, " n"]
    paced: Float64[np.ndarray, " n"]
    num_frames: int
    waves: _Waves

    @property
    def t_ns(self) -> list[int]:
        """The time of each frame: a steady rate from 0."""
        return [
            round(i * self.config.spacing / self.config.speed * 1e9) for i in range(self.num_frames)
        ]

    @property
    def length(self) -> float:
        """Metres along the line from the first frame to the last."""
        return _travelled_at(self, (self.num_frames - 1) * self.config.spacing)


def plan_route(
    loop: tuple[tuple[float, float], ...], camera_height: float, config: RouteConfig
) -> Route:
    """Round the corners of a closed line (x, y in metres, in order) and lay out the frames on it.

    Raises:
        TopolocError: fewer than three corners, or `config.lateral` is more than the line's bends
            allow.
    """
    corners = np.asarray(loop, dtype=np.float64)
    if corners.ndim != 2 or len(corners) < 3:
        raise TopolocError(f"route: a closed line has at least three corners, not {len(corners)}")
    if config.reverse:
        corners = np.concatenate([corners[:1], corners[:0:-1]])
    points = _rounded(_beside(corners, config.lateral), config.corner_radius)
    closed = np.concatenate([points, points[:1]])
    steps = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    ahead = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    yaw = np.append(yaw, yaw[0] + 2 * np.pi * round((yaw[-1] - yaw[0]) / (2 * np.pi)))
    effort = np.hypot(steps, np.diff(yaw) * config.speed / config.turn_rate)
    travelled, paced = (np.concatenate([[0.0], np.cumsum(part)]) for part in (steps, effort))
    bare = Route(config, camera_height, closed, yaw, travelled, paced, 1, _waves(config))
    total = config.laps * paced[-1]
    if config.length is not None:
        total = _paced_at(bare, config.start + config.length) - _paced_at(bare, config.start)
    num_frames = int(total / config.spacing + 1e-6) + 1
    if config.num_frames is not None:
        num_frames = min(num_frames, config.num_frames)
    return Route(config, camera_height, closed, yaw, travelled, paced, num_frames, bare.waves)


def frame_poses(route: Route) -> list[Rigid3]:
    """world_from_cam of each frame."""
    return [
        world_from_cam_at(route, i * route.config.spacing / route.config.speed)
        for i in range(route.num_frames)
    ]


def world_from_cam_at(route: Route, t: float) -> Rigid3:
    """The camera's pose `t` seconds after the first frame: x right, y down, z forward; world z
    up."""
    at = (_paced_at(route, route.config.start) + t * route.config.speed) % route.paced[-1]
    x, y, heading = (
        float(np.interp(at, route.paced, values)) for values in (*route.points.T, route.yaw)
    )
    forward, left, up, roll, pitch, yaw = _sway(route.waves, t)
    direction, side = (
        np.array([np.cos(heading), np.sin(heading), 0.0]),
        np.array([-np.sin(heading), np.cos(heading), 0.0]),
    )
    centre = np.array([x, y, route.camera_height + up]) + forward * direction + left * side
    facing = heading + route.config.look
    c, s = np.cos(facing), np.sin(facing)
    level = np.array([[s, 0.0, c], [-c, 0.0, s], [0.0, -1.0, 0.0]])
    world_from_rig = Rigid3(level @ exp_so3(np.array([pitch, -yaw, roll])), centre)
    if route.config.mounting is None:
        return world_from_rig
    return world_from_rig @ Rigid3.from_json([list(row) for row in route.config.mounting])


def velocity_at(route: Route, t: float, interval: float = 0.02) -> Float[np.ndarray, "3"]:
    """The camera's velocity in the world, m/s, as the mean over `interval` seconds."""
    before, after = (
        world_from_cam_at(route, t + sign * interval / 2).translation for sign in (-1, 1)
    )
    return (after - before) / interval


def _paced_at(route: Route, travelled: float) -> float:
    laps, rest = divmod(travelled, route.travelled[-1])
    return float(laps * route.paced[-1] + np.interp(rest, route.travelled, route.paced))


def _travelled_at(route: Route, paced: float) -> float:
    """Metres made along the line when, from the start on, `paced` metres would have been made on
    the straight."""
    laps, rest = divmod(_paced_at(route, route.config.start) + paced, route.paced[-1])
    return (
        float(laps * route.travelled[-1] + np.interp(rest, route.paced, route.travelled))
        - route.config.start
    )


def _beside(corners: Float64[np.ndarray, "n 2"], lateral: float) -> Float64[np.ndarray, "n 2"]:
    """The corners of the line `lateral` metres to the left of a closed one."""
    edges = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(edges, axis=1)
    if np.any(lengths == 0.0):
        raise TopolocError("route: a corner is named twice")
    normals = np.column_stack([-edges[:, 1], edges[:, 0]]) / lengths[:, None]
    before = np.roll(normals, 1, axis=0)
    sharpness = np.maximum(1.0 + np.sum(before * normals, axis=1), 1e-9)
    moved = corners + lateral * (before + normals) / sharpness[:, None]
    if np.any(np.sum((np.roll(moved, -1, axis=0) - moved) * edges, axis=1) <= 0.0):
        raise TopolocError(f"route: {lateral:g} m beside the line is more than its bends allow")
    return moved


def _rounded(corners: Float64[np.ndarray, "n 2"], radius: float) -> Float64[np.ndarray, "m 2"]:
    """Points at equal steps along a closed line, smoothed by a Gaussian along it."""
    closed = np.concatenate([corners, corners[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    num_points = max(int(np.ceil(along[-1] / radius * _STEPS_PER_RADIUS)), 100)
    at = np.arange(num_points) * (along[-1] / num_points)
    points = np.column_stack([np.interp(at, along, closed[:, axis]) for axis in (0, 1)])
    frequency = 2 * np.pi * np.fft.rfftfreq(num_points, d=along[-1] / num_points)
    kernel = np.exp(-0.5 * (frequency * _SIGMA_PER_RADIUS * radius) ** 2)
    return np.fft.irfft(np.fft.rfft(points, axis=0) * kernel[:, None], n=num_points, axis=0)


def _waves(config: RouteConfig) -> _Waves:
    """Every band as cosines of random phase, one in each of equal parts of the band: smooth for
    ever, repeating never."""
    sized = [(band, config.wobble, f"{i}") for i, band in enumerate(_SWAY[config.motion])]
    sized += [(band, config.shake, f"shake {i}") for i, band in enumerate(_TREMBLE)]
    axis_idx, amplitude, omega, phase = [], [], [], []
    for band, scale, name in sized:
        rng = rng_of(config.seed, f"sway/{config.motion}/{name}")
        frequency = (
            band.low_hz
            + (band.high_hz - band.low_hz)
            * (np.arange(_NUM_WAVES) + rng.uniform(size=_NUM_WAVES))
            / _NUM_WAVES
        )
        axis_idx.append(np.full(_NUM_WAVES, _AXES.index(band.axis)))
        amplitude.append(np.full(_NUM_WAVES, scale * band.rms * np.sqrt(2.0 / _NUM_WAVES)))
        omega.append(2 * np.pi * frequency)
        phase.append(rng.uniform(0.0, 2 * np.pi, _NUM_WAVES))
    return _Waves(
        np.concatenate(axis_idx), *(np.concatenate(part) for part in (amplitude, omega, phase))
    )


def _sway(waves: _Waves, t: float) -> Float64[np.ndarray, "6"]:
    """Displacement and rotation along each of `_AXES`."""
    moved = waves.amplitude * np.cos(waves.omega * t + waves.phase)
    return np.bincount(waves.axis_idx, moved, minlength=len(_AXES))
