"""The paper's Lab, 5 x 4 m: desks, shelves, screens and clutter around a table with a robot arm;
windows along the north side.

By day light comes through the windows, with the sun's spots on the floor and a few of the ceiling's
lamps; by night from lamps on the desks and beside them and from the screens: the same things with
other shadows.
"""

from __future__ import annotations

from math import pi

import numpy as np

from topoloc_worlds.conditions import Condition
from topoloc_worlds.furnishing.desktop_things import (
    book_stack,
    bottle,
    desk_lamp,
    keyboard,
    laptop,
    monitor,
    mouse,
    mug,
    papers,
    pen_cup,
    picture_frame,
    potted_plant,
    telephone,
)
from topoloc_worlds.furnishing.furniture import (
    carton_box,
    coat_rack,
    crate,
    cupboard,
    desk,
    door,
    office_chair,
    radiator,
    waste_bin,
)
from topoloc_worlds.furnishing.interiors import Finishes, finishes_of, plastic, printed
from topoloc_worlds.furnishing.pictures import photograph
from topoloc_worlds.furnishing.printed_things import door_sign, exit_sign
from topoloc_worlds.furnishing.prints import calendar, notice, notice_board, poster
from topoloc_worlds.furnishing.shelves import bookshelf
from topoloc_worlds.lab.shell import (
    CEILING_LAMPS,
    DARK,
    LENGTH,
    SILL,
    WIDTH,
    light_shafts,
    shell,
    sky_above,
)
from topoloc_worlds.lab.things import (
    computer_case,
    floor_lamp,
    mesh_cables,
    oscilloscope,
    quadcopter,
    robot_arm,
    tool_wall,
    toolbox,
    tripod,
    wall_board,
)
from topoloc_worlds.noise import rng_of
from topoloc_worlds.scene import Picture, Scene, Surface
from topoloc_worlds.shapes import lathe, panel, placed, surfaces_placed

LOOP: tuple[tuple[float, float], ...] = ((1.25, 1.3), (3.75, 1.3), (3.75, 2.85), (1.25, 2.85))
CAMERA_HEIGHT = 1.4
_MOVED = (
    "chair, mug, papers, carton, bin, keyboard, mouse, bottle, toolbox, tripod, quadcopter,"
    " instrument, book stack, robot arm"
)
MOVABLE = frozenset(_MOVED.split(", "))
"""Names of what another arrangement puts elsewhere."""

_DESK_TOP = 0.74
_DESKS = ((1.15, 0.37), (2.75, 0.37))
_TABLE, _BENCH = (2.5, 2.07), (2.5, 3.66)


def build(seed: int, condition: Condition, arrangement: int = 0) -> Scene:
    """The room under a condition; `arrangement` is how people left their things."""
    finishes = finishes_of(rng_of(seed, "finishes"))
    lit = _lit(seed, condition)
    move = rng_of(seed, f"arrangement/{arrangement}")
    surfaces = shell(seed, finishes, frozenset(k for k in lit if k < len(CEILING_LAMPS)))
    surfaces += light_shafts(condition, seed)
    surfaces += _walls(seed, finishes)
    surfaces += _built_in(seed, finishes)
    for k, at in enumerate(_DESKS):
        surfaces += surfaces_placed(
            _desk(seed, k, finishes, condition, len(CEILING_LAMPS) + k in lit, move), (*at, 0.0), pi
        )
    surfaces += surfaces_placed(
        _bench(seed, finishes, condition, len(CEILING_LAMPS) + 2 in lit, move), (*_BENCH, 0.0)
    )
    surfaces += surfaces_placed(_table(seed, finishes, move), (*_TABLE, 0.0))
    surfaces += surfaces_placed(
        floor_lamp(finishes, len(CEILING_LAMPS) + 3 in lit), (0.42, 3.68, 0.0)
    )
    surfaces += _on_the_floor(seed, finishes, move)
    return Scene(tuple(surfaces), sky_above(condition, seed))


