"""Build the movable objects of the corridor. Each stands on the floor with its back at y = 0 and
faces -y, as in front of a wall."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64

from topoloc_worlds.corridor.parts import Fittings
from topoloc_worlds.corridor.plan import shifted, solid
from topoloc_worlds.furnishing import interiors, printed_things, prints
from topoloc_worlds.scene import Color, Material, Mesh, Picture, Surface
from topoloc_worlds.shapes import box, cylinder, panel, placed, prism, tube


def visitor_chair(fittings: Fittings, rng: np.random.Generator, tint: Color) -> list[Surface]:
    """An upholstered chair on four legs of steel tube."""
    cover = interiors.fabric(rng, tint)
    seat = box((-0.23, -0.5, 0.43), (0.23, -0.06, 0.49), texels=5.0)
    back = box((-0.22, -0.08, 0.55), (0.22, -0.04, 0.88), texels=5.0)
    legs = [tube((x, y, 0.0), (x, y, 0.44), 0.011) for x in (-0.21, 0.21) for y in (-0.48, -0.08)]
    posts = [tube((x, -0.08, 0.44), (x, -0.05, 0.86), 0.011) for x in (-0.21, 0.21)]
    return [
        solid("chair cover", cover, seat, back),
        solid("chair legs", fittings.chrome, *legs, *posts),
    ]


def bench(fittings: Fittings) -> list[Surface]:
    """Three moulded seats of wood on a steel beam."""
    seats = [box((x, -0.48, 0.42), (x + 0.5, -0.06, 0.45)) for x in (-0.8, -0.25, 0.3)]
    backs = [box((x, -0.08, 0.52), (x + 0.5, -0.05, 0.85)) for x in (-0.8, -0.25, 0.3)]
    beam = box((-0.85, -0.3, 0.34), (0.85, -0.24, 0.4))
    legs = [box((x, -0.45, 0.0), (x + 0.05, -0.08, 0.03)) for x in (-0.6, 0.55)] + [
        box((x, -0.29, 0.0), (x + 0.05, -0.25, 0.36)) for x in (-0.6, 0.55)
    ]
    posts = [box((x, -0.07, 0.4), (x + 0.03, -0.04, 0.8)) for x in (-0.56, -0.01, 0.54)]
    return [
        solid("bench seats", fittings.wood, *seats, *backs),
        solid("bench frame", fittings.aluminium, beam, *legs, *posts),
    ]


def waste_bin(fittings: Fittings) -> list[Surface]:
    """A bin of steel with a black bag over its rim."""
    side = 20
    angles = np.arange(side) * (2 * np.pi / side)
    rim = [
        tube(
            (0.17 * np.cos(a), 0.17 * np.sin(a) - 0.2, 0.58),
            (0.17 * np.cos(b), 0.17 * np.sin(b) - 0.2, 0.58),
            0.012,
            6,
        )
        for a, b in zip(angles, np.roll(angles, -1), strict=True)
    ]
    return [
        solid(
            "bin",
            fittings.metal,
            placed(cylinder((0.0, 0.0), 0.165, 0.0, 0.56, side), (0.0, -0.2, 0.0)),
        ),
        solid("bin bag", fittings.black, *rim),
    ]


def potted_plant(rng: np.random.Generator, height: float = 1.3) -> list[Surface]:
    """Long arched leaves out of a pot of glazed clay."""
    pot = placed(
        prism(
            [(0.17 * np.cos(a), 0.17 * np.sin(a)) for a in np.arange(16) * (np.pi / 8)], 0.0, 0.34
        ),
        (0.0, -0.24, 0.0),
    )
    soil = placed(cylinder((0.0, 0.0), 0.155, 0.3, 0.345), (0.0, -0.24, 0.0))
    leaves = [_leaf(rng, height) for _ in range(34)]
    tint = (0.24 + rng.uniform(0, 0.08), 0.4 + rng.uniform(0, 0.1), 0.16)
    clay = [(0.82, 0.8, 0.76), (0.3, 0.32, 0.35), (0.62, 0.34, 0.22)][int(rng.integers(3))]
    return [
        solid("pot", interiors.plastic(clay, roughness=0.15), pot),
        solid("soil", Material("matt", (0.2, 0.16, 0.12)), soil),
        solid(
            "leaves",
            Material("polished", _leaf_picture(tint), roughness=0.3),
            *(placed(leaf, (0.0, -0.24, 0.0)) for leaf in leaves),
        ),
    ]


def _leaf(rng: np.random.Generator, height: float) -> Mesh:
    """A strip that rises from the pot and bends outwards."""
    length, lean, heading = (
        height * rng.uniform(0.45, 0.85),
        rng.uniform(0.05, 0.9),
        rng.uniform(0.0, 2 * np.pi),
    )
    t = np.linspace(0.0, 1.0, 6)
    out = np.minimum(0.02 + lean * (0.25 * t + 0.5 * t**2) * length, 0.21)
    up = 0.33 + length * (t - 0.35 * lean * t**2)
    half = 0.028 * np.sin(np.pi * np.clip(0.12 + 0.88 * t, 0, 1)) + 0.003
    outward, sideways = (
        np.array([np.cos(heading), np.sin(heading), 0.0]),
        np.array([-np.sin(heading), np.cos(heading), 0.0]),
    )
    spine = out[:, None] * outward + up[:, None] * [0.0, 0.0, 1.0]
    return _strip(spine - half[:, None] * sideways, spine + half[:, None] * sideways)


def _strip(left: Float64[np.ndarray, "n 3"], right: Float64[np.ndarray, "n 3"]) -> Mesh:
    n = len(left)
    i = np.arange(n - 1)
    faces = np.concatenate(
        [np.column_stack([i, n + i, n + i + 1]), np.column_stack([i, n + i + 1, i + 1])]
    ).astype(np.int32)
    v = np.linspace(1.0, 0.0, n)
    uv = np.concatenate([np.column_stack([np.zeros(n), v]), np.column_stack([np.ones(n), v])])
    return Mesh(np.concatenate([left, right]), faces, uv)


def _leaf_picture(tint: Color) -> Picture:
    across, along = np.meshgrid(np.linspace(-1, 1, 24), np.linspace(0, 1, 64))
    shade = (
        0.8
        + 0.35 * np.exp(-((across / 0.12) ** 2))
        + 0.12 * np.cos(40 * along - 5 * np.abs(across))
        - 0.2 * along
    )
    return np.clip(shade[..., None] * np.asarray(tint) * 255, 0, 255).astype(np.uint8)


def cartons(rng: np.random.Generator, count: int) -> list[Surface]:
    """Cardboard boxes, one upon the other."""
    surfaces, level = [], 0.0
    for _ in range(count):
        w, d, h = rng.uniform(0.3, 0.48), rng.uniform(0.28, 0.4), rng.uniform(0.2, 0.38)
        carton = box((-w / 2, -d / 2, 0.0), (w / 2, d / 2, h))
        material = interiors.printed(printed_things.carton(rng))
        surfaces.append(
            Surface(
                "carton",
                placed(carton, (rng.uniform(-0.03, 0.03), -0.26, level), rng.uniform(-0.15, 0.15)),
                material,
            )
        )
        level += h
    return surfaces


def cleaning_trolley(fittings: Fittings) -> list[Surface]:
    """Buckets, a sack and a mop on a wheeled frame, lengthwise along the wall."""
    deck = box((-0.45, -0.48, 0.12), (0.45, -0.08, 0.16))
    posts = [
        tube((x, y, 0.1), (x, y, 0.98), 0.013) for x in (-0.44, 0.0, 0.44) for y in (-0.46, -0.1)
    ]
    rails = [tube((-0.44, y, z), (0.44, y, z), 0.013) for y in (-0.46, -0.1) for z in (0.6, 0.98)]
    wheels = [
        placed(cylinder((0.0, 0.0), 0.04, 0.0, 0.1, 10), (x, y, 0.0))
        for x in (-0.4, 0.4)
        for y in (-0.44, -0.12)
    ]
    sack = box((0.03, -0.44, 0.3), (0.42, -0.12, 0.97))
    buckets = [
        placed(cylinder((0.0, 0.0), 0.13, 0.0, 0.28, 14), (x, -0.28, 0.16)) for x in (-0.3, -0.12)
    ]
    cloths = [box((-0.4, -0.42, 0.6), (-0.05, -0.14, 0.63))]
    mop = [tube((-0.4, -0.2, 0.2), (-0.36, -0.14, 1.45), 0.012)]
    return [
        solid("trolley frame", fittings.metal, deck, *posts, *rails),
        solid("trolley wheels", interiors.rubber(), *wheels),
        Surface("trolley sack", sack, interiors.plastic((0.86, 0.68, 0.1))),
        Surface("trolley blue bucket", buckets[0], interiors.plastic((0.12, 0.3, 0.66))),
        Surface("trolley red bucket", buckets[1], interiors.plastic((0.7, 0.12, 0.1))),
        solid("trolley cloths", interiors.plastic((0.5, 0.62, 0.7)), *cloths),
        solid("mop", fittings.wood, *mop),
    ]


def wet_floor_sign() -> list[Surface]:
    """The yellow trestle of the cleaners."""
    picture = np.full((160, 96, 3), (240, 200, 20), np.uint8)
    cv2.fillPoly(
        picture, [np.array([[48, 16], [20, 66], [76, 66]], np.int32)], (20, 20, 20), cv2.LINE_AA
    )
    cv2.fillPoly(
        picture, [np.array([[48, 28], [30, 61], [66, 61]], np.int32)], (240, 200, 20), cv2.LINE_AA
    )
    cv2.putText(
        picture, "WET", (18, 104), cv2.FONT_HERSHEY_DUPLEX, 0.95, (20, 20, 20), 2, cv2.LINE_AA
    )
    cv2.putText(
        picture, "FLOOR", (8, 138), cv2.FONT_HERSHEY_DUPLEX, 0.8, (20, 20, 20), 2, cv2.LINE_AA
    )
    front = panel((-0.15, -0.2, 0.62), (0.3, 0.0, 0.0), (0.0, -0.16, -0.62))
    back = panel((0.15, -0.2, 0.62), (-0.3, 0.0, 0.0), (0.0, 0.16, -0.62))
    return [solid("wet floor sign", interiors.laminated(picture), front, back)]


def copier(fittings: Fittings, rng: np.random.Generator) -> list[Surface]:
    """An office copier: paper drawers, lid, tray, a lit panel."""
    body = [
        box((-0.32, -0.62, 0.06), (0.32, -0.02, 0.86)),
        box((-0.32, -0.6, 0.9), (0.32, -0.05, 1.06)),
    ]
    seams = [box((-0.3, -0.626, z), (0.3, -0.62, z + 0.012)) for z in (0.24, 0.42, 0.6, 0.78)]
    grips = [box((-0.1, -0.628, z), (0.1, -0.62, z + 0.03)) for z in (0.16, 0.34, 0.52)]
    tray = box((-0.62, -0.5, 0.66), (-0.32, -0.14, 0.68))
    paper = box((-0.58, -0.46, 0.68), (-0.34, -0.18, 0.7))
    shown = panel((0.02, -0.665, 0.99), (0.22, 0.0, 0.0), (0.0, -0.1, -0.08))
    return [
        solid("copier", fittings.white, *body),
        solid(
            "copier trim",
            fittings.black,
            *seams,
            *grips,
            tray,
            box((0.0, -0.7, 0.86), (0.3, -0.6, 0.9)),
            box((-0.3, -0.6, 0.0), (0.3, -0.04, 0.06)),
        ),
        Surface("copier paper", paper, interiors.printed(prints.notice(rng))),
        Surface("copier panel", shown, Material("light", (0.55, 0.75, 0.95), radiance=0.06)),
    ]


def paper_shelf(fittings: Fittings, rng: np.random.Generator) -> list[Surface]:
    """An open case with packs of paper, folders and a carton on top."""
    boards = [box((-0.55, -0.4, z), (0.55, -0.02, z + 0.025)) for z in (0.05, 0.45, 0.85, 1.25)]
    sides = [box((x, -0.4, 0.0), (x + 0.025, -0.02, 1.275)) for x in (-0.57, 0.55)]
    packs = [
        box((x, -0.37, z), (x + 0.22, -0.07, z + h))
        for x, z, h in (
            (-0.5, 0.075, 0.3),
            (-0.2, 0.075, 0.22),
            (0.15, 0.475, 0.32),
            (-0.45, 0.475, 0.12),
        )
    ]
    folders = [
        panel((-0.52, -0.36, z + 0.32), (1.04, 0.0, 0.0), (0.0, 0.0, -0.32)) for z in (0.875,)
    ]
    widths = [int(w) for w in rng.integers(28, 48, 18)]
    return [
        solid("paper shelf", fittings.wood, *boards, *sides),
        solid("paper packs", interiors.printed(printed_things.label(rng, (90, 150))), *packs),
        solid("folders", interiors.printed(printed_things.book_spines(rng, widths)), *folders),
        *shifted(cartons(rng, 1), (-0.2, 0.04, 1.275)),
    ]


def vending_machine(fittings: Fittings, rng: np.random.Generator) -> list[Surface]:
    """Bottles and packets behind a lit front; it is never switched off."""
    body = box((-0.45, -0.75, 0.05), (0.45, -0.02, 1.85))
    shown = panel((-0.4, -0.756, 1.78), (0.58, 0.0, 0.0), (0.0, 0.0, -1.25))
    side = panel((0.22, -0.757, 1.5), (0.16, 0.0, 0.0), (0.0, 0.0, -0.3))
    slot = box((-0.35, -0.765, 0.2), (0.15, -0.75, 0.42))
    return [
        solid("vending machine", interiors.plastic((0.16, 0.2, 0.32)), body),
        Surface("vending front", shown, Material("light", _goods(rng), radiance=0.12)),
        solid("vending trim", fittings.black, slot, box((0.2, -0.762, 0.9), (0.4, -0.75, 1.1))),
        Surface("vending keys", side, interiors.printed(printed_things.label(rng, (150, 80)))),
    ]


def _goods(rng: np.random.Generator) -> Picture:
    picture = np.full((500, 232, 3), (212, 220, 226), np.uint8)
    for row in range(6):
        base = 80 + row * 80
        picture[base : base + 5] = (90, 92, 96)
        bottles = row >= 3
        for column in range(6 if bottles else 5):
            w = 22 if bottles else 30
            x, h = 8 + column * (w + 14), int(rng.uniform(48, 66))
            color = tuple(int(v) for v in rng.uniform(20, 240, 3))
            dark = tuple(v // 2 for v in color)
            picture[base - h : base, x : x + w] = dark if bottles else color
            picture[base - h // 2 : base - h // 6, x + 1 : x + w - 1] = color if bottles else 240
            if bottles:
                picture[base - h : base - h + 16, x : x + 7] = (212, 220, 226)
                picture[base - h : base - h + 16, x + w - 7 : x + w] = (212, 220, 226)
    return picture


def foliage(
    rng: np.random.Generator,
    centre: tuple[float, float, float],
    radii: tuple[float, float, float],
    count: int,
    size: float,
) -> Mesh:
    """Leaves, as `count` small slanted squares, mostly near the surface of an ellipsoid."""
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    lumps = 1.0 + 0.18 * np.sin(3.1 * direction @ rng.standard_normal((3, 3))).sum(axis=1)
    at = (
        np.asarray(centre)
        + direction * np.asarray(radii) * (lumps * rng.uniform(0.45, 1.0, count) ** 0.35)[:, None]
    )
    x = rng.standard_normal((count, 3))
    y = np.cross(x, rng.standard_normal((count, 3)))
    x, y = (0.5 * size * v / np.linalg.norm(v, axis=1, keepdims=True) for v in (x, y))
    vertices = np.stack([at - x - y, at - x + y, at + x + y, at + x - y], axis=1).reshape(-1, 3)
    first = 4 * np.arange(count)[:, None]
    faces = np.concatenate(
        [first + np.array(corners) for corners in ((0, 1, 2), (0, 2, 3))]
    ).astype(np.int32)
    uv = np.tile(np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]), (count, 1))
    return Mesh(vertices, faces, uv)
