"""Build the rooms beside the corridor in the wall's frame of corridor_plan: offices behind open
doors, and niches for machines."""

from __future__ import annotations

import numpy as np

from topoloc_worlds.conditions import Condition
from topoloc_worlds.corridor.parts import Fittings, ceiling_lamp, framed
from topoloc_worlds.corridor.plan import (
    DOOR_HEIGHT,
    DOOR_WIDTH,
    HEIGHT,
    WALL_THICKNESS,
    Opening,
    shifted,
    solid,
)
from topoloc_worlds.corridor.things import (
    copier,
    paper_shelf,
    vending_machine,
    visitor_chair,
    waste_bin,
)
from topoloc_worlds.furnishing import interiors, printed_things, prints
from topoloc_worlds.noise import rng_of
from topoloc_worlds.scene import Surface
from topoloc_worlds.shapes import box, panel


def room(seed: int, condition: Condition, name: str, fittings: Fittings) -> list[Surface]:
    """The office behind a door, with its own lamp."""
    rng = rng_of(seed, f"corridor/room {name}")
    shell = _shell(fittings)
    on = rng_of(seed, f"corridor/room {name}/{condition.name}").random() < 0.8 * condition.lamps
    lamp = ceiling_lamp(float(on), 0.3, fittings)
    board = framed(1.5, 1.0, 1.5, fittings.metal, interiors.laminated(prints.whiteboard(rng)))
    return [
        *shell,
        *_office(fittings, rng, 3.9),
        *shifted(lamp, (0.0, 2.0, 0.0)),
        *shifted(board, (1.69, 1.6, 0.0), -np.pi / 2),
    ]


def niche(
    seed: int, condition: Condition, name: str, opening: Opening, fittings: Fittings
) -> list[Surface]:
    """A recess for the copier, or for the vending machine."""
    rng = rng_of(seed, f"corridor/niche {name}")
    width, high, depth = opening.right - opening.left, opening.top, 1.0
    sides = [
        panel((0.0, 0.0, high), (0.0, depth, 0.0), (0.0, 0.0, -high)),
        panel((width, depth, high), (0.0, -depth, 0.0), (0.0, 0.0, -high)),
        panel((0.0, depth, high), (width, 0.0, 0.0), (0.0, 0.0, -high)),
        panel((0.0, 0.0, high), (width, 0.0, 0.0), (0.0, depth, 0.0)),
    ]
    floor = panel((0.0, depth, 0.0), (width, 0.0, 0.0), (0.0, -depth, 0.0), (width / 4, depth / 4))
    on = (
        condition.lamps > 0.0
        and rng_of(seed, f"corridor/niche {name}/{condition.name}").random() < condition.lamps + 0.3
    )
    lamp = shifted(
        ceiling_lamp(float(on), 0.8, fittings, (0.6, 0.15)), (width / 2, depth / 2, high - HEIGHT)
    )
    surfaces = [
        solid("niche wall", fittings.plaster, *sides),
        Surface("niche floor", floor, fittings.linoleum),
        *lamp,
    ]
    if width > 2.4:
        machine = shifted(copier(fittings, rng), (width - 0.6, depth - 0.05, 0.0))
        shelf = shifted(paper_shelf(fittings, rng), (0.75, depth, 0.0))
        board = framed(1.0, 0.66, 1.65, fittings.wood, interiors.printed(prints.notice_board(rng)))
        return surfaces + machine + shelf + shifted(board, (width - 0.65, depth, 0.0))
    machine = shifted(vending_machine(fittings, rng), (0.6, depth, 0.0))
    return surfaces + machine + shifted(waste_bin(fittings), (1.4, depth - 0.1, 0.0))


