"""Make the materials of a street, once for all uses: walls, trims, roofs, panes, boards, and lit
ones."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from topoloc_worlds.conditions import Condition
from topoloc_worlds.noise import rng_of
from topoloc_worlds.scene import Color, Material, Picture
from topoloc_worlds.street.textures import (
    ashlar,
    bark,
    blotches,
    brickwork,
    colored,
    foliage,
    grass,
    planks,
    plaster,
    roof_tiles,
)
from topoloc_worlds.street.windows import displays, rooms, signs

_PLASTERS: tuple[Color, ...] = (
    (0.88, 0.85, 0.76), (0.86, 0.76, 0.56), (0.83, 0.66, 0.55), (0.8, 0.8, 0.79), (0.9, 0.9, 0.88),
    (0.72, 0.78, 0.72), (0.68, 0.72, 0.77), (0.7, 0.5, 0.42),
)  # fmt: skip
_DAYLIT = 0.1
"""Share of a clear noon above which lamps outside are off, and those in rooms do not show."""


@dataclass(frozen=True, eq=False)
class StreetMaterials:
    """Hold one object a material, so that a renderer can join all surfaces of the same material.

    A pair of materials is (unlit, lit). `lit` is the share of windows and boards with light, 0 by
    day.
    """

    plasters: tuple[Material, ...]
    bricks: tuple[Material, ...]
    stones: tuple[Material, ...]
    roofs: tuple[Material, ...]
    trims: tuple[Material, ...]
    doors: tuple[Material, ...]
    panes: tuple[Material, Material]
    shops: tuple[Material, Material]
    boards: tuple[Material, Material]
    curtain_wall: Material
    steel: Material
    iron: Material
    concrete: Material
    fence: Material
    hedge: Material
    lawn: Material
    bark: Material
    leaves: Material
    awning: tuple[Material, ...]
    lamp: tuple[Material, Material]
    lit: float = field(default=0.0)


def street_materials(seed: int, condition: Condition) -> StreetMaterials:
    """Make all materials of one town. By day only the lit ones depend on the condition."""
    rng = rng_of(seed, "street/materials")
    plasters = [
        Material("matt", plaster(rng, _PLASTERS[i])) for i in rng.permutation(len(_PLASTERS))[:6]
    ]
    bricks = [Material("matt", brickwork(rng, *tones)) for tones in _brick_tones(rng)]
    stones = [
        Material("matt", ashlar(rng, (0.72, 0.67, 0.57))),
        Material("matt", ashlar(rng, (0.62, 0.62, 0.6), 150, 160)),
    ]
    room, display, board = rooms(rng), displays(rng), signs(rng)
    return StreetMaterials(
        plasters=tuple(plasters),
        bricks=tuple(bricks),
        stones=tuple(stones),
        roofs=tuple(
            Material("matt", roof_tiles(rng, tone))
            for tone in ((0.6, 0.3, 0.22), (0.45, 0.27, 0.22), (0.33, 0.34, 0.37))
        ),
        trims=tuple(
            Material("matt", tone)
            for tone in (
                (0.9, 0.9, 0.88),
                (0.76, 0.7, 0.6),
                (0.45, 0.46, 0.47),
                (0.2, 0.24, 0.22),
                (0.4, 0.26, 0.18),
            )
        ),
        doors=tuple(
            Material("polished", planks(rng, tone, 8), roughness=0.2)
            for tone in ((0.42, 0.24, 0.14), (0.14, 0.26, 0.2), (0.2, 0.22, 0.34))
        ),
        panes=_behind_glass(room, 0.33, 0.012),
        shops=_behind_glass(display, 0.55, 0.03),
        boards=(Material("matt", board), Material("light", board, radiance=0.025)),
        curtain_wall=Material("polished", (0.16, 0.2, 0.22), roughness=0.02),
        steel=Material("polished", (0.55, 0.56, 0.57), roughness=0.25),
        iron=Material("polished", (0.13, 0.14, 0.14), roughness=0.3),
        concrete=Material(
            "matt", colored((0.6, 0.59, 0.57), 1.0 + 0.07 * blotches(rng, (256, 256), 60.0))
        ),
        fence=Material("matt", planks(rng, (0.5, 0.38, 0.27))),
        hedge=Material("matt", foliage(rng, (256, 256), (0.3, 0.4, 0.17), 3.0)),
        lawn=Material("matt", grass(rng)),
        bark=Material("matt", bark(rng)),
        leaves=Material("matt", _leaf_tones(rng)),
        awning=tuple(
            Material("matt", _stripes(tone))
            for tone in ((0.65, 0.15, 0.13), (0.13, 0.32, 0.24), (0.2, 0.25, 0.5))
        ),
        lamp=(
            Material("matt", (0.85, 0.85, 0.82)),
            Material("light", (1.0, 0.87, 0.66), radiance=9.0),
        ),
        lit=0.0 if condition.daylight > _DAYLIT else condition.lamps,
    )


def _brick_tones(rng: np.random.Generator) -> list[tuple[Color, Color]]:
    all_tones: list[tuple[Color, Color]] = [
        ((0.56, 0.31, 0.24), (0.66, 0.63, 0.58)),
        ((0.48, 0.27, 0.2), (0.45, 0.42, 0.39)),
        ((0.7, 0.58, 0.4), (0.62, 0.6, 0.55)),
        ((0.42, 0.36, 0.33), (0.6, 0.58, 0.55)),
    ]
    return [all_tones[i] for i in rng.permutation(4)[:3]]


def _behind_glass(picture: Picture, share: float, radiance: float) -> tuple[Material, Material]:
    """A pane by day, dark and with reflections, and the same with light behind it."""
    return Material("polished", (picture * share).astype(np.uint8), roughness=0.01), Material(
        "light", picture, radiance=radiance
    )


def _leaf_tones(rng: np.random.Generator) -> Picture:
    """Shades of green, 8 by 8 of them; a leaf takes its colour from one."""
    tone = (
        np.asarray([0.36, 0.45, 0.16])
        * rng.uniform(0.7, 1.25, (8, 8, 1))
        * rng.uniform([0.8, 0.95, 0.8], [1.25, 1.05, 1.2], (8, 8, 3))
    )
    return np.repeat(np.repeat((np.clip(tone, 0, 1) * 255).astype(np.uint8), 4, axis=0), 4, axis=1)


def _stripes(tone: Color) -> Picture:
    picture = np.full((32, 64, 3), 228, np.uint8)
    picture[:, (np.arange(64) // 8) % 2 == 0] = np.round(np.asarray(tone) * 255)
    return picture
