"""Build the laboratory equipment: instruments, tools, a robot arm. Each stands on z = 0 around its
own origin and faces -y; metres."""

from __future__ import annotations

from math import pi

import numpy as np

from topoloc_worlds.furnishing.interiors import Finishes, laminated, plastic, screen
from topoloc_worlds.furnishing.lettering import blank, vivid, write
from topoloc_worlds.furnishing.pictures import plot
from topoloc_worlds.furnishing.prints import whiteboard
from topoloc_worlds.scene import Material, Mesh, Surface
from topoloc_worlds.shapes import (
    Vector,
    bent_tube,
    box,
    cylinder,
    join,
    lathe,
    panel,
    placed,
    tube,
    turned,
)


def robot_arm(rng: np.random.Generator, finishes: Finishes, reach: float = 0.22) -> list[Surface]:
    """A small jointed arm with a gripper, in some posture of the generator's."""
    shoulder = np.array([0.0, 0.0, 0.16])
    yaw, lift, bend = rng.uniform(-pi, pi), rng.uniform(0.9, 1.3), rng.uniform(1.2, 1.9)
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    elbow = shoulder + reach * (np.cos(lift) * forward + [0, 0, np.sin(lift)])
    wrist = elbow + reach * (np.cos(lift - bend) * forward + [0, 0, np.sin(lift - bend)])
    across = np.array([-forward[1], forward[0], 0.0])
    joints = [tube(p - 0.05 * across, p + 0.05 * across, 0.042, 14) for p in (shoulder, elbow)]
    joints += [tube(wrist - 0.035 * across, wrist + 0.035 * across, 0.03, 12)]
    limbs = [
        tube(shoulder, elbow, 0.034, 12),
        tube(elbow, wrist, 0.027, 12),
        cylinder((0, 0), 0.06, 0.03, 0.16, 18),
    ]
    hand = wrist + 0.06 * forward
    fingers = [
        tube(
            hand + s * 0.025 * across,
            hand + s * 0.02 * across + 0.06 * forward - [0, 0, 0.02],
            0.007,
            6,
        )
        for s in (-1, 1)
    ]
    dark = [box((-0.1, -0.1, 0), (0.1, 0.1, 0.03)), tube(wrist, hand, 0.02, 8), *fingers]
    cable = [
        shoulder + 0.055 * across,
        (shoulder + elbow) / 2 + 0.09 * across,
        elbow + 0.06 * across,
        wrist + 0.04 * across,
    ]
    return [
        Surface(
            "robot arm",
            join(limbs),
            plastic((0.85, 0.42, 0.1) if rng.uniform() < 0.6 else (0.88, 0.88, 0.86), 0.2),
        ),
        Surface("robot arm", join([*joints, *dark]), finishes.dark_metal),
        Surface("robot arm", bent_tube(cable, 0.005), finishes.rubber),
    ]


def oscilloscope(rng: np.random.Generator, finishes: Finishes, on: bool) -> list[Surface]:
    """An instrument with a screen, knobs, sockets and a handle."""
    body = box((-0.19, -0.08, 0.015), (0.19, 0.1, 0.21))
    front = blank((160, 320), (0.72, 0.73, 0.72))
    for row in range(5):
        for column in range(3):
            x, y = 226 + 30 * column, 24 + 28 * row
            front[y - 6 : y + 6, x - 9 : x + 9] = np.round(
                np.array(vivid(rng) if (row + column) % 4 == 0 else (0.35, 0.36, 0.38)) * 255
            )
            write(
                front,
                str(rng.choice(["CH1", "CH2", "TRIG", "DIV", "RUN"])),
                (x - 9, y + 14),
                7,
                (0.1, 0.1, 0.1),
                20,
            )
    knobs = [
        placed(turned(cylinder((0, 0), 0.013, 0, 0.018, 12), (1, 0, 0), pi / 2), (x, -0.081, z))
        for x in (0.09, 0.13, 0.165)
        for z in (0.055, 0.11)
    ]
    sockets = [
        placed(turned(cylinder((0, 0), 0.008, 0, 0.02, 10), (1, 0, 0), pi / 2), (x, -0.081, 0.035))
        for x in (-0.14, -0.09, -0.04)
    ]
    handle = bent_tube(
        [(-0.15, 0, 0.21), (-0.13, 0, 0.25), (0.13, 0, 0.25), (0.15, 0, 0.21)], 0.009
    )
    shown = plot(rng, (120, 180), (0.03, 0.05, 0.06))
    lead = bent_tube(
        [(-0.14, -0.1, 0.035), (-0.16, -0.16, 0.01), (-0.1, -0.2, 0.006), (0.05, -0.19, 0.006)],
        0.003,
    )
    return [
        Surface("instrument", body, finishes.grey),
        Surface(
            "instrument",
            panel((-0.185, -0.0805, 0.2), (0.37, 0, 0), (0, 0, -0.18)),
            laminated(front),
        ),
        Surface(
            "instrument",
            panel((-0.175, -0.082, 0.19), (0.22, 0, 0), (0, 0, -0.13)),
            screen(shown, on),
        ),
        Surface("instrument", join([*knobs, handle, lead]), finishes.black),
        Surface("instrument", join(sockets), finishes.chrome),
    ]


