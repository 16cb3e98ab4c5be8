"""Build the view through the corridor's windows: a paved courtyard between the wings, and a lawn,
trees and a neighbour's house outside."""

from __future__ import annotations

import numpy as np

from topoloc_worlds.conditions import Condition
from topoloc_worlds.corridor.finishes import lawn, paving
from topoloc_worlds.corridor.plan import HEIGHT, LENGTH, SOUTH, WIDTH, solid
from topoloc_worlds.corridor.things import foliage
from topoloc_worlds.furnishing import interiors
from topoloc_worlds.noise import fractal_noise, rng_of
from topoloc_worlds.scene import Color, Material, Picture, Surface
from topoloc_worlds.shapes import box, panel, tube

COURT = (6.0, SOUTH, 18.6, 11.4)
"""The courtyard, as (x0, y0, x1, y1)."""
_STOREY = 3.1
_CLADDINGS: tuple[Color, ...] = (
    (0.72, 0.68, 0.6),
    (0.6, 0.36, 0.28),
    (0.66, 0.67, 0.68),
    (0.78, 0.72, 0.52),
)
_Face = tuple[tuple[float, float, float], tuple[float, float, float], float, int]
"""A front: top left corner, direction to the right, width (m), storeys."""


def outdoors(seed: int, condition: Condition) -> list[Surface]:
    """Courtyard and surroundings; only the lights in other people's windows depend on the
    condition."""
    rng = rng_of(seed, "corridor/outdoors")
    x0, y0, x1, y1 = COURT
    yard = panel(
        (x0, y1, -0.02),
        (x1 - x0, 0.0, 0.0),
        (0.0, y0 - y1, 0.0),
        ((x1 - x0) / 3.6, (y1 - y0) / 3.6),
    )
    ground = panel((-60.0, 70.0, -0.12), (150.0, 0.0, 0.0), (0.0, -130.0, 0.0), (15.0, 13.0))
    path = panel((LENGTH + 3.0, 60.0, -0.1), (2.2, 0.0, 0.0), (0.0, -110.0, 0.0), (0.6, 30.0))
    slabs = Material("matt", paving(rng))
    surfaces = [
        Surface("courtyard paving", yard, slabs),
        Surface("lawn", ground, Material("matt", lawn(rng))),
        Surface("path", path, slabs),
    ]
    cladding = _CLADDINGS[int(rng.integers(len(_CLADDINGS)))]
    fronts: list[_Face] = [
        ((x0, y1, 3 * _STOREY), (1.0, 0.0, 0.0), x1 - x0, 3),
        ((x0, y0, 3 * _STOREY), (0.0, 1.0, 0.0), y1 - y0, 3),
        ((x1, y1, 3 * _STOREY), (0.0, -1.0, 0.0), y1 - y0, 3),
        ((x1, y0, HEIGHT + 2 * _STOREY), (-1.0, 0.0, 0.0), x1 - x0, 2),
        ((LENGTH + 26.0, 34.0, 4 * _STOREY), (0.0, -1.0, 0.0), 46.0, 4),
    ]
    for number, front in enumerate(fronts):
        surfaces += _front(
            rng,
            front,
            cladding if number < 4 else _CLADDINGS[int(rng.integers(len(_CLADDINGS)))],
            seed,
            number,
            condition,
        )
    surfaces += _trees(rng)
    surfaces += _furniture(rng)
    return surfaces


def _front(
    rng: np.random.Generator,
    front: _Face,
    cladding: Color,
    seed: int,
    number: int,
    condition: Condition,
) -> list[Surface]:
    """One façade, and the panels of light in those of its windows behind which someone is."""
    corner, right, width, storeys = front
    columns = max(2, round(width / 2.6))
    wide = width / columns
    across = np.asarray(right) * width
    mesh = panel(corner, across, (0.0, 0.0, -storeys * _STOREY))
    surfaces = [
        Surface(
            f"front {number}",
            mesh,
            Material("matt", _front_picture(rng, columns, storeys, cladding)),
        )
    ]
    lit_share = 0.0 if condition.daylight > 0.05 else (0.45 if condition.lamps >= 0.9 else 0.1)
    lit = (
        rng_of(seed, f"corridor/lit windows/{number}/{condition.name}").random((storeys, columns))
        < lit_share
    )
    outward = np.cross(np.asarray(right), [0.0, 0.0, 1.0]) * 0.02
    panes = []
    for row, column in np.argwhere(lit):
        top_left = (
            np.asarray(corner)
            + np.asarray(right) * wide * (column + 0.22)
            - np.array([0.0, 0.0, (row + 0.18) * _STOREY])
            + outward
        )
        panes.append(panel(top_left, np.asarray(right) * wide * 0.56, (0.0, 0.0, -0.5 * _STOREY)))
    if panes:
        surfaces.append(
            solid(f"lit windows {number}", Material("light", _lit_window(), radiance=0.05), *panes)
        )
    return surfaces


