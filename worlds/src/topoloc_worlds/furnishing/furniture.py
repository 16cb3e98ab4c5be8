"""Furniture of offices and laboratories. Each piece stands on z = 0 around the origin of its own
frame and faces -y; metres."""

from __future__ import annotations

from math import cos, pi, sin

import numpy as np

from topoloc_worlds.furnishing.interiors import (
    Finishes,
    painted_metal,
    plastic,
    printed,
    wood,
)
from topoloc_worlds.furnishing.lettering import vivid
from topoloc_worlds.furnishing.printed_things import carton, label
from topoloc_worlds.scene import Material, Mesh, Picture, Surface
from topoloc_worlds.shapes import (
    bent_tube,
    box,
    cylinder,
    join,
    lathe,
    panel,
    placed,
    surfaces_placed,
    tube,
    turned,
)


def desk(
    finishes: Finishes,
    width: float = 1.5,
    depth: float = 0.7,
    height: float = 0.74,
    drawers: int = 3,
) -> list[Surface]:
    """A desk: a top on steel legs, and a set of drawers on its left (0 drawers: none)."""
    w, d = width / 2, depth / 2
    top = box((-w, -d, height - 0.026), (w, d, height), texels=0.8)
    legs = [
        box((x - 0.025, -d + 0.04, 0), (x + 0.025, -d + 0.09, height - 0.026))
        for x in (-w + 0.04, w - 0.04)
    ]
    legs += [
        box((x - 0.025, d - 0.09, 0), (x + 0.025, d - 0.04, height - 0.026))
        for x in (-w + 0.04, w - 0.04)
    ]
    legs += [box((-w + 0.06, d - 0.08, height - 0.09), (w - 0.06, d - 0.05, height - 0.026))]
    parts = [Surface("desk", top, finishes.board), Surface("desk", join(legs), finishes.metal)]
    if drawers:
        parts += surfaces_placed(
            drawer_unit(finishes, height=height - 0.12, drawers=drawers), (-w + 0.31, 0.02, 0)
        )
    return parts


def drawer_unit(
    finishes: Finishes,
    width: float = 0.42,
    depth: float = 0.56,
    height: float = 0.6,
    drawers: int = 3,
) -> list[Surface]:
    """A chest of drawers with metal handles."""
    w, d = width / 2, depth / 2
    body = box((-w, -d, 0.04), (w, d, height), texels=0.8)
    fronts, handles = [], []
    for k in range(drawers):
        low, high = (
            0.05 + (height - 0.06) * k / drawers,
            0.045 + (height - 0.06) * (k + 1) / drawers,
        )
        fronts.append(box((-w + 0.004, -d - 0.016, low + 0.004), (w - 0.004, -d, high), texels=0.8))
        handles.append(tube((-0.07, -d - 0.04, high - 0.05), (0.07, -d - 0.04, high - 0.05), 0.006))
        handles += [
            tube((x, -d - 0.016, high - 0.05), (x, -d - 0.04, high - 0.05), 0.005)
            for x in (-0.07, 0.07)
        ]
    return [
        Surface("drawers", join([body, *fronts]), finishes.board),
        Surface("drawers", join(handles), finishes.chrome),
    ]


def office_chair(finishes: Finishes, height: float = 0.47, turn: float = 0.0) -> list[Surface]:
    """A swivel chair on five wheels; `turn` turns the seat on its foot."""
    spokes, wheels = [], []
    for k in range(5):
        angle = 2 * pi * k / 5
        end = (0.3 * cos(angle), 0.3 * sin(angle), 0.07)
        spokes.append(tube((0.0, 0.0, 0.13), end, 0.022, 6))
        wheels.append(
            placed(
                turned(cylinder((0.0, 0.0), 0.032, -0.02, 0.02, 10), (1, 0, 0), pi / 2),
                (end[0], end[1], 0.032),
                angle,
            )
        )
    foot = [*spokes, tube((0, 0, 0.1), (0, 0, height - 0.05), 0.025)]
    seat = [placed(_cushion(0.48, 0.46, 0.08), (0, 0, height - 0.04))]
    back = placed(
        turned(_cushion(0.44, 0.46, 0.06), (1, 0, 0), pi / 2 - 0.12), (0, 0.23, height + 0.35)
    )
    arms, bars = [], [tube((0, 0.2, height), (0, 0.25, height + 0.25), 0.02)]
    for x in (-0.27, 0.27):
        arms.append(box((x - 0.03, -0.14, height + 0.18), (x + 0.03, 0.12, height + 0.205)))
        bars.append(
            bent_tube(
                [(x * 0.85, 0.02, height), (x, 0.02, height + 0.02), (x, 0.02, height + 0.18)],
                0.014,
            )
        )
    upper = [
        Surface("chair", placed(join([*seat, back]), (0, 0, 0), turn), finishes.cover),
        Surface("chair", placed(join(arms), (0, 0, 0), turn), finishes.black),
        Surface("chair", placed(join(bars), (0, 0, 0), turn), finishes.dark_metal),
    ]
    return [
        *upper,
        Surface("chair", join(foot), finishes.dark_metal),
        Surface("chair", join(wheels), finishes.rubber),
    ]


