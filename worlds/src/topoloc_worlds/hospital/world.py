"""Build the corridor of a hospital ward: a loop of 21 x 13 m with equal wall panels of a metre.

Handrail, skirting, floor, ceiling and lamps repeat with the panels. Only two kinds of objects make
places distinct: a door with its sign every eight to ten metres, and the furniture of the four
squares between wings.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topoloc_worlds.conditions import Condition
from topoloc_worlds.corridor import parts, things
from topoloc_worlds.corridor.plan import (
    DOOR_HEIGHT,
    DOOR_WIDTH,
    HEIGHT,
    on_wall,
    on_wall_mesh,
    shifted,
    solid,
)
from topoloc_worlds.furnishing import interiors, printed_things, prints
from topoloc_worlds.hospital.finishes import Finishes
from topoloc_worlds.hospital.plan import (
    BAY,
    LENGTH,
    LOOP,
    WIDTH,
    WING,
    PanelledWall,
    lamp_sites,
    walls_of,
)
from topoloc_worlds.noise import rng_of
from topoloc_worlds.scene import Material, Mesh, Scene, Surface
from topoloc_worlds.shapes import Vector, box, join, panel, placed, tube
from topoloc_worlds.skies import sky_of

__all__ = ["CAMERA_HEIGHT", "LOOP", "MOVABLE", "build"]

CAMERA_HEIGHT = 1.4
MOVABLE = "movable "
"""How the names of all surfaces begin that `arrangement` moves."""
_AT_NIGHT = 0.3
"""What the lamps are dimmed to at night."""
_RAIL = 0.9
_WINDOW = (0.5, 1.9, 0.9, 2.3)
"""Of the one window, in the square at the end of the loop's second wing: from, to, sill and
lintel."""


def build(seed: int, condition: Condition, arrangement: int = 0) -> Scene:
    """The ward of this seed under a condition, its movable things as people left them in an
    `arrangement`."""
    finishes, walls = Finishes.of(seed, HEIGHT), walls_of(seed)
    surfaces = _panels(walls, finishes) + _levels(finishes) + _lamps(condition, finishes)
    for name, wall in walls.items():
        for number, (left, right) in enumerate(wall.door_bays()):
            surfaces += on_wall(
                wall.wall,
                left,
                _door(rng_of(seed, f"hospital/{name}/{number}"), right - left, finishes),
            )
    surfaces += _squares(seed, walls, finishes) + _movables(seed, arrangement, walls, finishes)
    return Scene(tuple(surfaces), sky_of(condition, seed))


def _panels(walls: dict[str, PanelledWall], finishes: Finishes) -> list[Surface]:
    """All panels with the handrail, its brackets and the skirting before them."""
    fronts: list[Mesh] = []
    rails: list[Mesh] = []
    brackets: list[Mesh] = []
    skirting: list[Mesh] = []
    for wall in walls.values():
        for left, bays in wall.panelled():
            long = BAY * bays
            fronts.append(
                on_wall_mesh(wall.wall, _front(left, left + long, 0.0, HEIGHT, (float(bays), 1.0)))
            )
            rails.append(
                on_wall_mesh(
                    wall.wall,
                    box((left, -0.09, _RAIL), (left + long, -0.05, _RAIL + 0.12), faces="sewtb"),
                )
            )
            skirting.append(
                on_wall_mesh(
                    wall.wall, box((left, -0.012, 0.0), (left + long, 0.0, 0.1), faces="sewt")
                )
            )
            for x in left + BAY * (np.arange(bays) + 0.5):
                brackets.append(
                    on_wall_mesh(
                        wall.wall, tube((x, 0.0, _RAIL + 0.02), (x, -0.06, _RAIL + 0.05), 0.014)
                    )
                )
    fittings = finishes.fittings
    return [
        solid("panels", finishes.panel, *fronts),
        solid("handrail", interiors.plastic((0.30, 0.42, 0.55)), *rails),
        solid("handrail brackets", fittings.chrome, *brackets),
        solid("skirting", interiors.plastic((0.34, 0.36, 0.38)), *skirting),
    ]


def _front(
    left: float, right: float, low: float, high: float, repeat: tuple[float, float] = (1.0, 1.0)
) -> Mesh:
    """A piece of wall in the wall's frame."""
    return panel((left, 0.0, high), (right - left, 0.0, 0.0), (0.0, 0.0, low - high), repeat)