def _lit(seed: int, condition: Condition) -> frozenset[int]:
    """Select the lit lamps. By day these are some of the ceiling's. In the dark they are lamps of
    the desks, of the bench and on the floor, and the ceiling's if more than half are lit."""
    rng = rng_of(seed, "lamps")
    ceiling, others = rng.permutation(len(CEILING_LAMPS)), len(CEILING_LAMPS) + rng.permutation(4)
    if condition.daylight >= DARK:
        lit = ceiling[: round(condition.lamps * (len(ceiling) + len(others)))]
    else:
        above = max(0.0, 2.0 * condition.lamps - 1.0)
        lit = np.concatenate(
            [others[: round(condition.lamps * len(others))], ceiling[: round(above * len(ceiling))]]
        )
    return frozenset(lit.tolist())


def _screen_on(seed: int, condition: Condition, name: str) -> bool:
    return bool(rng_of(seed, f"{name} on {condition.daylight < DARK}").uniform() < 0.7)


def _strewn(
    parts: list[Surface],
    at: tuple[float, float, float],
    move: np.random.Generator,
    spread: float,
    turn: float,
) -> list[Surface]:
    """A movable thing near its place, turned as it was put down."""
    x, y = at[0] + spread * move.uniform(-1, 1), at[1] + spread * move.uniform(-1, 1)
    return surfaces_placed(parts, (x, y, at[2]), turn * move.normal())


def _desk(
    seed: int,
    index: int,
    finishes: Finishes,
    condition: Condition,
    lamp_on: bool,
    move: np.random.Generator,
) -> list[Surface]:
    """A desk and all that is on it and below, in the desk's own frame."""
    rng = rng_of(seed, f"desk {index}")
    top = _DESK_TOP
    parts = desk(finishes)
    num_monitors = 2 if index == 0 else 1
    for k in range(num_monitors):
        x = (-0.3 + 0.6 * k) if num_monitors == 2 else 0.05
        shown = monitor(
            rng,
            finishes,
            0.54 if num_monitors == 2 else 0.66,
            _screen_on(seed, condition, f"monitor {index} {k}"),
        )
        parts += surfaces_placed(
            shown, (x, 0.16, top), (0.2 - 0.4 * k) * (num_monitors == 2) + rng.normal(0, 0.04)
        )
        parts.append(
            Surface(
                "cables",
                mesh_cables(rng, (x, 0.22, top + 0.2), (x + 0.2, 0.3, top + 0.16), 2),
                finishes.rubber,
            )
        )
    parts += surfaces_placed(
        desk_lamp(finishes, lamp_on, rng.uniform(-0.5, 0.5)), (-0.64, 0.2, top)
    )
    parts += surfaces_placed(telephone(finishes), (0.63, 0.03, top), -0.2)
    parts += surfaces_placed(pen_cup(rng, finishes), (0.66, 0.26, top))
    parts += surfaces_placed(computer_case(rng, finishes), (0.55, 0.05, 0.0))
    parts.append(
        Surface("cables", mesh_cables(rng, (0.5, 0.26, 0.4), (-0.1, 0.3, 0.65), 4), finishes.rubber)
    )
    parts += _strewn(keyboard(rng, finishes), (0.0, -0.17, top), move, 0.05, 0.08)
    parts += _strewn(mouse(finishes), (0.36, -0.2, top), move, 0.03, 0.1)
    parts += _strewn(papers(rng, 3), (-0.5, -0.13, top), move, 0.06, 0.4)
    parts += _strewn(mug(rng), (0.5, -0.1, top), move, 0.08, 2.0)
    stack = (-0.62, 0.02, top) if index else (0.02, 0.24, top)
    return parts + _strewn(book_stack(rng, int(rng.integers(2, 6))), stack, move, 0.02, 0.5)


