"""Define the hospital's plan: eight walls round a closed loop, divided into bays of a metre. Most
bays are panelled, a door takes two bays.

Everything on a wall is built in the wall's own frame, as in the corridor: x to the right for a
viewer in front of it, y into the wall, z up. The passage is at y < 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topoloc_worlds.corridor.plan import Wall
from topoloc_worlds.noise import rng_of

BAY = 1.0
"""Metres from one panel to the next."""
WING = 2.4
"""Width of the four wings, and of the squares where they meet."""
_LONG, _SHORT = 16, 8
"""Bays of a wing."""
LENGTH, WIDTH = _LONG * BAY + 2 * WING, _SHORT * BAY + 2 * WING
LOOP = (
    (WING / 2, WING / 2),
    (LENGTH - WING / 2, WING / 2),
    (LENGTH - WING / 2, WIDTH - WING / 2),
    (WING / 2, WIDTH - WING / 2),
)
"""Corners of the centre line."""
_FIRST_DOOR, _NEXT_DOOR = (1, 8), (8, 11)
"""Bays to the first door of a wall, and from one to the next: from, and below."""
_DOOR_BAYS = 2


@dataclass(frozen=True)
class PanelledWall:
    """Define one side of one wing.

    Attributes:
        wall: its place. Outer walls include the squares at both ends, which have no panels.
        first: metres from the wall's left end to its first bay.
        num_bays: number of bays of a metre each.
        doors: the first of the two bays of each door.
    """

    wall: Wall
    first: float
    num_bays: int
    doors: tuple[int, ...]

    def panelled(self) -> list[tuple[float, int]]:
        """Stretches of panels between the doors: metres from the wall's left end, and number of
        bays."""
        ends = [
            0,
            *(bay for door in self.doors for bay in (door, door + _DOOR_BAYS)),
            self.num_bays,
        ]
        return [
            (self.first + BAY * a, b - a)
            for a, b in zip(ends[::2], ends[1::2], strict=True)
            if b > a
        ]

    def door_bays(self) -> list[tuple[float, float]]:
        """From and to, metres from the wall's left end."""
        return [
            (self.first + BAY * door, self.first + BAY * (door + _DOOR_BAYS)) for door in self.doors
        ]


_WALLS = (
    Wall("south outer", (LENGTH, 0.0), np.pi, LENGTH),
    Wall("east outer", (LENGTH, WIDTH), -np.pi / 2, WIDTH),
    Wall("north outer", (0.0, WIDTH), 0.0, LENGTH),
    Wall("west outer", (0.0, 0.0), np.pi / 2, WIDTH),
    Wall("south inner", (WING, WING), 0.0, LENGTH - 2 * WING),
    Wall("east inner", (LENGTH - WING, WING), np.pi / 2, WIDTH - 2 * WING),
    Wall("north inner", (LENGTH - WING, WIDTH - WING), np.pi, LENGTH - 2 * WING),
    Wall("west inner", (WING, WIDTH - WING), -np.pi / 2, WIDTH - 2 * WING),
)


def walls_of(seed: int) -> dict[str, PanelledWall]:
    """Return the walls by name, with the doors of this seed."""
    walls = {}
    for wall in _WALLS:
        num_bays = _SHORT if wall.name.startswith(("east", "west")) else _LONG
        first = WING if wall.name.endswith("outer") else 0.0
        walls[wall.name] = PanelledWall(
            wall, first, num_bays, _doors(rng_of(seed, f"hospital/doors/{wall.name}"), num_bays)
        )
    return walls


def _doors(rng: np.random.Generator, num_bays: int) -> tuple[int, ...]:
    doors = []
    bay = int(rng.integers(*_FIRST_DOOR))
    while bay + _DOOR_BAYS < num_bays:
        doors.append(bay)
        bay += int(rng.integers(*_NEXT_DOOR))
    return tuple(doors)


def lamp_sites() -> list[tuple[float, float, bool]]:
    """Places (x, y) of the ceiling lamps, one a bay and one in each square, and whether they lie
    along x."""
    (x0, y0), (x1, _), (_, y1), _ = LOOP
    along_x, along_y = (WING + BAY * (np.arange(number) + 0.5) for number in (_LONG, _SHORT))
    sites = [(float(x), y, True) for y in (y0, y1) for x in along_x]
    sites += [(x, float(y), False) for x in (x0, x1) for y in along_y]
    return sites + [(x, y, True) for x, y in LOOP]
