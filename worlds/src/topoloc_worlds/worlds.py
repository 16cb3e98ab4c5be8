"""The worlds that can be rendered, by name."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np
from jaxtyping import Float64

from topoloc.errors import TopolocError
from topoloc_worlds.conditions import Condition
from topoloc_worlds.routes import Motion, RouteConfig, frame_poses, plan_route
from topoloc_worlds.scene import Scene


@dataclass(frozen=True)
class World:
    """Describe a place that code builds, with its default recording settings. Its module is
    imported on use.

    Attributes:
        module: has ``build(seed, condition, arrangement)``, ``LOOP`` and ``CAMERA_HEIGHT``.
        outdoor: whether rain falls here.
        speed: metres a second of the walker or car.
        spacing: metres between frames.
        corner_radius: metres, of the bends.
        baseline: metres between left and right camera.
        depth_factor: units a metre of depth images of 16 bits.
        view_spacing: metres along the line between the positions from which light is traced.
        view_offsets: metres to the left of the line, of the same positions.
    """

    name: str
    summary: str
    module: str
    outdoor: bool = False
    motion: Motion = "walk"
    speed: float = 0.5
    spacing: float = 0.08
    corner_radius: float = 0.4
    baseline: float = 0.12
    depth_factor: float = 5000.0
    view_spacing: float = 0.4
    view_offsets: tuple[float, ...] = (-0.3, 0.3)

    def build(self, seed: int, condition: Condition, arrangement: int = 0) -> Scene:
        """Build all visible surfaces. Another seed is another place of the kind. `arrangement`
        moves the movable objects."""
        return self._module().build(seed, condition, arrangement)

    @property
    def loop(self) -> tuple[tuple[float, float], ...]:
        """Corners (x, y) of the closed line that is walked or driven."""
        return self._module().LOOP

    @property
    def camera_height(self) -> float:
        """Metres above the floor."""
        return float(self._module().CAMERA_HEIGHT)

    def route(self) -> RouteConfig:
        """One natural lap."""
        return RouteConfig(
            spacing=self.spacing,
            speed=self.speed,
            motion=self.motion,
            corner_radius=self.corner_radius,
        )

    def viewpoints(self) -> Float64[np.ndarray, "n 3"]:
        """Return positions all over the camera's usual paths, for `Renderer`."""
        still = replace(self.route(), spacing=self.view_spacing, wobble=0.0)
        routes = [
            plan_route(self.loop, self.camera_height, replace(still, lateral=offset))
            for offset in self.view_offsets
        ]
        return np.array([pose.translation for route in routes for pose in frame_poses(route)])

    def _module(self) -> ModuleType:
        return importlib.import_module(self.module)


WORLDS = {
    world.name: world
    for world in (
        World(
            "lab",
            "a room of 5 x 4 m: desks, shelves, screens, clutter",
            "topoloc_worlds.lab.world",
        ),
        World(
            "corridor",
            "a loop of 25 x 18 m: doors, notice boards, windows to the floor, polished linoleum,"
            " long bare walls",
            "topoloc_worlds.corridor.world",
            speed=1.2,
            spacing=0.2,
            corner_radius=0.7,
            depth_factor=2000.0,
            view_spacing=0.7,
            view_offsets=(-0.4, 0.4),
        ),
        World(
            "hospital",
            "a loop of 21 x 13 m: walls of panels a metre wide, each the copy of the next; a door"
            " now and then",
            "topoloc_worlds.hospital.world",
            speed=1.2,
            spacing=0.2,
            corner_radius=0.6,
            depth_factor=2000.0,
            view_spacing=0.8,
            view_offsets=(-0.4, 0.4),
        ),
        World(
            "street",
            "a loop of 333 x 81 m: lanes, façades, trees, parked cars, signs, sky",
            "topoloc_worlds.street.world",
            outdoor=True,
            motion="drive",
            speed=8.0,
            spacing=0.8,
            corner_radius=6.0,
            baseline=0.54,
            depth_factor=200.0,
            view_spacing=8.0,
            view_offsets=(0.0, 3.5),
        ),
    )
}


def find_world(name: str) -> World:
    """A world by its name. Raises TopolocError, with the list of names."""
    try:
        return WORLDS[name]
    except KeyError:
        raise TopolocError(f"unknown world {name!r}; worlds: {', '.join(WORLDS)}") from None
