"""Define the corridor's plan: eight walls round a closed loop, their openings, and the placement of
objects on a wall.

Everything on a wall is built in the wall's own frame: x to the right for a viewer in front of it, y
into the wall, z up. The corridor is at y < 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from topoloc_worlds.noise import rng_of
from topoloc_worlds.scene import Material, Mesh, Surface
from topoloc_worlds.shapes import Vector, box, join, placed

LENGTH, WIDTH, HEIGHT = 25.0, 18.0, 2.8
SOUTH, EAST, NORTH, WEST = 2.4, 2.2, 2.2, 2.4
"""Width of the four wings."""
LOOP = (
    (WEST / 2, SOUTH / 2),
    (LENGTH - EAST / 2, SOUTH / 2),
    (LENGTH - EAST / 2, WIDTH - NORTH / 2),
    (WEST / 2, WIDTH - NORTH / 2),
)
"""Corners of the centre line."""
DOOR_WIDTH, DOOR_HEIGHT = 1.06, 2.12
WALL_THICKNESS = 0.16


@dataclass(frozen=True)
class Opening:
    """A hole in a wall from `left` to `right`, from the floor up to `top`."""

    kind: Literal["door", "room", "lift", "niche", "windows"]
    left: float
    right: float
    top: float

    @property
    def centre(self) -> float:
        return 0.5 * (self.left + self.right)


@dataclass(frozen=True)
class Wall:
    """One side of one wing. `start` is its left end on the floor, `yaw` turns the world's x axis
    along it."""

    name: str
    start: tuple[float, float]
    yaw: float
    length: float
    openings: tuple[Opening, ...] = ()


_BARE_WALLS = (
    Wall("south outer", (LENGTH, 0.0), np.pi, LENGTH),
    Wall("east outer", (LENGTH, WIDTH), -np.pi / 2, WIDTH),
    Wall("north outer", (0.0, WIDTH), 0.0, LENGTH),
    Wall("west outer", (0.0, 0.0), np.pi / 2, WIDTH),
    Wall("south inner", (WEST, SOUTH), 0.0, LENGTH - WEST - EAST),
    Wall("east inner", (LENGTH - EAST, SOUTH), np.pi / 2, WIDTH - SOUTH - NORTH),
    Wall("north inner", (LENGTH - EAST, WIDTH - NORTH), np.pi, LENGTH - WEST - EAST),
    Wall("west inner", (WEST, WIDTH - NORTH), -np.pi / 2, WIDTH - SOUTH - NORTH),
)
# Stretches with doors, as (from, to, number); the rest of a wall is bare. Rooms stand open in some
# arrangements.
_DOORS = {
    "south outer": ((2.6, 9.6, 2), (17.4, 23.4, 2)),
    "east outer": ((1.4, 4.6, 1), (13.6, 16.4, 1)),
    "north outer": ((1.6, 9.4, 3), (18.6, 20.4, 1)),
    "west outer": ((1.4, 7.2, 2), (13.0, 16.6, 1)),
    "south inner": ((1.0, 4.0, 1), (14.6, 19.8, 2)),
    "east inner": ((1.2, 6.6, 2), (10.4, 12.6, 1)),
    "north inner": ((0.8, 5.2, 2), (15.6, 19.6, 1)),
    "west inner": ((0.8, 4.0, 1), (8.4, 12.4, 2)),
}
_ROOMS = {
    ("south outer", 1),
    ("south outer", 3),
    ("north outer", 0),
    ("west outer", 2),
    ("east outer", 1),
    ("north outer", 3),
}
_OTHERS = {
    "south inner": (Opening("windows", 4.6, 13.4, 2.62),),
    "east outer": (Opening("windows", 5.4, 12.6, 2.62),),
    "west outer": (Opening("niche", 8.4, 11.2, 2.4),),
    "east inner": (Opening("niche", 7.4, 9.2, 2.3),),
    "north outer": (Opening("lift", 21.6, 23.0, 2.2),),
}


def walls_of(seed: int) -> dict[str, Wall]:
    """Return the walls by name, with the doors of this seed."""
    return {wall.name: replace(wall, openings=_openings(wall.name, seed)) for wall in _BARE_WALLS}


def _openings(name: str, seed: int) -> tuple[Opening, ...]:
    rng = rng_of(seed, f"corridor/doors/{name}")
    openings = list(_OTHERS.get(name, ()))
    number = 0
    for start, end, count in _DOORS[name]:
        pitch = (end - start) / count
        for i in range(count):
            slack = max(0.0, 0.5 * (pitch - DOOR_WIDTH) - 0.25)
            centre = start + (i + 0.5) * pitch + rng.uniform(-slack, slack)
            kind = "room" if (name, number) in _ROOMS else "door"
            openings.append(
                Opening(kind, centre - DOOR_WIDTH / 2, centre + DOOR_WIDTH / 2, DOOR_HEIGHT)
            )
            number += 1
    return tuple(sorted(openings, key=lambda opening: opening.left))


def stretches(wall: Wall) -> list[tuple[float, float]]:
    """The pieces of wall between its openings, over the whole height."""
    ends = [
        0.0,
        *(x for opening in wall.openings for x in (opening.left, opening.right)),
        wall.length,
    ]
    return [
        (left, right)
        for left, right in zip(ends[::2], ends[1::2], strict=True)
        if right - left > 1e-6
    ]


def wall_mesh(wall: Wall) -> Mesh:
    """The wall without its openings; the picture covers it once from end to end."""
    pieces = [(left, right, 0.0, HEIGHT) for left, right in stretches(wall)]
    pieces += [(opening.left, opening.right, opening.top, HEIGHT) for opening in wall.openings]
    meshes = []
    for left, right, low, high in pieces:
        corners = np.array(
            [[left, 0.0, high], [left, 0.0, low], [right, 0.0, low], [right, 0.0, high]]
        )
        uv = np.column_stack([corners[:, 0] / wall.length, 1.0 - corners[:, 2] / HEIGHT])
        meshes.append(Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), uv))
    return on_wall_mesh(wall, join(meshes))


def skirting_mesh(wall: Wall) -> Mesh:
    """The board along the foot of the wall."""
    return on_wall_mesh(
        wall,
        join([box((left, -0.012, 0.0), (right, 0.0, 0.09)) for left, right in stretches(wall)]),
    )


def on_wall_mesh(wall: Wall, mesh: Mesh, x: float = 0.0) -> Mesh:
    c, s = np.cos(wall.yaw), np.sin(wall.yaw)
    return placed(mesh, (wall.start[0] + c * x, wall.start[1] + s * x, 0.0), wall.yaw)


def on_wall(wall: Wall, x: float, surfaces: list[Surface]) -> list[Surface]:
    """Things of the wall's frame put up `x` metres from its left end."""
    return [replace(surface, mesh=on_wall_mesh(wall, surface.mesh, x)) for surface in surfaces]


def shifted(surfaces: list[Surface], at: Vector, yaw: float = 0.0) -> list[Surface]:
    """Things turned by `yaw` and moved by `at` within one frame."""
    return [replace(surface, mesh=placed(surface.mesh, at, yaw)) for surface in surfaces]


def solid(name: str, material: Material, *meshes: Mesh) -> Surface:
    return Surface(name, join(meshes), material)