def _bench(
    seed: int, finishes: Finishes, condition: Condition, lamp_on: bool, move: np.random.Generator
) -> list[Surface]:
    """The work bench under the middle window."""
    rng = rng_of(seed, "bench")
    top = _DESK_TOP
    parts = desk(finishes, 1.45, 0.6, drawers=0)
    for x in (-0.42, 0.02):
        shown = oscilloscope(rng, finishes, _screen_on(seed, condition, f"instrument {x}"))
        parts += _strewn(shown, (x, 0.14, top), move, 0.03, 0.06)
    parts += surfaces_placed(desk_lamp(finishes, lamp_on, 0.4), (0.6, 0.14, top))
    parts += _strewn(papers(rng, 2), (-0.1, -0.12, top), move, 0.08, 0.5)
    parts += _strewn(bottle(rng), (0.33, 0.1, top), move, 0.06, 2.0)
    parts += surfaces_placed(crate(rng, 0.4, 0.4, 0.3), (-0.4, 0.05, 0.0))
    return parts + surfaces_placed(crate(rng, 0.36, 0.4, 0.24), (0.1, 0.08, 0.0))


def _table(seed: int, finishes: Finishes, move: np.random.Generator) -> list[Surface]:
    """Build the table in the middle, with the objects of the current work."""
    rng = rng_of(seed, "table")
    top = _DESK_TOP
    parts = desk(finishes, 1.2, 0.56, drawers=0)
    # Another arrangement finds the arm in another posture.
    parts += surfaces_placed(robot_arm(move, finishes), (-0.38, 0.04, top))
    parts += _strewn(toolbox(rng, finishes), (0.34, 0.12, top), move, 0.04, 0.15)
    parts += surfaces_placed(laptop(rng, finishes, True), (0.02, -0.06, top), 0.3)
    parts += _strewn(papers(rng, 3), (0.38, -0.13, top), move, 0.05, 0.5)
    parts += _strewn(mug(rng), (-0.1, 0.2, top), move, 0.03, 2.0)
    return parts + _strewn(carton_box(rng, (0.45, 0.35, 0.3)), (-0.25, 0.0, 0.0), move, 0.06, 0.2)


def _on_the_floor(seed: int, finishes: Finishes, move: np.random.Generator) -> list[Surface]:
    """Build movable objects: chairs, cartons, bins, a tripod."""
    rng = rng_of(seed, "floor")
    parts = []
    for (x, y), yaw in (((1.1, 0.86), 0.0), ((2.7, 0.86), 0.0), ((0.72, 3.25), 2.0)):
        chair = office_chair(finishes, turn=float(move.normal(0, 0.4)))
        parts += surfaces_placed(
            chair,
            (x + 0.14 * move.uniform(-1, 1), y + 0.04 * move.uniform(-1, 1), 0.0),
            yaw + move.normal(0, 0.2),
        )
    places = [(4.66, 1.0), (4.66, 1.9), (3.71, 0.3), (4.6, 3.72)]
    chosen = [places[int(k)] for k in move.permutation(len(places))[:3]]
    sizes = [(0.42, 0.36, 0.32), (0.34, 0.3, 0.26), (0.5, 0.32, 0.4)]
    for at, size in zip(chosen, sizes, strict=True):
        size = (0.3, 0.3, 0.5) if at[0] < 4 else size
        parts += _strewn(carton_box(rng, size), (*at, 0.0), move, 0.02, 0.1)
        if size[2] < 0.35:
            parts += _strewn(carton_box(rng, (0.3, 0.24, 0.2)), (*at, size[2]), move, 0.02, 0.25)
    parts += _strewn(waste_bin(finishes), (1.98, 0.5, 0.0), move, 0.03, 1.0)
    parts += _strewn(carton_box(rng, (0.5, 0.3, 0.3)), (4.3, 0.23, 1.95), move, 0.03, 0.1)
    parts += _strewn(quadcopter(finishes), (0.25, 2.5, 2.0), move, 0.02, 0.4)
    return parts + _strewn(tripod(finishes), (0.55, 2.95, 0.0), move, 0.03, 1.0)