def _shell(fittings: Fittings, depth: float = 3.8, width: float = 3.4) -> list[Surface]:
    """Build an office behind a door with centre x = 0: walls with a window at the back, floor and
    ceiling."""
    near, far, half = WALL_THICKNESS, WALL_THICKNESS + depth, width / 2
    sides = [
        panel((-half, near, HEIGHT), (0.0, depth, 0.0), (0.0, 0.0, -HEIGHT)),
        panel((half, far, HEIGHT), (0.0, -depth, 0.0), (0.0, 0.0, -HEIGHT)),
    ]
    front = [
        panel((x0, near, HEIGHT), (x1 - x0, 0.0, 0.0), (0.0, 0.0, -HEIGHT))
        for x0, x1 in ((-half, -DOOR_WIDTH / 2), (DOOR_WIDTH / 2, half))
    ]
    front.append(
        panel(
            (-DOOR_WIDTH / 2, near, HEIGHT),
            (DOOR_WIDTH, 0.0, 0.0),
            (0.0, 0.0, DOOR_HEIGHT - HEIGHT),
        )
    )
    back = [
        panel((x0, far, z1), (x1 - x0, 0.0, 0.0), (0.0, 0.0, z0 - z1))
        for x0, x1, z0, z1 in _around(half, 1.2, 0.9, 2.3)
    ]
    level = [
        Surface(
            "room floor",
            panel(
                (-half, far, 0.0), (width, 0.0, 0.0), (0.0, near - far, 0.0), (width / 2, depth / 2)
            ),
            fittings.carpet,
        ),
        Surface(
            "room ceiling",
            panel(
                (-half, near, HEIGHT),
                (width, 0.0, 0.0),
                (0.0, depth, 0.0),
                (width / 2.4, depth / 2.4),
            ),
            fittings.tiles,
        ),
    ]
    return [solid("room wall", fittings.plaster, *sides, *front, *back), *level]


def _around(
    half: float, window: float, low: float, high: float
) -> list[tuple[float, float, float, float]]:
    """The four pieces of a wall around a window in it, as (x0, x1, z0, z1)."""
    return [
        (-half, -window, 0.0, HEIGHT),
        (window, half, 0.0, HEIGHT),
        (-window, window, 0.0, low),
        (-window, window, high, HEIGHT),
    ]


def _office(fittings: Fittings, rng: np.random.Generator, depth: float) -> list[Surface]:
    """Build a desk with a screen and a bookcase, for a room with its door at y = 0 and its window
    at `depth`."""
    top = box((0.0, depth - 1.2, 0.7), (1.6, depth - 0.4, 0.735), texels=0.8)
    legs = [
        box((x, y, 0.0), (x + 0.05, y + 0.05, 0.7))
        for x in (0.03, 1.52)
        for y in (depth - 1.15, depth - 0.5)
    ]
    screen = box((0.55, depth - 0.72, 0.86), (1.1, depth - 0.69, 1.2))
    foot = [
        box((0.8, depth - 0.7, 0.735), (0.85, depth - 0.66, 0.9)),
        box((0.7, depth - 0.8, 0.735), (0.95, depth - 0.58, 0.75)),
    ]
    case = box((-1.68, depth - 1.9, 0.0), (-1.36, depth - 0.4, 1.9), texels=0.8)
    rows = []
    for level in (0.1, 0.48, 0.86, 1.24, 1.58):
        books = panel((-1.355, depth - 0.45, level + 0.26), (0.0, -1.4, 0.0), (0.0, 0.0, -0.26))
        rows.append(
            Surface(
                "books",
                books,
                interiors.printed(
                    printed_things.book_spines(rng, [int(w) for w in rng.integers(14, 46, 26)])
                ),
            )
        )
    chair = shifted(visitor_chair(fittings, rng, (0.16, 0.17, 0.2)), (0.8, depth - 1.15, 0.0))
    return [
        solid("desk", fittings.wood, top, case),
        solid("desk legs", fittings.metal, *legs),
        solid("monitor", fittings.black, screen, *foot),
        *rows,
        *chair,
    ]
