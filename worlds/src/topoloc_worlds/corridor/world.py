"""A world: the corridor of an office floor, a loop of 25 x 18 m around a courtyard.

Repeated doors, long bare walls, a polished floor, windows from floor to ceiling that blind by day
and mirror by night.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topoloc_worlds.conditions import Condition
from topoloc_worlds.corridor import parts, things
from topoloc_worlds.corridor.finishes import linoleum_floor, wall_paint
from topoloc_worlds.corridor.lamps import ceiling_lamps
from topoloc_worlds.corridor.outdoors import outdoors
from topoloc_worlds.corridor.parts import Fittings
from topoloc_worlds.corridor.plan import (
    DOOR_WIDTH,
    EAST,
    HEIGHT,
    LENGTH,
    LOOP,
    NORTH,
    SOUTH,
    WEST,
    WIDTH,
    Opening,
    Wall,
    on_wall,
    shifted,
    skirting_mesh,
    stretches,
    wall_mesh,
    walls_of,
)
from topoloc_worlds.corridor.rooms import niche, room
from topoloc_worlds.furnishing import interiors, printed_things, prints
from topoloc_worlds.noise import rng_of
from topoloc_worlds.scene import Color, Material, Scene, Surface
from topoloc_worlds.shapes import panel
from topoloc_worlds.skies import sky_of

CAMERA_HEIGHT = 1.4
MOVABLE = "movable "
"""How the names of all surfaces begin that `arrangement` moves."""

_OFF_WHITE: Color = (0.89, 0.885, 0.86)
_DADOS: tuple[Color, ...] = (
    (0.60, 0.69, 0.66),
    (0.72, 0.66, 0.53),
    (0.58, 0.65, 0.74),
    (0.74, 0.6, 0.52),
)
_ACCENTS: tuple[Color, ...] = (
    (0.84, 0.72, 0.42),
    (0.66, 0.74, 0.58),
    (0.78, 0.55, 0.45),
    (0.6, 0.68, 0.78),
)
_FLOORS: tuple[tuple[Color, Color], ...] = (
    ((0.56, 0.53, 0.46), (0.30, 0.32, 0.35)),
    ((0.46, 0.52, 0.50), (0.26, 0.31, 0.31)),
    ((0.58, 0.47, 0.38), (0.36, 0.27, 0.22)),
)


def build(seed: int, condition: Condition, arrangement: int = 0) -> Scene:
    """The corridor of this seed under a condition, its movable things as people left them in an
    `arrangement`."""
    fittings, walls = Fittings.of(seed), walls_of(seed)
    surfaces = _shell(seed, walls, fittings)
    for wall in walls.values():
        for number, opening in enumerate(wall.openings):
            surfaces += on_wall(
                wall,
                opening.left,
                _in_opening(
                    seed, condition, arrangement, f"{wall.name}/{number}", opening, fittings
                ),
            )
        surfaces += _put_up(seed, wall, fittings)
    surfaces += _fixtures(seed, walls, fittings)
    surfaces += ceiling_lamps(seed, condition, fittings)
    surfaces += _movables(seed, arrangement, walls, fittings)
    surfaces += outdoors(seed, condition)
    return Scene(tuple(surfaces), sky_of(condition, seed))


def _shell(seed: int, walls: dict[str, Wall], fittings: Fittings) -> list[Surface]:
    """Walls with skirting boards, floor, ceiling."""
    rng = rng_of(seed, "corridor/shell")
    dado, accents = _DADOS[int(rng.integers(len(_DADOS)))], rng.permutation(len(_ACCENTS))
    accented = {"east inner": accents[0], "west outer": accents[1]}
    surfaces = []
    for name, wall in walls.items():
        tint = _ACCENTS[int(accented[name])] if name in accented else _OFF_WHITE
        picture = wall_paint(
            rng_of(seed, f"corridor/{name}"),
            wall.length,
            HEIGHT,
            tint,
            dado if name.startswith("north") else None,
        )
        surfaces += [
            Surface(f"wall {name}", wall_mesh(wall), Material("matt", picture)),
            Surface("skirting", skirting_mesh(wall), fittings.aluminium),
        ]
    field, border = _FLOORS[int(rng.integers(len(_FLOORS)))]
    roughness = float(rng.uniform(0.03, 0.06))
    inner = WIDTH - SOUTH - NORTH
    wings = (
        ("south", LENGTH, SOUTH, panel((0.0, SOUTH, 0.0), (LENGTH, 0.0, 0.0), (0.0, -SOUTH, 0.0))),
        (
            "east",
            inner,
            EAST,
            panel((LENGTH - EAST, SOUTH, 0.0), (0.0, inner, 0.0), (EAST, 0.0, 0.0)),
        ),
        ("north", LENGTH, NORTH, panel((0.0, WIDTH, 0.0), (LENGTH, 0.0, 0.0), (0.0, -NORTH, 0.0))),
        ("west", inner, WEST, panel((0.0, SOUTH, 0.0), (0.0, inner, 0.0), (WEST, 0.0, 0.0))),
    )
    for name, length, width, mesh in wings:
        picture = linoleum_floor(
            rng_of(seed, f"corridor/floor {name}"), length, width, field, border
        )
        surfaces.append(
            Surface(f"floor {name}", mesh, Material("polished", picture, roughness=roughness))
        )
    for x, y, dx, dy in (
        (0.0, 0.0, LENGTH, SOUTH),
        (LENGTH - EAST, SOUTH, EAST, inner),
        (0.0, WIDTH - NORTH, LENGTH, NORTH),
        (0.0, SOUTH, WEST, inner),
    ):
        surfaces.append(
            Surface(
                "ceiling",
                panel((x, y, HEIGHT), (dx, 0.0, 0.0), (0.0, dy, 0.0), (dx / 2.4, dy / 2.4)),
                fittings.tiles,
            )
        )
    return surfaces


def _in_opening(
    seed: int,
    condition: Condition,
    arrangement: int,
    name: str,
    opening: Opening,
    fittings: Fittings,
) -> list[Surface]:
    if opening.kind == "windows":
        return parts.window_front(fittings, opening, glazed=condition.daylight <= 0.05)
    if opening.kind == "lift":
        return parts.lift(fittings, opening)
    rng = rng_of(seed, f"corridor/opening {name}")
    if opening.kind == "niche":
        return niche(seed, condition, name, opening, fittings)
    surfaces = parts.door_frame(fittings) + parts.door_plate(rng)
    if opening.kind == "door":
        return surfaces + parts.door_leaf(fittings)
    today = rng_of(seed, f"corridor/opening {name}/{arrangement}")
    angle = float(today.uniform(1.1, 1.75)) if today.random() < 0.6 else 0.0
    surfaces += parts.door_leaf(fittings, angle, f"{MOVABLE}door leaf")
    return surfaces + shifted(room(seed, condition, name, fittings), (DOOR_WIDTH / 2, 0.0, 0.0))


def _put_up(seed: int, wall: Wall, fittings: Fittings) -> list[Surface]:
    """Switches, and here and there a print, between the doors of a wall; most of it stays bare."""
    rng = rng_of(seed, f"corridor/put up/{wall.name}")
    surfaces: list[Surface] = []
    doors = {
        round(opening.right, 6) for opening in wall.openings if opening.kind in ("door", "room")
    }
    for left, right in stretches(wall):
        if round(left, 6) in doors and right - left > 0.3:
            surfaces += on_wall(wall, left + 0.16, parts.switches(fittings, rng))
        start, end = left + 0.4, right - 0.4
        if not 0.9 < end - start < 3.2:
            continue
        choice, at = rng.random(), float(rng.uniform(start + 0.4, end - 0.4))
        if choice < 0.35:
            hung = parts.framed(
                0.59, 0.84, 1.5, fittings.aluminium, interiors.laminated(prints.poster(rng))
            )
        elif choice < 0.5:
            hung = parts.framed(
                0.9,
                0.63,
                1.55,
                fittings.wood,
                interiors.laminated(prints.photograph(rng, (420, 600))),
            )
        elif choice < 0.65:
            sheet = panel((-0.105, -0.002, 1.62), (0.21, 0.0, 0.0), (0.0, 0.0, -0.297))
            hung = [Surface("notice", sheet, interiors.printed(prints.notice(rng)))]
        else:
            continue
        surfaces += on_wall(wall, at, hung)
    return surfaces


def _fixtures(seed: int, walls: dict[str, Wall], fittings: Fittings) -> list[Surface]:
    """Build the fixed furniture of a corridor: notice boards, extinguishers, rails, radiators,
    benches, overhead signs."""
    rng = rng_of(seed, "corridor/fixtures")
    column = interiors.concrete(rng)
    boards = [prints.notice_board(rng, size) for size in ((560, 840), (560, 1000))]
    at: list[tuple[str, float, list[Surface]]] = [
        (
            "south outer",
            11.2,
            parts.framed(1.5, 1.0, 1.5, fittings.wood, interiors.printed(boards[0])),
        ),
        (
            "west inner",
            6.2,
            parts.framed(1.9, 1.06, 1.5, fittings.aluminium, interiors.printed(boards[1])),
        ),
        ("south outer", 13.7, things.bench(fittings)),
        ("south outer", 16.0, parts.extinguisher(fittings, rng)),
        ("north outer", 18.2, parts.extinguisher(fittings, rng)),
        ("east inner", 9.8, parts.extinguisher(fittings, rng)),
        ("west outer", 17.1, parts.hydrant(fittings)),
        ("north inner", 5.6, parts.handrail(fittings, 3.6)),
        ("north inner", 10.6, parts.handrail(fittings, 4.6)),
        ("north outer", 14.4, parts.radiator(fittings)),
        ("west outer", 11.5, parts.radiator(fittings, 0.9)),
        (
            "west inner",
            0.0,
            [parts.solid("pipes", fittings.white, *parts.pipes(walls["west inner"].length))],
        ),
        *[("south inner", x, [parts.pillar(column)]) for x in (4.75, 9.0, 13.25)],
        *[("east outer", x, [parts.pillar(column)]) for x in (5.55, 9.0, 12.45)],
    ]
    surfaces = [surface for name, x, put_up in at for surface in on_wall(walls[name], x, put_up)]
    surfaces += shifted(parts.fire_door(fittings, NORTH), (12.6, WIDTH - NORTH / 2, 0.0))
    picture = printed_things.exit_sign()
    for x, y, yaw in (
        (12.35, LOOP[2][1], 0.0),
        (20.2, LOOP[0][1], 0.0),
        (LOOP[1][0], 4.6, np.pi / 2),
        (LOOP[0][0], 5.2, np.pi / 2),
    ):
        surfaces += shifted(parts.hung_sign(picture, True, fittings), (x, y, 0.0), yaw)
    for x, y in _OVERHEAD:
        detector = parts.smoke_detector(fittings) if rng.random() < 0.6 else None
        surfaces += shifted([detector] if detector else parts.air_vent(fittings), (x, y, 0.0))
    return surfaces


_OVERHEAD = (
    *((4.4, 1.6), (9.6, 0.8), (16.6, 1.4), (24.0, 5.3), (23.6, 11.6)),
    *((20.6, 17.2), (14.2, 16.6), (7.4, 17.0), (1.5, 13.4), (0.9, 7.1)),
)
"""Smoke detectors and grilles of the ventilation."""
_SITES = (
    *(("south outer", x) for x in (10.0, 15.1, 17.0)),
    *(("south inner", x) for x in (5.6, 6.6, 7.8, 10.2, 11.6, 12.5)),
    *(("east outer", x) for x in (6.6, 7.7, 10.3, 11.4)),
    *(("north outer", x) for x in (10.0, 11.4, 16.4, 17.3)),
    *(("north inner", x) for x in (6.4, 8.3, 11.6, 13.9)),
    *(("west inner", x) for x in (4.8, 7.7)),
    *(("west outer", x) for x in (7.8, 12.8)),
)


def _movables(
    seed: int, arrangement: int, walls: dict[str, Wall], fittings: Fittings
) -> list[Surface]:
    """Place the movable objects. Their looks depend on the seed, their places and headings on the
    arrangement."""
    rng = rng_of(seed, "corridor/movables")
    cloth = [(0.2, 0.3, 0.5), (0.55, 0.2, 0.18), (0.25, 0.4, 0.3)][int(rng.integers(3))]
    stock = [
        *(things.visitor_chair(fittings, rng, cloth) for _ in range(4)),
        *(things.potted_plant(rng, float(rng.uniform(0.9, 1.5))) for _ in range(4)),
        *(things.waste_bin(fittings) for _ in range(2)),
        *(things.cartons(rng, int(rng.integers(1, 4))) for _ in range(2)),
        things.cleaning_trolley(fittings),
        things.wet_floor_sign(),
    ]
    today = rng_of(seed, f"corridor/arrangement/{arrangement}")
    surfaces = []
    for thing, index in zip(stock, today.permutation(len(_SITES)), strict=False):
        name, x = _SITES[int(index)]
        turned = shifted(
            thing,
            (float(today.uniform(-0.06, 0.06)), -0.06, 0.0),
            float(today.uniform(-0.08, 0.08)),
        )
        surfaces += [
            replace(surface, name=MOVABLE + surface.name)
            for surface in on_wall(walls[name], x, turned)
        ]
    return surfaces
