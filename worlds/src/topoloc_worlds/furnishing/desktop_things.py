"""Build objects on desks. Each stands on z = 0 around the origin of its own frame and faces -y;
metres."""

from __future__ import annotations

from math import cos, pi, sin

import numpy as np

from topoloc_worlds.furnishing.interiors import Finishes, bulb, laminated, plastic, printed, screen
from topoloc_worlds.furnishing.lettering import blank, vivid, write
from topoloc_worlds.furnishing.pictures import photograph, plot
from topoloc_worlds.furnishing.prints import notice, poster
from topoloc_worlds.furnishing.screens import screen_content
from topoloc_worlds.scene import Material, Mesh, Picture, Surface
from topoloc_worlds.shapes import (
    bent_tube,
    box,
    cylinder,
    join,
    lathe,
    panel,
    placed,
    prism,
    tube,
    turned,
)


def monitor(
    rng: np.random.Generator, finishes: Finishes, width: float = 0.54, on: bool = True
) -> list[Surface]:
    """A flat screen on its foot, a little tilted back."""
    height, low = width * 9 / 16, 0.13
    w = width / 2
    shell = [
        box((-w - 0.008, -0.012, 0), (w + 0.008, 0.02, height + 0.02)),
        box((-w * 0.6, 0.02, height * 0.2), (w * 0.6, 0.045, height * 0.8)),
    ]
    shown = panel((-w, -0.0135, height + 0.013), (width, 0, 0), (0, 0, -height))
    light = box((w - 0.03, -0.0128, 0.003), (w - 0.022, -0.0125, 0.007), faces="s")
    foot = [
        box((-0.03, 0.03, 0.01), (0.03, 0.05, low + height * 0.5)),
        prism([(-0.12, -0.08), (0.12, -0.08), (0.14, 0.1), (-0.14, 0.1)], 0, 0.012),
    ]
    content = screen_content(rng)
    tilt = rng.uniform(0.02, 0.12)
    head = [
        placed(turned(mesh, (1, 0, 0), -tilt), (0, 0, low)) for mesh in (join(shell), shown, light)
    ]
    led = Material("light", (0.3, 0.6, 1.0), radiance=0.3) if on else finishes.grey
    return [
        Surface("monitor", join([head[0], *foot]), finishes.black),
        Surface("screen", head[1], screen(content, on)),
        Surface("monitor", head[2], led),
    ]


def keyboard(rng: np.random.Generator, finishes: Finishes) -> list[Surface]:
    """A keyboard, its keys in relief enough to throw small shadows."""
    picture = blank((96, 300), (0.13, 0.13, 0.14))
    blocks = []
    for row in range(5):
        x = 0.008
        while x < 0.425:
            width = 0.1 if row == 4 and 0.1 < x < 0.12 else 0.0185
            if width == 0.0185:
                write(
                    picture,
                    chr(int(rng.integers(65, 91))),
                    (300 * (x + 0.004) / 0.44, 96 * (0.03 + row * 0.022) / 0.15),
                    8,
                    (0.85, 0.85, 0.85),
                    12,
                )
            blocks.append(
                box(
                    (x - 0.22, 0.052 - row * 0.024, 0.014),
                    (x + width - 0.222, 0.072 - row * 0.024, 0.02),
                    faces="nsew",
                )
            )
            x += width + 0.001
    base = box((-0.222, -0.075, 0), (0.222, 0.08, 0.014))
    tops = panel((-0.22, 0.078, 0.0201), (0.44, 0, 0), (0, -0.15, 0))
    return [
        Surface("keyboard", join([base, *blocks]), finishes.black),
        Surface("keyboard", tops, laminated(picture)),
    ]