def _levels(finishes: Finishes) -> list[Surface]:
    """Build floor and ceiling. Their textures begin at the first bay."""
    inner_x, inner_y = LENGTH - 2 * WING, WIDTH - 2 * WING
    wings: tuple[tuple[Vector, float, float], ...] = (
        ((WING, 0.0, 0.0), inner_x, WING),
        ((WING, WIDTH - WING, 0.0), inner_x, WING),
        ((0.0, WING, 0.0), WING, inner_y),
        ((LENGTH - WING, WING, 0.0), WING, inner_y),
        *(((x - WING / 2, y - WING / 2, 0.0), WING, WING) for x, y in LOOP),
    )
    floors, ceilings = [], []
    for (x, y, _), across, deep in wings:
        floors.append(
            panel(
                (x, y + deep, 0.0),
                (across, 0.0, 0.0),
                (0.0, -deep, 0.0),
                (across / BAY, deep / BAY),
            )
        )
        ceilings.append(
            panel((x, y, HEIGHT), (across, 0.0, 0.0), (0.0, deep, 0.0), (across / BAY, deep / BAY))
        )
    return [solid("floor", finishes.floor, *floors), solid("ceiling", finishes.ceiling, *ceilings)]


def _lamps(condition: Condition, finishes: Finishes) -> list[Surface]:
    """One lamp a bay, all alike; they burn day and night, dimmed when people sleep."""
    dark = condition.daylight <= 0.0
    lamp = parts.ceiling_lamp(
        _AT_NIGHT if dark else 1.0, 0.8 if dark else 0.2, finishes.fittings, (0.6, 0.3)
    )
    turns = [((x, y, 0.0), 0.0 if lengthwise else np.pi / 2) for x, y, lengthwise in lamp_sites()]
    return [
        solid(part.name, part.material, *(placed(part.mesh, at, yaw) for at, yaw in turns))
        for part in lamp
    ]


def _door(rng: np.random.Generator, width: float, finishes: Finishes) -> list[Surface]:
    """A door in painted wall, with the sign of its room beside it and a picture on its leaf."""
    left = width - DOOR_WIDTH - 0.12
    right = left + DOOR_WIDTH
    beside = join(
        [
            _front(0.0, left, 0.0, HEIGHT),
            _front(right, width, 0.0, HEIGHT),
            _front(left, right, DOOR_HEIGHT, HEIGHT),
        ]
    )
    red, green, blue = rng.uniform(0.5, 0.85, 3).tolist()
    fittings = replace(finishes.fittings, leaf=interiors.plastic((red, green, blue), 0.3))
    hung = panel((0.45, 0.058, 1.75), (0.3, 0.0, 0.0), (0.0, 0.0, -0.4))
    door = [
        *parts.door_frame(fittings),
        *parts.door_leaf(fittings),
        Surface("door print", hung, interiors.printed(prints.poster(rng))),
    ]
    sign = box((0.2, -0.01, 1.3), (0.62, 0.0, 1.58), faces="sewtb")
    return [
        Surface("door wall", beside, finishes.paint),
        *shifted(door, (left, 0.0, 0.0)),
        Surface("door sign", sign, interiors.laminated(printed_things.door_sign(rng, (160, 240)))),
    ]


