"""The lamps along the corridor, and which of them burn."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from topoloc_worlds.conditions import Condition
from topoloc_worlds.corridor.parts import Fittings, ceiling_lamp
from topoloc_worlds.corridor.plan import EAST, LENGTH, LOOP, SOUTH, shifted
from topoloc_worlds.noise import rng_of
from topoloc_worlds.scene import Surface


def _lamp_sites() -> list[tuple[float, float, bool]]:
    """Places (x, y) of the ceiling lamps in the order of the loop, and whether they lie along x."""
    (x0, y0), (x1, _), (_, y1), _ = LOOP
    south = [(float(x), y0, True) for x in np.linspace(2.2, 22.8, 8)]
    east = [(x1, float(y), False) for y in np.linspace(4.0, 14.2, 4)]
    north = [(float(x), y1, True) for x in np.linspace(22.8, 2.2, 8)]
    west = [(x0, float(y), False) for y in np.linspace(14.2, 4.0, 4)]
    return south + east + north + west


_AT_NIGHT = 0.3
"""What the lamps are dimmed to when nobody is expected."""


def ceiling_lamps(seed: int, condition: Condition, fittings: Fittings) -> list[Surface]:
    """All lamps, lit or not, each with the colour of its own tubes."""
    lit, warmth = (
        _lit_lamps(seed, condition),
        rng_of(seed, "corridor/lamps").uniform(0.0, 1.0, len(_lamp_sites())),
    )
    level = _AT_NIGHT if condition.daylight <= 0.0 else 1.0
    surfaces = []
    for number, (x, y, lengthwise) in enumerate(_lamp_sites()):
        lamp = ceiling_lamp(level if number in lit else 0.0, float(warmth[number]), fittings)
        surfaces += shifted(lamp, (x, y, 0.0), 0.0 if lengthwise else np.pi / 2)
    return surfaces


def _lit_lamps(seed: int, condition: Condition) -> set[int]:
    """Which lamps burn: spread over the loop, by day away from the windows; of all of them, two are
    broken."""
    sites = _lamp_sites()
    rng = rng_of(seed, f"corridor/lit lamps/{condition.name}")
    wanted = round(condition.lamps * len(sites))
    if wanted >= len(sites):
        return set(range(len(sites))) - {
            int(number) for number in rng.choice(len(sites), 2, replace=False)
        }
    by_day = condition.daylight > 0.05
    useful = [
        number for number, (x, y, _) in enumerate(sites) if not (by_day and _by_windows(x, y))
    ]
    bounds = np.linspace(0, len(useful), min(wanted, len(useful)) + 1).round().astype(int)
    return {useful[int(rng.integers(low, high))] for low, high in pairwise(bounds.tolist())}


def _by_windows(x: float, y: float) -> bool:
    return (y < SOUTH and 5.0 < x < 17.0) or (x > LENGTH - EAST and 4.0 < y < 13.5)