def mouse(finishes: Finishes) -> list[Surface]:
    """A mouse and its mat."""
    shell = lathe([(1.0, 0.0), (1.0, 0.3), (0.8, 0.7), (0.4, 0.95), (0.0, 1.0)], 14)
    body = Mesh(shell.vertices * [0.032, 0.055, 0.036], shell.faces, shell.uv)
    return [
        Surface("mouse", placed(body, (0, 0, 0.003)), finishes.black),
        Surface("mouse", box((-0.11, -0.1, 0), (0.11, 0.11, 0.003)), finishes.cover),
    ]


def mug(rng: np.random.Generator) -> list[Surface]:
    """Build a mug with a stripe or a picture, and a rest of coffee."""
    picture = blank((96, 256), vivid(rng) if rng.uniform() < 0.6 else (0.92, 0.91, 0.88))
    if rng.uniform() < 0.5:
        picture[20:76, 60:190] = photograph(rng, (56, 130))
    else:
        picture[int(rng.integers(10, 40)) : int(rng.integers(45, 80))] = np.round(
            np.array(vivid(rng)) * 255
        )
    wall = lathe([(0.036, 0.0), (0.041, 0.005), (0.041, 0.095), (0.037, 0.095), (0.036, 0.03)], 20)
    arc = [
        (0.041 + 0.028 * sin(a), 0.0, 0.05 + 0.028 * cos(a)) for a in np.linspace(0.2, pi - 0.2, 6)
    ]
    coffee = lathe([(0.0365, 0.0601), (0.0, 0.06)], 16)
    material = laminated(picture)
    return [
        Surface("mug", join([wall, bent_tube(arc, 0.006)]), material),
        Surface("mug", coffee, plastic((0.2, 0.12, 0.07), 0.1)),
    ]


def papers(rng: np.random.Generator, num: int = 3) -> list[Surface]:
    """Sheets strewn about: printed notices, diagrams, a coloured leaflet."""
    parts = []
    for k in range(num):
        maker = (notice, plot, poster)[int(rng.choice([0, 0, 1, 2]))]
        at = (rng.normal(0, 0.05), rng.normal(0, 0.04), 0.001 + 0.0012 * k)
        sheet = panel((-0.105, 0.148, 0), (0.21, 0, 0), (0, -0.297, 0))
        parts.append(
            Surface(
                "papers", placed(sheet, at, rng.normal(0, 0.35)), printed(maker(rng, (297, 210)))
            )
        )
    return parts


def book_stack(rng: np.random.Generator, num: int = 4) -> list[Surface]:
    """Books lying on each other, turned a little."""
    parts: list[Surface] = []
    z = 0.0
    for _ in range(num):
        width, depth, thickness = (
            rng.uniform(0.15, 0.23),
            rng.uniform(0.2, 0.28),
            rng.uniform(0.012, 0.045),
        )
        yaw = rng.normal(0, 0.2)
        front = poster(rng, (260, 190))
        cover = box(
            (-width / 2, -depth / 2, z + thickness - 0.003),
            (width / 2, depth / 2, z + thickness),
            faces="tnsew",
        )
        block = box(
            (-width / 2, -depth / 2, z),
            (width / 2 - 0.004, depth / 2 - 0.004, z + thickness - 0.003),
        )
        parts.append(Surface("book stack", placed(cover, (0, 0, 0), yaw), laminated(front)))
        parts.append(
            Surface(
                "book stack", placed(block, (0, 0, 0), yaw), Material("matt", (0.87, 0.84, 0.76))
            )
        )
        z += thickness
    return parts