def computer_case(rng: np.random.Generator, finishes: Finishes, on: bool = True) -> list[Surface]:
    """A tower with drive slots, a grille, a power light."""
    front = blank((220, 100), (0.12, 0.12, 0.13))
    for k in range(3):
        front[12 + 26 * k : 32 + 26 * k, 8:92] = 36
        front[20 + 26 * k : 23 + 26 * k, 30:70] = 12
    for k in range(14):
        front[100 + 8 * k : 103 + 8 * k, 10:90] = 60
    write(
        front,
        str(rng.choice(["NOVA", "AXIS", "T-800", "ORION"])),
        (30, 96),
        11,
        (0.7, 0.7, 0.7),
        50,
    )
    led = Material("light", (0.4, 1.0, 0.5), radiance=0.4) if on else finishes.grey
    return [
        Surface("computer", box((-0.1, -0.22, 0.01), (0.1, 0.22, 0.44)), finishes.black),
        Surface(
            "computer",
            panel((-0.098, -0.221, 0.435), (0.196, 0, 0), (0, 0, -0.42)),
            laminated(front),
        ),
        Surface("computer", panel((0.06, -0.222, 0.25), (0.012, 0, 0), (0, 0, -0.006)), led),
    ]


def tool_wall(
    rng: np.random.Generator, finishes: Finishes, width: float = 0.9, height: float = 0.5
) -> list[Surface]:
    """A perforated board with tools hanging on it. Its back is at y = 0, its lower edge at z =
    0."""
    holes = blank((int(height * 400), int(width * 400)), (0.5, 0.53, 0.56))
    holes[8::16, 8::16] = 20
    holes[9::16, 8::16] = 28
    w = width / 2
    parts = [
        Surface("tool wall", box((-w, -0.012, 0), (w, 0, height), faces="nsewtb"), laminated(holes))
    ]
    steel, grips = [], {k: [] for k in range(3)}
    for k, x in enumerate(np.arange(-w + 0.06, w - 0.04, 0.075)):
        top, length = height * rng.uniform(0.75, 0.92), rng.uniform(0.12, 0.26)
        kind = rng.integers(0, 3)
        if kind == 0:  # a screwdriver
            steel.append(
                tube((x, -0.03, top - 0.09), (x, -0.03, top - 0.09 - length * 0.7), 0.004, 6)
            )
            grips[k % 3].append(tube((x, -0.03, top), (x, -0.03, top - 0.1), 0.014, 8))
        elif kind == 1:  # a spanner
            steel.append(box((x - 0.008, -0.024, top - length), (x + 0.008, -0.018, top)))
            steel += [
                box((x + s - 0.006, -0.024, top - 0.005), (x + s + 0.006, -0.018, top + 0.022))
                for s in (-0.013, 0.013)
            ]
        else:  # pliers
            steel.append(box((x - 0.014, -0.03, top - 0.05), (x + 0.014, -0.016, top + 0.02)))
            grips[k % 3] += [
                tube(
                    (x + s * 0.01, -0.025, top - 0.04),
                    (x + s * 0.03, -0.025, top - 0.05 - length * 0.5),
                    0.007,
                    6,
                )
                for s in (-1, 1)
            ]
    if steel:
        parts.append(Surface("tool wall", join(steel), finishes.chrome))
    return parts + [
        Surface("tool wall", join(meshes), plastic(vivid(rng), 0.3))
        for meshes in grips.values()
        if meshes
    ]


def toolbox(rng: np.random.Generator, finishes: Finishes) -> list[Surface]:
    """A toolbox with a handle and clasps."""
    body = [
        box((-0.21, -0.1, 0), (0.21, 0.1, 0.14)),
        box((-0.215, -0.105, 0.14), (0.215, 0.105, 0.19)),
    ]
    handle = bent_tube([(-0.08, 0, 0.19), (-0.08, 0, 0.23), (0.08, 0, 0.23), (0.08, 0, 0.19)], 0.01)
    clasps = [box((x - 0.015, -0.112, 0.1), (x + 0.015, -0.1, 0.17)) for x in (-0.13, 0.13)]
    return [
        Surface("toolbox", join(body), plastic(vivid(rng), 0.3)),
        Surface("toolbox", join([handle, *clasps]), finishes.black),
    ]


