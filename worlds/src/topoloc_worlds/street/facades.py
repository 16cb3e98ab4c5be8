"""House fronts of a town, as the street sees them: plaster and brick houses, blocks of flats,
offices, workshops.

A front is made in its own frame (see facade_parts) and then set along the street.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topoloc_worlds.scene import Material, Mesh, Surface
from topoloc_worlds.shapes import box, cylinder, join, panel, tube
from topoloc_worlds.street.facade_parts import (
    Openings,
    balcony,
    bands,
    frames,
    gable_roof,
    panes,
    reveals,
    side_walls,
    sills,
    surrounds,
    wall,
)
from topoloc_worlds.street.materials import StreetMaterials
from topoloc_worlds.street.windows import ROOMS, SHOPS, SIGNS, cells


@dataclass(frozen=True)
class Style:
    """A kind of house. Lengths in metres."""

    bay: float
    window: tuple[float, float]
    floor_height: float
    num_floors: tuple[int, int]
    wall: str
    ground: str
    bars: tuple[int, int] = (1, 1)
    surround: float = 0.0
    balconies: float = 0.0
    flat: bool = False
    recess: float = 0.16
    trim: int = 0


STYLES = (
    Style(2.6, (1.15, 1.65), 3.3, (3, 4), "plasters", "shop", surround=0.14),
    Style(2.9, (1.2, 1.5), 3.1, (2, 3), "plasters", "homes", bars=(1, 0), recess=0.2),
    Style(2.5, (1.05, 1.7), 3.2, (3, 4), "bricks", "homes", bars=(0, 2), trim=1),
    Style(3.0, (1.3, 1.9), 3.5, (3, 4), "stones", "shop", surround=0.18, trim=1),
    Style(
        3.6,
        (2.2, 1.45),
        2.9,
        (4, 5),
        "plasters",
        "homes",
        bars=(2, 0),
        balconies=0.5,
        flat=True,
        trim=2,
    ),
    Style(2.7, (1.25, 1.6), 3.2, (3, 4), "bricks", "shop", bars=(1, 1), surround=0.0, trim=0),
    Style(5.2, (3.0, 1.1), 4.2, (2, 2), "bricks", "workshop", bars=(3, 1), flat=True, trim=3),
)
Parts = list[tuple[str, Mesh, Material]]


def house(
    style: Style,
    width: float,
    depth: float,
    sides: str,
    rng: np.random.Generator,
    kit: StreetMaterials,
) -> list[Surface]:
    """Build one house. `sides` lists its other walls ("l", "r", "b")."""
    choices: tuple[Material, ...] = getattr(kit, style.wall)
    material, trim = choices[int(rng.integers(0, len(choices)))], kit.trims[style.trim]
    shift = float(rng.uniform(0.0, 14.0))
    num_floors = int(rng.integers(style.num_floors[0], style.num_floors[1] + 1))
    height = 3.7 + style.floor_height * (num_floors - 1) + 0.5
    num_bays = max(2, int((width - 0.8) / style.bay))
    pitch = (width - 0.8) / num_bays
    middles = 0.4 + pitch * (np.arange(num_bays) + 0.5)
    columns = [(float(x - style.window[0] / 2), float(x + style.window[0] / 2)) for x in middles]
    sill = 0.9 if style.window[1] < 1.8 else 0.7
    floors = [3.7 + style.floor_height * k for k in range(num_floors - 1)]
    rows = [(z + sill, z + sill + style.window[1]) for z in floors]
    blind = rng.uniform(size=(len(rows), num_bays)) < 0.04
    front, openings = wall(width, (3.7, height), columns, rows, blind, shift)
    parts: Parts = [
        ("wall", front, material),
        ("wall", reveals(openings, style.recess, shift), material),
    ]
    parts += _windows(openings, style, trim, rng, kit)
    parts += _ground_floor(style, width, middles, material, trim, shift, rng, kit)
    parts += [("trim", bands(np.array([[0.0, width, 3.55, 3.7]]), 0.07), trim)]
    if style.surround:
        parts += [("trim", bands(surrounds(openings, style.surround), 0.05), trim)]
        parts += [
            (
                "trim",
                bands(
                    np.array(
                        [
                            [0.0, width, height - 0.35, height - 0.2],
                            [0.0, width, height - 0.2, height],
                        ]
                    ),
                    0.16,
                ),
                trim,
            )
        ]
    if style.balconies:
        parts += _balconies(columns, floors, style, rng, kit)
    parts += [("wall", mesh, material) for mesh in side_walls(width, depth, height, sides)]
    parts += _roof(style, width, depth, height, material, rng, kit)
    return [Surface(name, mesh, what) for name, mesh, what in parts]


def _windows(
    openings: Openings, style: Style, trim: Material, rng: np.random.Generator, kit: StreetMaterials
) -> Parts:
    parts = _split_panes("window", openings, style.recess, ROOMS, kit.panes, rng, kit.lit * 0.5)
    frame = kit.trims[0] if rng.uniform() < 0.7 else kit.trims[int(rng.integers(2, 5))]
    return [
        *parts,
        ("frame", frames(openings, style.recess, style.bars), frame),
        ("sill", sills(openings), trim),
    ]


def _split_panes(
    name: str,
    openings: Openings,
    depth: float,
    grid: tuple[int, int],
    pair: tuple[Material, Material],
    rng: np.random.Generator,
    lit: float,
) -> Parts:
    """Panes, some with light behind them: which, is drawn whether or not it is dark, so that the
    rest of the town stays the same."""
    parts, luck = cells(rng, len(openings), grid), rng.uniform(size=len(openings))
    found: Parts = []
    for which, material in zip((luck >= lit, luck < lit), pair, strict=True):
        if which.any():
            found.append((name, panes(openings[which], depth, parts[which]), material))
    return found


def _ground_floor(
    style: Style,
    width: float,
    middles: np.ndarray,
    material: Material,
    trim: Material,
    shift: float,
    rng: np.random.Generator,
    kit: StreetMaterials,
) -> Parts:
    if style.ground == "shop":
        return _shop(
            width, kit.stones[0] if rng.uniform() < 0.5 else material, trim, shift, rng, kit
        )
    door_bay = int(rng.integers(0, len(middles)))
    door = float(middles[door_bay])
    wide = 3.2 if style.ground == "workshop" else 1.15
    columns = [
        (float(x - style.window[0] / 2), float(x + style.window[0] / 2))
        for i, x in enumerate(middles)
        if i != door_bay
    ]
    rows = [(1.3, 2.8)] if style.ground == "homes" else [(2.1, 3.0)]
    low, openings = wall(
        width,
        (0.0, 3.7),
        [*columns, (door - wide / 2, door + wide / 2)],
        rows,
        np.zeros((1, len(columns) + 1), bool),
        shift,
    )
    # The wall function makes a window of the door's column; the door itself stands before it, in a
    # porch of the trim's material.
    openings = openings[:-1]
    high = 2.9 if style.ground == "homes" else 3.1
    leaf = panel((door - wide / 2, -0.03, high - 0.1), (wide, 0, 0), (0, 0, 0.1 - high))
    gate = kit.doors[int(rng.integers(0, len(kit.doors)))] if style.ground == "homes" else kit.steel
    porch = np.array(
        [
            [door - wide / 2 - 0.2, door - wide / 2, 0.0, high],
            [door + wide / 2, door + wide / 2 + 0.2, 0.0, high],
        ]
    )
    over = np.array([[door - wide / 2 - 0.25, door + wide / 2 + 0.25, high, high + 0.22]])
    spans = np.array(
        [[0.0, door - wide / 2 - 0.2, 0.0, 0.55], [door + wide / 2 + 0.2, width, 0.0, 0.55]]
    )
    parts: Parts = [
        ("wall", low, material),
        ("door", leaf, gate),
        ("trim", join([bands(porch, 0.14, 0.2), bands(over, 0.22, 0.2)]), trim),
        ("plinth", bands(spans, 0.04), kit.trims[2]),
        ("step", box((door - 0.8, -0.35, 0.0), (door + 0.8, 0.0, 0.16)), kit.concrete),
    ]
    if len(openings):
        parts += [
            ("wall", reveals(openings, style.recess, shift), material),
            *_windows(openings, style, trim, rng, kit),
        ]
    return parts


def _shop(
    width: float,
    pier: Material,
    trim: Material,
    shift: float,
    rng: np.random.Generator,
    kit: StreetMaterials,
) -> Parts:
    num = max(1, round((width - 1.0) / float(rng.uniform(3.2, 4.4))))
    pitch = width / num
    columns = [(float(pitch * k + 0.35), float(pitch * (k + 1) - 0.35)) for k in range(num)]
    low, openings = wall(width, (0.0, 3.7), columns, [(0.5, 2.85)], np.zeros((1, num), bool), shift)
    parts: Parts = [("wall", low, pier), ("wall", reveals(openings, 0.3, shift), pier)]
    parts += _split_panes("display window", openings, 0.3, SHOPS, kit.shops, rng, kit.lit * 0.7)
    parts += [
        (
            "frame",
            frames(openings, 0.3, (1, 0), 0.07),
            kit.iron if rng.uniform() < 0.6 else kit.steel,
        )
    ]
    door = openings[int(rng.integers(0, num))]
    leaf = np.array([[door[0] + 0.1, door[0] + 1.15, 0.05, 2.3]])
    parts += [
        (
            "door",
            join(
                [
                    bands(surrounds(leaf, 0.08), 0.02, 0.25),
                    bands(np.array([[leaf[0, 0], leaf[0, 1], 0.05, 0.5]]), 0.01),
                ]
            ),
            kit.iron,
        )
    ]
    first = 0.4
    while first < width - 3.0:
        long = min(float(rng.uniform(3.5, 5.5)), width - first - 0.3)
        span = np.array([[first, first + long, 2.95, 2.95 + long * 0.125]])
        parts += [("sign", bands(span, 0.1), kit.iron)]
        parts += _split_panes("sign", span, -0.11, SIGNS, kit.boards, rng, kit.lit * 0.8)
        if rng.uniform() < 0.3:
            cloth = panel((first, -0.1, 2.92), (long, 0, 0), (0, -1.1, -0.45), (long / 2, 1.0))
            edge = panel((first, -1.2, 2.47), (long, 0, 0), (0, 0, -0.18), (long / 2, 0.3))
            parts += [
                ("awning", join([cloth, edge]), kit.awning[int(rng.integers(0, len(kit.awning)))])
            ]
        first += long + float(rng.uniform(0.3, 2.0))
    return parts


def _balconies(
    columns: list[tuple[float, float]],
    floors: list[float],
    style: Style,
    rng: np.random.Generator,
    kit: StreetMaterials,
) -> Parts:
    slabs, rails = [], []
    chosen = rng.uniform(size=len(columns)) < style.balconies
    for j in np.flatnonzero(chosen).tolist():
        for z in floors:
            slab, rail = balcony((columns[j][0] - 0.25, columns[j][1] + 0.25), z, 1.1)
            slabs.append(slab)
            rails.append(rail)
    return (
        [("balcony", join(slabs), kit.concrete), ("railing", join(rails), kit.iron)]
        if slabs
        else []
    )


def _roof(
    style: Style,
    width: float,
    depth: float,
    height: float,
    material: Material,
    rng: np.random.Generator,
    kit: StreetMaterials,
) -> Parts:
    pipe = tube((width - 0.15, -0.1, 0.0), (width - 0.15, -0.1, height - 0.2), 0.05, 6)
    if style.flat:
        parapet = bands(np.array([[0.0, width, height, height + 0.5]]), 0.03, 0.25)
        deck = panel((0.0, depth, height), (width, 0, 0), (0, -depth, 0))
        plant = box((width * 0.3, 3.0, height), (width * 0.3 + 2.5, 5.0, height + 1.8))
        return [
            ("roof", join([deck, plant]), kit.concrete),
            ("trim", parapet, kit.trims[style.trim]),
            ("pipe", pipe, kit.steel),
        ]
    rise = float(rng.uniform(2.2, 4.4))
    tiles, ends = gable_roof(width, depth, height, rise)
    stacks, pots = [], []
    for x in rng.uniform(1.0, width - 1.0, int(rng.integers(1, 3))).tolist():
        top = height + rise + float(rng.uniform(0.5, 1.1))
        stacks.append(
            box((x, depth / 2 - 0.4, height), (x + 0.9, depth / 2 + 0.3, top), texels=0.08)
        )
        pots += [cylinder((x + d, depth / 2), 0.1, top, top + 0.35, 6) for d in (0.25, 0.65)]
    roof = kit.roofs[int(rng.integers(0, len(kit.roofs)))]
    parts: Parts = [
        ("roof", tiles, roof),
        ("wall", ends, material),
        ("chimney", join(stacks), kit.bricks[0]),
        ("chimney", join(pots), kit.roofs[0]),
    ]
    gutter = tube(
        (0.0, -0.5, height - rise * 0.9 / depth),
        (width, -0.5, height - rise * 0.9 / depth),
        0.07,
        6,
    )
    parts += [("pipe", join([pipe, gutter]), kit.steel)]
    if rng.uniform() < 0.6:
        parts += _dormers(width, depth, height, rise, rng, kit)
    return parts


def _dormers(
    width: float,
    depth: float,
    height: float,
    rise: float,
    rng: np.random.Generator,
    kit: StreetMaterials,
) -> Parts:
    at = np.arange(1.5, width - 2.5, float(rng.uniform(2.8, 4.0)))
    foot = height + rise * 0.25
    spans = np.array([[x + 0.12, x + 1.28, foot + 0.15, foot + 1.25] for x in at]).reshape(-1, 4)
    if not len(spans):
        return []
    front = depth / 2 * 0.25 - 0.05
    bodies = join(
        [box((x, front, foot - 0.2), (x + 1.4, front + 3.0, foot + 1.4), faces="sewt") for x in at]
    )
    glass = panes(spans, front - 0.02, cells(rng, len(spans), ROOMS))
    return [
        ("dormer", bodies, kit.trims[2]),
        ("window", glass, kit.panes[0]),
        ("frame", frames(spans, front - 0.01, (1, 0)), kit.trims[0]),
    ]


def office(
    width: float, depth: float, sides: str, rng: np.random.Generator, kit: StreetMaterials
) -> list[Surface]:
    """A block of glass: bands of windows between dark bands, thin mullions, a lobby below."""
    num_floors, step = int(rng.integers(3, 6)), 3.4
    height = 4.0 + num_floors * step
    num = max(2, round(width / 1.4))
    xs = np.linspace(0.0, width, num + 1)
    spans = [
        (xs[i], xs[i + 1], 4.0 + step * k + 0.9, 4.0 + step * (k + 1))
        for k in range(num_floors)
        for i in range(num)
    ]
    lobby = [(xs[i], xs[i + 1], 0.15, 3.5) for i in range(num)]
    dark = np.array([[0.0, width, 4.0 + step * k, 4.0 + step * k + 0.9] for k in range(num_floors)])
    parts = _split_panes("window", np.array(spans), 0.06, ROOMS, kit.panes, rng, kit.lit * 0.4)
    parts += _split_panes(
        "display window", np.array(lobby), 0.3, SHOPS, kit.shops, rng, kit.lit * 0.8
    )
    parts += [
        ("panel", bands(dark, 0.0, 0.1), kit.curtain_wall),
        (
            "trim",
            bands(np.array([[0.0, width, 3.5, 4.0], [0.0, width, height, height + 0.6]]), 0.1, 0.4),
            kit.trims[2],
        ),
    ]
    mullions = np.array([[x - 0.03, x + 0.03, 4.0, height] for x in xs])
    posts = np.array([[x - 0.06, x + 0.06, 0.0, 3.5] for x in xs[::2]])
    parts += [("mullion", join([bands(mullions, 0.07, 0.06), bands(posts, 0.0, 0.35)]), kit.steel)]
    parts += [
        ("wall", mesh, kit.stones[1]) for mesh in side_walls(width, depth, height + 0.6, sides)
    ]
    parts += [("roof", panel((0.0, depth, height), (width, 0, 0), (0, -depth, 0)), kit.concrete)]
    return [Surface(name, mesh, what) for name, mesh, what in parts]