def desk_lamp(finishes: Finishes, on: bool, turn: float = 0.0) -> list[Surface]:
    """Build a jointed lamp. Its shade is above the desk in front of it, closed below by an opal
    cover."""
    arm = [(0, 0, 0.02), (0.0, 0.1, 0.26), (0.0, -0.13, 0.44)]
    foot = cylinder((0, 0), 0.085, 0, 0.022, 20)
    shade = lathe([(0.085, 0.0), (0.05, 0.1), (0.025, 0.12), (0.0, 0.12)], 20)
    opal = lathe([(0.0, -0.012), (0.05, -0.008), (0.08, 0.004)], 20)
    top = (0.0, -0.15, 0.35)
    head = [placed(turned(mesh, (1, 0, 0), -0.3), top) for mesh in (shade, opal)]
    meshes = [
        placed(mesh, (0, 0, 0), turn) for mesh in (join([foot, bent_tube(arm, 0.009)]), *head)
    ]
    return [
        Surface("desk lamp", meshes[0], finishes.dark_metal),
        Surface("desk lamp", meshes[1], finishes.dark_metal),
        Surface("bulb", meshes[2], bulb(on)),
    ]


def potted_plant(
    rng: np.random.Generator, height: float = 0.5, num_leaves: int = 34
) -> list[Surface]:
    """A plant with long bent leaves in a pot a third of its height."""
    pot_height = height * 0.32
    radius = pot_height * 0.55
    pot = lathe(
        [
            (radius * 0.75, 0),
            (radius, pot_height),
            (radius * 1.06, pot_height),
            (radius * 0.9, pot_height * 0.9),
            (0, pot_height * 0.88),
        ],
        20,
    )
    leaves = [_leaf(rng, height, pot_height) for _ in range(num_leaves)]
    shade = rng.uniform(0.85, 1.15)
    green = np.clip(
        np.array([0.27, 0.42, 0.2]) * shade + 0.02 * rng.standard_normal((64, 32, 1)), 0, 1
    )
    green[:, 15:17] *= 1.2
    green[::6] *= 0.93
    leaf_picture = (np.clip(green, 0, 1) * 255).astype(np.uint8)
    return [
        Surface(
            "plant",
            pot,
            plastic((0.55, 0.3, 0.2) if rng.uniform() < 0.5 else (0.85, 0.85, 0.83), 0.4),
        ),
        Surface("plant", join(leaves), Material("polished", leaf_picture, roughness=0.35)),
    ]


def _leaf(rng: np.random.Generator, height: float, foot: float) -> Mesh:
    """A leaf in four pieces along an arc, widest in the middle."""
    yaw, reach, rise = (
        rng.uniform(0, 2 * pi),
        height * rng.uniform(0.15, 0.42),
        (height - foot) * rng.uniform(0.35, 1.0),
    )
    t = np.linspace(0, 1, 5)
    along = np.column_stack(
        [reach * t, np.zeros(5), foot * 0.9 + rise * np.sin(t * rng.uniform(1.4, 2.4))]
    )
    half = height * rng.uniform(0.03, 0.065) * np.array([0.15, 0.75, 1.0, 0.7, 0.05])
    side = np.array([0.0, 1.0, 0.0])
    lift = np.array([0.0, 0.0, 0.35])  # folded along its middle rib
    left, right = along + half[:, None] * (side + lift), along + half[:, None] * (lift - side)
    vertices = np.concatenate([left, along, right])
    i = np.arange(4)
    faces = [np.column_stack([a + i, a + i + 1, a + i + 6]) for a in (0, 5)] + [
        np.column_stack([a + i, a + i + 6, a + i + 5]) for a in (0, 5)
    ]
    uv = np.column_stack([np.repeat([0.0, 0.5, 1.0], 5), np.tile(t, 3)])
    return placed(Mesh(vertices, np.concatenate(faces).astype(np.int32), uv), (0, 0, 0), yaw)