def _front_picture(
    rng: np.random.Generator, columns: int, storeys: int, cladding: Color
) -> Picture:
    w, h = 72, 88
    picture = np.broadcast_to(
        np.asarray(cladding, np.float32), (storeys * h, columns * w, 3)
    ).copy()
    picture *= (1.0 + 0.04 * fractal_noise(rng, picture.shape[:2], coarsest_px=30.0))[..., None]
    for row in range(storeys):
        picture[row * h : row * h + 2] *= 0.7
        for column in range(columns):
            top, left = row * h + round(0.18 * h), column * w + round(0.22 * w)
            pane = picture[top : top + h // 2, left : left + round(0.56 * w)]
            picture[top - 2 : top + h // 2 + 3, left - 2 : left + round(0.56 * w) + 2] = 0.85
            pane[:] = np.linspace(0.34, 0.2, len(pane))[:, None, None] * np.array([0.85, 1.0, 1.15])
            blind = int(rng.choice([0, 0, 8, 16, 30]))
            pane[:blind] = 0.74
            pane[1:blind:3] = 0.62
            pane[:, pane.shape[1] // 2 - 1 : pane.shape[1] // 2 + 1] = 0.85
            picture[top + h // 2 + 3 : top + h // 2 + 5, left - 3 : left + round(0.56 * w) + 3] *= (
                0.6
            )
    return np.clip(picture * 255, 0, 255).astype(np.uint8)


def _lit_window() -> Picture:
    picture = np.full((44, 40, 3), (255, 226, 170), np.uint8)
    picture[:12] = (250, 214, 150)
    picture[30:, 4:16] = (120, 90, 60)
    picture[:, 19:21] = (60, 54, 48)
    return picture


def _trees(rng: np.random.Generator) -> list[Surface]:
    """Three in the courtyard, the others on the lawn, and a hedge."""
    places = [(9.2, 8.6, 3.4), (13.6, 6.9, 2.6), (16.4, 9.4, 3.0)]
    places += [
        (
            LENGTH + float(rng.uniform(7, 19)),
            float(y + rng.uniform(-2, 2)),
            float(rng.uniform(4.5, 8.0)),
        )
        for y in np.arange(-14, 34, 5.5)
    ]
    places += [
        (
            float(x + rng.uniform(-2, 2)),
            WIDTH + float(rng.uniform(9, 16)),
            float(rng.uniform(4.5, 7.0)),
        )
        for x in np.arange(0, 26, 6)
    ]
    places += [
        (float(x + rng.uniform(-2, 2)), -float(rng.uniform(9, 16)), float(rng.uniform(4.5, 7.0)))
        for x in np.arange(0, 26, 6)
    ]
    trunks, crowns = [], []
    for x, y, height in places:
        crown = 0.36 * height
        trunks.append(
            tube((x, y, -0.1), (x + rng.uniform(-0.1, 0.1), y, 0.7 * height), 0.03 * height / 2)
        )
        for _ in range(3):
            at = (
                x + rng.normal(0, 0.25 * crown),
                y + rng.normal(0, 0.25 * crown),
                height - crown * rng.uniform(0.7, 1.1),
            )
            crowns.append(
                foliage(rng, at, (0.8 * crown, 0.8 * crown, 0.65 * crown), 420, 0.11 * crown + 0.05)
            )
    hedge = foliage(rng, (LENGTH + 6.2, 9.0, 0.4), (0.6, 14.0, 0.7), 5000, 0.14)
    return [
        solid("trunks", Material("matt", (0.36, 0.29, 0.23)), *trunks),
        solid("crowns", Material("matt", (0.33, 0.44, 0.2)), *crowns),
        Surface("hedge", hedge, Material("matt", (0.27, 0.38, 0.18))),
    ]


def _furniture(rng: np.random.Generator) -> list[Surface]:
    """Planters and a bench in the courtyard, a bicycle stand outside."""
    planters = [
        box((x, y, -0.02), (x + 1.4, y + 1.4, 0.45))
        for x, y in ((8.5, 7.9), (12.9, 6.2), (15.7, 8.7))
    ]
    seat = [box((10.2, 4.6 + 0.13 * i, 0.42), (12.0, 4.7 + 0.13 * i, 0.45)) for i in range(3)]
    feet = [box((x, 4.6, -0.02), (x + 0.08, 4.96, 0.42)) for x in (10.4, 11.7)]
    stands = []
    for y in np.arange(7.0, 11.0, 0.8):
        stands += [
            tube((LENGTH + 2.0, y, -0.1), (LENGTH + 2.0, y, 0.75), 0.025),
            tube((LENGTH + 2.8, y, -0.1), (LENGTH + 2.8, y, 0.75), 0.025),
        ]
        stands.append(tube((LENGTH + 2.0, y, 0.75), (LENGTH + 2.8, y, 0.75), 0.025))
    return [
        solid("planters", interiors.concrete(rng), *planters),
        solid("garden bench", Material("matt", (0.55, 0.42, 0.28)), *seat),
        solid("garden steel", Material("metal", (0.7, 0.71, 0.72), roughness=0.3), *feet, *stands),
    ]