def _squares(seed: int, walls: dict[str, PanelledWall], finishes: Finishes) -> list[Surface]:
    """Build the painted outer walls of the four squares between wings, each with its own prints.
    One wall has the window."""
    names = ("south outer", "east outer", "north outer", "west outer")
    surfaces = []
    for number, name in enumerate(names):
        wall = walls[name].wall
        paint = finishes.corners[number]
        rng = rng_of(seed, f"hospital/square/{number}")
        # The left end of a wall and the right end of the one before it make one square.
        before = walls[names[number - 1]].wall
        if name == "north outer":
            surfaces += on_wall(wall, 0.0, _window(finishes, paint))
        else:
            mural = parts.framed(
                1.5,
                1.0,
                1.5,
                finishes.fittings.wood,
                interiors.laminated(prints.photograph(rng, (400, 600))),
            )
            surfaces += on_wall(
                wall, 0.0, [Surface("square wall", _front(0.0, WING, 0.0, HEIGHT), paint)]
            )
            surfaces += on_wall(wall, WING / 2, mural)
        board = parts.framed(
            1.2, 0.8, 1.5, finishes.fittings.aluminium, interiors.printed(prints.notice_board(rng))
        )
        surfaces += on_wall(
            before,
            0.0,
            [
                Surface(
                    "square wall", _front(before.length - WING, before.length, 0.0, HEIGHT), paint
                )
            ],
        )
        surfaces += on_wall(before, before.length - WING / 2, board)
    return surfaces


def _window(finishes: Finishes, paint: Material) -> list[Surface]:
    """A square's wall with a window in it, and the lawn outside."""
    x0, x1, z0, z1 = _WINDOW
    pieces = [
        _front(0.0, x0, 0.0, HEIGHT),
        _front(x1, WING, 0.0, HEIGHT),
        _front(x0, x1, 0.0, z0),
        _front(x0, x1, z1, HEIGHT),
    ]
    bars = [
        box((x - 0.03, -0.02, z0), (x + 0.03, 0.1, z1))
        for x in (x0 + 0.03, (x0 + x1) / 2, x1 - 0.03)
    ]
    bars += [box((x0, -0.02, z - 0.03), (x1, 0.1, z + 0.03)) for z in (z0 + 0.03, z1 - 0.03)]
    lawn = panel((-30.0, 60.0, -3.0), (60.0, 0.0, 0.0), (0.0, -59.5, 0.0), (12.0, 12.0))
    return [
        Surface("square wall", join(pieces), paint),
        solid("window frame", finishes.fittings.aluminium, *bars),
        Surface("lawn", lawn, Material("matt", (0.33, 0.42, 0.22))),
    ]


_SITES = (
    *(("south outer", x) for x in (0.6, LENGTH - 0.6)),
    *(("east outer", x) for x in (0.6, WIDTH - 0.6)),
    *(("north outer", 0.4), ("west outer", 0.6)),
)


def _movables(
    seed: int, arrangement: int, walls: dict[str, PanelledWall], finishes: Finishes
) -> list[Surface]:
    """Place the movable objects. Their looks depend on the seed, their squares and headings on the
    arrangement."""
    rng = rng_of(seed, "hospital/movables")
    fittings = finishes.fittings
    stock = [
        things.potted_plant(rng, float(rng.uniform(1.0, 1.5))),
        things.visitor_chair(fittings, rng, (0.2, 0.34, 0.5)),
        things.visitor_chair(fittings, rng, (0.5, 0.3, 0.22)),
        things.waste_bin(fittings),
    ]
    today = rng_of(seed, f"hospital/arrangement/{arrangement}")
    surfaces = []
    for thing, index in zip(stock, today.permutation(len(_SITES)), strict=False):
        name, x = _SITES[int(index)]
        turned = shifted(
            thing, (float(today.uniform(-0.1, 0.1)), -0.05, 0.0), float(today.uniform(-0.15, 0.15))
        )
        surfaces += [
            replace(surface, name=MOVABLE + surface.name)
            for surface in on_wall(walls[name].wall, x, turned)
        ]
    return surfaces
