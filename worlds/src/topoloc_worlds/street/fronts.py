"""Build both sides of a street: rows of houses, gaps with gardens, yards and walls, and the town
behind them."""

from __future__ import annotations

import cv2
import numpy as np

from topoloc_worlds.furnishing.lettering import to_bytes
from topoloc_worlds.noise import rng_of, smooth_noise
from topoloc_worlds.scene import Material, Mesh, Picture, Surface
from topoloc_worlds.shapes import box, join, panel, placed
from topoloc_worlds.street.facade_parts import set_at
from topoloc_worlds.street.facades import STYLES, house, office
from topoloc_worlds.street.furniture import FurnitureMaterials
from topoloc_worlds.street.materials import StreetMaterials
from topoloc_worlds.street.roads import HALF_LENGTH, HALF_WIDTH, PAVEMENT
from topoloc_worlds.street.textures import blotches, colored
from topoloc_worlds.street.trees import bush, hedge, tree

_DEPTH = 10.5
_OUT = (HALF_LENGTH + PAVEMENT[1], HALF_WIDTH + PAVEMENT[1])
_IN = (HALF_LENGTH - PAVEMENT[1], HALF_WIDTH - PAVEMENT[1])
_FOOT = 0.13
"""The pavement's height at the walls."""


def fronts(seed: int, kit: StreetMaterials, things: FurnitureMaterials) -> list[Surface]:
    """Build all houses on both sides of the circuit, and the objects between and behind them."""
    rows = [
        ((_OUT[0], -_OUT[1]), np.pi, 2 * _OUT[0]),
        ((-_OUT[0], -_OUT[1]), np.pi / 2, 2 * _OUT[1]),
        ((-_OUT[0], _OUT[1]), 0.0, 2 * _OUT[0]),
        ((_OUT[0], _OUT[1]), -np.pi / 2, 2 * _OUT[1]),
        ((-_IN[0], -_IN[1]), 0.0, 2 * _IN[0]),
        ((_IN[0], -_IN[1] + 0.45), np.pi / 2, 2 * _IN[1] - 0.9),
        ((_IN[0], _IN[1]), np.pi, 2 * _IN[0]),
        ((-_IN[0], _IN[1] - 0.45), -np.pi / 2, 2 * _IN[1] - 0.9),
    ]
    result = []
    for index, ((x, y), yaw, length) in enumerate(rows):
        pieces = _row(seed, index, length, kit, things)
        result += set_at(pieces, (x, y, _FOOT), yaw)
    corners = [
        box(
            (sx * (_IN[0] - 0.25) - 0.4, sy * (_IN[1] - 0.25) - 0.4, 0),
            (sx * (_IN[0] - 0.25) + 0.4, sy * (_IN[1] - 0.25) + 0.4, 11),
        )
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    result.append(Surface("corner", join(corners), kit.stones[0]))
    return result + _behind(rng_of(seed, "skyline"), kit)


def _row(
    seed: int, index: int, length: float, kit: StreetMaterials, things: FurnitureMaterials
) -> list[Surface]:
    """Houses side by side from x = 0 to `length`; the same kinds come again along the street, no
    house is another's copy."""
    rng = rng_of(seed, f"row/{index}")
    widths, free = [], []
    while sum(widths) < length - 22.0:
        gap = bool(widths and not free[-1] and sum(widths) > 20 and rng.uniform() < 0.24)
        widths.append(float(rng.uniform(7.0, 14.0)) if gap else float(rng.uniform(9.0, 18.0)))
        free.append(gap)
    widths.append(length - sum(widths))
    free.append(False)
    result, x = [], 0.0
    style = int(rng.integers(0, len(STYLES)))
    for i, (width, gap) in enumerate(zip(widths, free, strict=True)):
        own = rng_of(seed, f"row/{index}/{i}")
        if gap:
            pieces = _gap(own, width, kit, things)
        else:
            sides = ("" if i == 0 else "l") + ("" if i == len(widths) - 1 else "r") + "b"
            if own.uniform() > 0.3:
                style = int(own.integers(0, len(STYLES)))
            wide = width > 13.0 and own.uniform() < 0.3
            pieces = (
                office(width, _DEPTH, sides, own, kit)
                if wide
                else house(STYLES[style], width, _DEPTH, sides, own, kit)
            )
            if i + 1 < len(free) and free[i + 1]:
                pieces += _painted_wall(own, width, things)
        result += set_at(pieces, (x, 0.0, 0.0), 0.0)
        x += width
    return result


def _painted_wall(
    rng: np.random.Generator, width: float, things: FurnitureMaterials
) -> list[Surface]:
    """Large posters on a fire wall that looks into a gap."""
    at = width + 0.04
    boards = [
        panel((at, 1.2 + 3.0 * k, 5.6), (0, 2.6, 0), (0, 0, -3.6))
        for k in range(int(rng.integers(0, 3)))
    ]
    return [
        Surface("poster", board, things.posters[int(rng.integers(0, len(things.posters)))])
        for board in boards
    ]


def _gap(
    rng: np.random.Generator, width: float, kit: StreetMaterials, things: FurnitureMaterials
) -> list[Surface]:
    kind = int(rng.integers(0, 4))
    lawn = panel((0.0, 16.0, 0.0), (width, 0, 0), (0, -16.0, 0), (width / 5, 3.2))
    result = [Surface("lawn", lawn, kit.lawn if kind < 3 else kit.concrete)]
    if kind == 0:
        result += hedge(rng, width, float(rng.uniform(1.0, 1.7)), 0.7, kit)
    elif kind == 1:
        boards = panel((0.0, 0.05, 1.75), (width, 0, 0), (0, 0, -1.75), (width / 2, 1.0))
        posts = join(
            [box((x, 0.06, 0.0), (x + 0.1, 0.16, 1.85)) for x in np.arange(0.0, width, 2.0)]
        )
        result += [Surface("fence", boards, kit.fence), Surface("fence post", posts, kit.trims[4])]
    elif kind == 2:
        base = box((0.0, 0.0, 0.0), (width, 0.25, 0.55), texels=0.08)
        bars = [
            box((x, 0.1, 0.55), (x + 0.03, 0.13, 1.5)) for x in np.arange(0.1, width - 0.1, 0.15)
        ]
        rails = [box((0.0, 0.09, z), (width, 0.14, z + 0.04)) for z in (0.65, 1.4)]
        result += [
            Surface("garden wall", base, kit.bricks[1]),
            Surface("railing", join(bars + rails), kit.iron),
        ]
    else:
        garage = box((0.3, 9.0, 0.0), (width - 0.3, 14.0, 2.9), texels=0.07)
        gates = [
            panel((x, 8.97, 2.3), (2.5, 0, 0), (0, 0, -2.3), (3, 1))
            for x in np.arange(0.7, width - 2.9, 2.9)
        ]
        result += [
            Surface("garage", garage, kit.plasters[0]),
            Surface("gate", join(gates), kit.fence),
        ]
    if kind < 3:
        for _ in range(int(rng.integers(1, 3))):
            result += set_at(
                tree(rng, kit, float(rng.uniform(5.5, 10.0)), 2.4),
                (float(rng.uniform(2.2, width - 2.2)), float(rng.uniform(4.5, 11.0)), 0.0),
                0.0,
            )
        for _ in range(int(rng.integers(2, 6))):
            result += set_at(
                bush(rng, float(rng.uniform(0.5, 1.1)), kit),
                (float(rng.uniform(1, width - 1)), float(rng.uniform(1.6, 8.0)), 0.0),
                0.0,
            )
    elif rng.uniform() < 0.6:
        result += [
            Surface(
                "poster",
                panel((0.05, 4.0 + 2 * k, 2.4), (0, -1.4, 0), (0, 0, -2.0)),
                things.posters[k],
            )
            for k in range(2)
        ]
    return result


def _behind(rng: np.random.Generator, kit: StreetMaterials) -> list[Surface]:
    """The ground of the town, the roofs and towers behind the first row, trees of the
    courtyards."""
    result = [
        Surface(
            "ground",
            panel((-420.0, 300.0, -0.08), (840.0, 0, 0), (0, -600.0, 0), (168.0, 120.0)),
            kit.lawn,
        )
    ]
    blocks: list[list[Mesh]] = [[], [], [], []]
    for _ in range(70):
        angle = float(rng.uniform(0, 2 * np.pi))
        away = float(rng.uniform(30.0, 150.0))
        x = float(np.clip(1.4 * _OUT[0] * np.cos(angle), -_OUT[0], _OUT[0])) + away * np.cos(angle)
        y = (
            np.sign(np.sin(angle)) * (_OUT[1] + 12.0 + away)
            if abs(x) < _OUT[0] + 12.0
            else float(rng.uniform(-80, 80))
        )
        size, top = (
            rng.uniform(10.0, 26.0, 2),
            float(rng.uniform(9.0, 15.0) if rng.uniform() < 0.8 else rng.uniform(20.0, 42.0)),
        )
        body = box(
            (-size[0] / 2, -size[1] / 2, 0.0), (size[0] / 2, size[1] / 2, top), texels=1 / 12.0
        )
        blocks[int(rng.integers(0, 4))].append(
            placed(body, (x, float(y), -0.08), float(rng.uniform(0, 0.4)))
        )
    for meshes in blocks:
        result.append(Surface("skyline", join(meshes), Material("matt", _far_front(rng))))
    for _ in range(14):
        at = (float(rng.uniform(-_IN[0] + 20, _IN[0] - 20)), float(rng.uniform(-8.0, 8.0)), -0.05)
        result += set_at(tree(rng, kit, float(rng.uniform(10.0, 15.0)), 3.6), at, 0.0)
    return result


def _far_front(rng: np.random.Generator) -> Picture:
    """12 m of a front as it is seen from far, windows and all."""
    picture = colored(
        (0.7, 0.66, 0.58) if rng.uniform() < 0.6 else (0.55, 0.42, 0.36),
        1.0 + 0.04 * blotches(rng, (240, 240), 60.0) + 0.02 * smooth_noise(rng, (240, 240), 1.0),
    )
    for row in range(4):
        for column in range(4):
            x, y = 60 * column + 18, 60 * row + 14
            cv2.rectangle(picture, (x - 3, y - 3), (x + 27, y + 36), (225, 222, 215), -1)
            cv2.rectangle(
                picture,
                (x, y),
                (x + 24, y + 32),
                to_bytes((0.16, 0.18, float(rng.uniform(0.18, 0.3)))),
                -1,
            )
            cv2.line(picture, (x + 12, y), (x + 12, y + 32), (225, 222, 215), 2)
    return picture