def laptop(rng: np.random.Generator, finishes: Finishes, on: bool) -> list[Surface]:
    """An open laptop."""
    base = box((-0.16, -0.11, 0), (0.16, 0.11, 0.016))
    keys = blank((110, 300), (0.12, 0.12, 0.13))
    for row in range(5):
        for column in range(14):
            keys[6 + 20 * row : 22 + 20 * row, 8 + 20 * column : 25 + 20 * column] = 52
    lid = placed(turned(box((-0.16, 0, 0), (0.16, 0.008, 0.22)), (1, 0, 0), -0.3), (0, 0.11, 0.014))
    shown = placed(
        turned(panel((-0.15, -0.001, 0.21), (0.3, 0, 0), (0, 0, -0.19)), (1, 0, 0), -0.3),
        (0, 0.11, 0.014),
    )
    return [
        Surface("laptop", join([base, lid]), finishes.grey),
        Surface(
            "laptop", panel((-0.14, 0.09, 0.0162), (0.28, 0, 0), (0, -0.11, 0)), laminated(keys)
        ),
        Surface("laptop", shown, screen(screen_content(rng, (300, 474)), on)),
    ]


def pen_cup(rng: np.random.Generator, finishes: Finishes) -> list[Surface]:
    """A cup of pens and pencils, leaning all ways."""
    cup = lathe([(0.038, 0), (0.04, 0.1), (0.037, 0.1), (0.036, 0.01), (0.0, 0.01)], 16)
    parts = [Surface("pens", cup, finishes.dark_metal)]
    for _ in range(6):
        foot, head = rng.uniform(-0.02, 0.02, 2), rng.uniform(-0.05, 0.05, 2)
        pen = tube((*foot, 0.012), (*head, rng.uniform(0.13, 0.18)), 0.004, 6)
        parts.append(Surface("pens", pen, plastic(vivid(rng), 0.3)))
    return parts


def bottle(rng: np.random.Generator) -> list[Surface]:
    """A drinking bottle with a label."""
    body = lathe([(0.033, 0.0), (0.036, 0.01), (0.036, 0.17), (0.016, 0.21), (0.014, 0.23)], 16)
    cap = cylinder((0, 0), 0.017, 0.225, 0.25, 12)
    sticker = lathe([(0.0364, 0.05), (0.0364, 0.13)], 16)
    color = vivid(rng)
    return [
        Surface("bottle", body, plastic(color, 0.15)),
        Surface("bottle", cap, plastic((0.15, 0.15, 0.16), 0.3)),
        Surface("bottle", sticker, laminated(poster(rng, (80, 220)))),
    ]


def telephone(finishes: Finishes) -> list[Surface]:
    """A desk telephone with its receiver."""
    body = placed(turned(box((-0.09, -0.1, 0), (0.09, 0.1, 0.03)), (1, 0, 0), 0.2), (0, 0, 0.025))
    receiver = [
        box((-0.085, -0.095, 0.05), (-0.035, 0.1, 0.085)),
        box((-0.09, -0.1, 0.035), (-0.03, -0.05, 0.075)),
        box((-0.09, 0.06, 0.05), (-0.03, 0.11, 0.095)),
    ]
    keys = [
        placed(
            turned(box((x, y, 0.03), (x + 0.018, y + 0.014, 0.034)), (1, 0, 0), 0.2), (0, 0, 0.025)
        )
        for x in (-0.01, 0.018, 0.046)
        for y in (-0.08, -0.055, -0.03, -0.005)
    ]
    return [
        Surface("telephone", join([body, *receiver]), finishes.black),
        Surface("telephone", join(keys), finishes.grey),
    ]


def picture_frame(
    rng: np.random.Generator, finishes: Finishes, print_: Picture, width: float
) -> list[Surface]:
    """A framed picture to hang up: its back at y = 0, its lower edge at z = 0."""
    height = width * print_.shape[0] / print_.shape[1]
    w = width / 2
    bars = [box((-w - 0.02, -0.02, z), (w + 0.02, 0, z + 0.02)) for z in (-0.02, height)]
    bars += [box((x, -0.02, 0), (x + 0.02, 0, height)) for x in (-w - 0.02, w)]
    frame = finishes.black if rng.uniform() < 0.5 else finishes.chrome
    return [
        Surface("picture", join(bars), frame),
        Surface(
            "picture",
            panel((-w, -0.008, height), (width, 0, 0), (0, 0, -height)),
            laminated(print_),
        ),
    ]