def _cushion(width: float, depth: float, thickness: float) -> Mesh:
    """A flat cushion with rounded corners and bevelled edges around the origin."""
    outline = [(1.0, -0.55), (1.0, 0.55), (0.8, 0.95), (0.5, 1.0), (-0.5, 1.0), (-0.8, 0.95)]
    outline += [(-1.0, 0.55), (-1.0, -0.55), (-0.8, -0.95), (-0.5, -1.0), (0.5, -1.0), (0.8, -0.95)]
    ring = np.array(outline) * [width / 2, depth / 2]
    layers = ((0.86, -0.5), (1.0, -0.2), (1.0, 0.2), (0.86, 0.5))
    num = len(ring)
    vertices = np.concatenate(
        [np.column_stack([ring * s, np.full(num, t * thickness)]) for s, t in layers]
    )
    i, j = np.arange(num), (np.arange(num) + 1) % num
    faces = []
    for a in range(0, 3 * num, num):
        faces += [
            np.column_stack([a + i, a + j, a + num + j]),
            np.column_stack([a + i, a + num + j, a + num + i]),
        ]
    fan = np.array([[0, k, k + 1] for k in range(1, num - 1)])
    faces += [3 * num + fan, fan[:, ::-1]]
    return Mesh(
        vertices,
        np.concatenate(faces).astype(np.int32),
        vertices[:, :2] * 5.0 + vertices[:, 2:] * 5.0,
    )


def crate(rng: np.random.Generator, width: float, depth: float, height: float) -> list[Surface]:
    """An open plastic box with a rim and a label; odds and ends stick out of it."""
    w, d = width / 2, depth / 2
    outside = [
        panel((-w, -d, height), (width, 0, 0), (0, 0.01, -height)),
        panel((w, d, height), (-width, 0, 0), (0, -0.01, -height)),
    ]
    outside += [
        panel((w, -d, height), (0, depth, 0), (-0.01, 0, -height)),
        panel((-w, d, height), (0, -depth, 0), (0.01, 0, -height)),
    ]
    outside += [panel((-w, d, 0.005), (width, 0, 0), (0, -depth, 0))]
    rim = [tube((-w, y, height), (w, y, height), 0.009, 6) for y in (-d, d)] + [
        tube((x, -d, height), (x, d, height), 0.009, 6) for x in (-w, w)
    ]
    things = []
    for _ in range(int(rng.integers(2, 6))):
        x, y = rng.uniform(-0.6, 0.6) * w, rng.uniform(-0.6, 0.6) * d
        things.append(
            placed(
                box((-0.03, -0.02, 0), (0.03, 0.02, height * rng.uniform(0.7, 1.15))),
                (x, y, 0.01),
                rng.uniform(0, pi),
            )
        )
    sticker = panel(
        (-w * 0.3, -d - 0.002, height * 0.7), (w * 0.6, 0, 0), (0, 0.004, -height * 0.3)
    )
    return [
        Surface("crate", join([*outside, *rim]), plastic(vivid(rng), 0.3)),
        Surface("crate", join(things), plastic(vivid(rng), 0.4)),
        Surface("crate", sticker, printed(label(rng))),
    ]


def carton_box(
    rng: np.random.Generator, size: tuple[float, float, float], print_: Picture | None = None
) -> list[Surface]:
    """A closed cardboard box of (width, depth, height), printed alike on its sides."""
    width, depth, height = size
    picture = carton(rng) if print_ is None else print_
    return [
        Surface(
            "carton",
            box((-width / 2, -depth / 2, 0), (width / 2, depth / 2, height)),
            printed(picture),
        )
    ]


def cupboard(
    rng: np.random.Generator,
    finishes: Finishes,
    width: float = 0.8,
    depth: float = 0.42,
    height: float = 1.95,
) -> list[Surface]:
    """A steel cupboard with two doors, handles, air slits and a few stickers."""
    w, d = width / 2, depth / 2
    body = box((-w, -d, 0.06), (w, d, height), texels=1.0)
    doors = [
        box((x + 0.004, -d - 0.016, 0.07), (x + w - 0.004, -d, height - 0.01), texels=1.0)
        for x in (-w, 0.0)
    ]
    dark = [
        box((-w + 0.03, -d + 0.03, 0), (w - 0.03, d, 0.06)),
        box((-0.004, -d - 0.004, 0.07), (0.004, -d + 0.001, height - 0.01)),
    ]
    dark += [
        box((x - 0.1, -d - 0.018, z), (x + 0.1, -d - 0.0165, z + 0.008))
        for x in (-w / 2, w / 2)
        for z in height - 0.12 - 0.025 * np.arange(4)
    ]
    handles = [
        box((x - 0.008, -d - 0.05, height * 0.5), (x + 0.008, -d - 0.035, height * 0.5 + 0.14))
        for x in (-0.05, 0.05)
    ]
    parts = [
        Surface("cupboard", join([body, *doors]), finishes.metal),
        Surface("cupboard", join(dark), finishes.rubber),
    ]
    parts.append(Surface("cupboard", join(handles), finishes.chrome))
    for _ in range(int(rng.integers(1, 4))):
        x, z = (
            float(rng.choice([-w / 2, w / 2])) + rng.normal(0, 0.05),
            rng.uniform(height * 0.55, height * 0.85),
        )
        parts.append(
            Surface(
                "cupboard",
                panel((x - 0.06, -d - 0.018, z), (0.12, 0, 0), (0, 0, -0.08)),
                printed(label(rng)),
            )
        )
    return parts