def _built_in(seed: int, finishes: Finishes) -> list[Surface]:
    """Shelves, cupboard, door, radiators, plants on the sills."""
    rng = rng_of(seed, "built in")
    parts = surfaces_placed(bookshelf(rng, finishes), (0.16, 1.27, 0.0), pi / 2)
    parts += surfaces_placed(bookshelf(rng, finishes), (0.16, 2.19, 0.0), pi / 2)
    parts += surfaces_placed(cupboard(rng, finishes), (4.35, 0.23, 0.0), pi)
    parts += surfaces_placed(door(rng, finishes), (LENGTH, 3.0, 0.0), -pi / 2)
    parts += surfaces_placed(coat_rack(rng, finishes), (LENGTH, 2.0, 0.0), -pi / 2)
    for x in (1.02, 3.98):
        parts += surfaces_placed(radiator(finishes), (x, WIDTH - 0.07, 0.05))
    for x in rng.choice([0.7, 1.3, 2.2, 2.8, 3.6, 4.3], 3, replace=False):
        parts += surfaces_placed(
            potted_plant(rng, rng.uniform(0.25, 0.45)), (float(x), WIDTH + 0.06, SILL + 0.025)
        )
    red = lathe(
        [
            (0.0, 0.15),
            (0.07, 0.16),
            (0.075, 0.2),
            (0.075, 0.5),
            (0.03, 0.58),
            (0.02, 0.64),
            (0.0, 0.65),
        ],
        18,
    )
    parts.append(
        Surface(
            "extinguisher",
            placed(red, (LENGTH - 0.09, 3.68, 0.25)),
            plastic((0.62, 0.05, 0.05), 0.15),
        )
    )
    return parts


def _walls(seed: int, finishes: Finishes) -> list[Surface]:
    """Build the objects on the walls. Parts of the walls stay bare."""
    rng = rng_of(seed, "walls")
    parts: list[Surface] = []
    hung = [calendar(rng), poster(rng), photograph(rng, (360, 480)), poster(rng, (512, 720))]
    widths = [0.32, 0.5, 0.5, 0.7]
    order = rng.permutation(4)
    for k, x in zip(order, (0.55, 1.6, 2.45, 3.35), strict=True):
        at = (x + rng.normal(0, 0.05), 0.001, rng.uniform(1.45, 1.6))
        if rng.uniform() < 0.4:
            parts += surfaces_placed(picture_frame(rng, finishes, hung[k], widths[k]), at, pi)
        else:
            parts.append(_pinned(hung[k], widths[k], at, pi))
    parts += surfaces_placed(
        wall_board(rng, finishes, 1.0, 0.75), (LENGTH - 0.001, 1.05, 1.05), -pi / 2
    )
    parts.append(_pinned(door_sign(rng), 0.18, (LENGTH - 0.001, 3.78, 1.5), -pi / 2))
    parts.append(_pinned(exit_sign(), 0.3, (LENGTH - 0.001, 3.0, 2.18), -pi / 2))
    parts += surfaces_placed(tool_wall(rng, finishes, 0.7), (0.001, 3.15, 1.15), pi / 2)
    parts.append(_pinned(notice_board(rng, (420, 420)), 0.5, (0.001, 0.45, 1.25), pi / 2))
    parts.append(_pinned(notice(rng), 0.21, (LENGTH - 0.001, 2.42, 1.75), -pi / 2))
    parts += [_pinned(notice(rng), 0.21, (x, WIDTH - 0.001, 1.5), 0.0) for x in (1.76, 3.24)]
    return parts


def _pinned(picture: Picture, width: float, at: tuple[float, float, float], yaw: float) -> Surface:
    """A print on a wall: the middle of its lower edge at `at`."""
    height = width * picture.shape[0] / picture.shape[1]
    sheet = panel((-width / 2, -0.002, height), (width, 0, 0), (0, 0, -height))
    return Surface("print", placed(sheet, at, yaw), printed(picture))