def tripod(finishes: Finishes, height: float = 0.95) -> list[Surface]:
    """A camera on a tripod."""
    feet = [
        (0.32 * np.cos(a), 0.32 * np.sin(a), 0.0) for a in (0.3, 0.3 + 2 * pi / 3, 0.3 + 4 * pi / 3)
    ]
    legs = [tube((0, 0, height * 0.8), foot, 0.014, 8) for foot in feet] + [
        tube((0, 0, height * 0.5), (0, 0, height), 0.016, 8)
    ]
    body = [
        box((-0.06, -0.035, height), (0.06, 0.035, height + 0.08)),
        placed(
            turned(cylinder((0, 0), 0.03, 0, 0.06, 16), (1, 0, 0), pi / 2),
            (0, -0.035, height + 0.04),
        ),
    ]
    return [
        Surface("tripod", join(legs), finishes.dark_metal),
        Surface("tripod", join(body), finishes.black),
    ]


def floor_lamp(finishes: Finishes, on: bool, height: float = 1.75) -> list[Surface]:
    """An opal globe on a pole."""
    radius = 0.13
    pole = [
        cylinder((0, 0), 0.14, 0, 0.025, 24),
        tube((0, 0, 0.02), (0, 0, height - 2 * radius), 0.012),
    ]
    globe = lathe(
        [
            (radius * np.sin(a), height - radius - radius * np.cos(a))
            for a in np.linspace(0.05, pi - 0.05, 9)
        ],
        18,
    )
    glow = Material("light", (1.0, 0.86, 0.66), radiance=3.0) if on else finishes.ivory
    return [
        Surface("floor lamp", join(pole), finishes.dark_metal),
        Surface("floor lamp bulb", globe, glow),
    ]


def wall_board(
    rng: np.random.Generator, finishes: Finishes, width: float = 1.2, height: float = 0.8
) -> list[Surface]:
    """A whiteboard with its tray, pens and a sponge. Its back is at y = 0, its lower edge at z =
    0."""
    w = width / 2
    frame = [box((-w - 0.015, -0.02, z), (w + 0.015, 0, z + 0.015)) for z in (-0.015, height)]
    frame += [box((x, -0.02, 0), (x + 0.015, 0, height)) for x in (-w - 0.015, w)] + [
        box((-w * 0.6, -0.08, -0.03), (w * 0.6, 0, -0.015))
    ]
    pens = [
        tube((x, -0.05, -0.008), (x + 0.12, -0.05 + rng.normal(0, 0.01), -0.008), 0.008, 8)
        for x in (-0.3, -0.12, 0.1)
    ]
    writing = panel((-w, -0.012, height), (width, 0, 0), (0, 0, -height))
    return [
        Surface("whiteboard", join(frame), finishes.chrome),
        Surface(
            "whiteboard", writing, laminated(whiteboard(rng, (int(height * 640), int(width * 640))))
        ),
        Surface("pens", join([pens[0]]), plastic((0.7, 0.1, 0.1))),
        Surface("pens", join(pens[1:]), plastic((0.1, 0.15, 0.5))),
        Surface("sponge", box((0.25, -0.075, -0.015), (0.37, -0.025, 0.015)), finishes.cover),
    ]


def quadcopter(finishes: Finishes) -> list[Surface]:
    """A quadcopter on its landing gear, propellers at rest."""
    arms, blades = [], []
    for a in (pi / 4, 3 * pi / 4, 5 * pi / 4, 7 * pi / 4):
        end = np.array([0.14 * np.cos(a), 0.14 * np.sin(a), 0.16])
        arms += [
            tube((0, 0, 0.15), end, 0.011, 8),
            placed(cylinder((0, 0), 0.013, 0, 0.04, 12), end - [0, 0, 0.01]),
        ]
        arms.append(tube(end * 0.5, end * 0.62 * [1, 1, 0], 0.006, 6))
        blades.append(
            placed(box((-0.075, -0.009, 0), (0.075, 0.009, 0.003)), end - [0, 0, -0.032], a * 1.7)
        )
    body = box((-0.07, -0.05, 0.12), (0.07, 0.05, 0.19))
    return [
        Surface("quadcopter", join([body, *arms]), finishes.black),
        Surface("quadcopter", join(blades), finishes.grey),
    ]


def mesh_cables(rng: np.random.Generator, start: Vector, end: Vector, num: int = 3) -> Mesh:
    """Cables hanging from one point to another, each with its own slack."""
    cables = []
    for _ in range(num):
        t = np.linspace(0, 1, 9)[:, None]
        slack = rng.uniform(0.05, 0.25)
        points = (
            np.array(start) * (1 - t)
            + np.array(end) * t
            + rng.normal(0, 0.02, 3) * np.sin(pi * t)
            - np.array([0, 0, slack]) * 4 * t * (1 - t)
        )
        points[:, 2] = np.maximum(points[:, 2], 0.006)
        cables.append(bent_tube(list(points), 0.0045, 6))
    return join(cables)