def radiator(finishes: Finishes, width: float = 1.2, height: float = 0.55) -> list[Surface]:
    """A ribbed radiator hanging 10 cm above the floor, its valve on the right."""
    ribs = [
        box((x, -0.045, 0.1), (x + 0.036, 0.045, 0.1 + height))
        for x in np.arange(-width / 2, width / 2 - 0.03, 0.045)
    ]
    core = box((-width / 2, -0.03, 0.12), (width / 2, 0.03, 0.08 + height))
    valve = [
        tube((width / 2, 0, 0.15), (width / 2 + 0.08, 0, 0.15), 0.012),
        tube((width / 2 + 0.08, 0, 0), (width / 2 + 0.08, 0, 0.15), 0.012),
    ]
    knob = placed(
        turned(cylinder((0, 0), 0.022, 0, 0.06, 12), (0, 1, 0), pi / 2), (width / 2 + 0.08, 0, 0.15)
    )
    return [
        Surface("radiator", join([core, *ribs]), finishes.ivory),
        Surface("radiator", join([*valve, knob]), finishes.grey),
    ]


def coat_rack(rng: np.random.Generator, finishes: Finishes) -> list[Surface]:
    """A board with hooks at 1.7 m, with a jacket or two and a bag. Its back is at y = 0."""
    hooks = [tube((x, 0, 1.7), (x, -0.07, 1.73), 0.007) for x in (-0.3, -0.1, 0.1, 0.3)]
    parts = [
        Surface("coat rack", box((-0.4, -0.02, 1.65), (0.4, 0, 1.75)), finishes.veneer),
        Surface("coat rack", join(hooks), finishes.chrome),
    ]
    for x in rng.choice([-0.3, -0.1, 0.1, 0.3], int(rng.integers(1, 3)), replace=False):
        folds = [(1.7, 0.05), (1.6, 0.11), (1.35, 0.15), (1.0, 0.17), (0.85, 0.19)]
        coat = lathe([(r, z) for z, r in reversed(folds)], 14)
        waves = 1 + 0.12 * np.sin(7 * np.arctan2(coat.vertices[:, 1], coat.vertices[:, 0]))
        shape = np.column_stack(
            [
                coat.vertices[:, 0] * waves,
                coat.vertices[:, 1] * 0.55 * waves - 0.09,
                coat.vertices[:, 2],
            ]
        )
        color = 0.4 * np.array(vivid(rng)) + 0.05
        cloth = Material("matt", (float(color[0]), float(color[1]), float(color[2])))
        parts.append(
            Surface("coat", placed(Mesh(shape, coat.faces, coat.uv), (float(x), 0, 0)), cloth)
        )
    return parts


def waste_bin(finishes: Finishes) -> list[Surface]:
    """A waste-paper bin with crumpled paper in it."""
    wall = lathe([(0.12, 0.0), (0.15, 0.32), (0.145, 0.32), (0.115, 0.02), (0.0, 0.02)], 20)
    balls = [
        placed(lathe([(0.02, 0.0), (0.05, 0.02), (0.045, 0.07), (0.015, 0.09)], 6), (x, y, 0.2))
        for x, y in ((-0.04, 0.02), (0.05, -0.03))
    ]
    return [Surface("bin", wall, finishes.dark_metal), Surface("bin", join(balls), finishes.paper)]


def door(
    rng: np.random.Generator, finishes: Finishes, width: float = 0.95, height: float = 2.05
) -> list[Surface]:
    """A closed door in its steel frame, with handle and lock. Its back is at y = 0."""
    w = width / 2
    leaf = box((-w, -0.02, 0.01), (w, 0, height), texels=0.5)
    frame = [
        box((x - 0.045, -0.045, 0), (x + 0.045, 0, height + 0.045)) for x in (-w - 0.045, w + 0.045)
    ]
    frame.append(box((-w, -0.045, height), (w, 0, height + 0.045)))
    handle = [
        tube((w - 0.07, -0.02, 1.05), (w - 0.07, -0.07, 1.05), 0.01),
        tube((w - 0.07, -0.07, 1.05), (w - 0.2, -0.07, 1.05), 0.01),
    ]
    plate = box((w - 0.095, -0.026, 0.93), (w - 0.045, -0.02, 1.12))
    kick = box((-w + 0.03, -0.023, 0.03), (w - 0.03, -0.02, 0.2))
    return [
        Surface("door", leaf, wood(rng, (0.68, 0.52, 0.35), (512, 256))),
        Surface("door", join(frame), painted_metal(rng, (0.4, 0.42, 0.44))),
        Surface("door", join([*handle, plate, kick]), finishes.chrome),
    ]
