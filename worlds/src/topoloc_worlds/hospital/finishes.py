"""Make the textures of the hospital: pictures of one bay that repeat without a seam, so every metre
looks like the next."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from topoloc_worlds.corridor.parts import Fittings
from topoloc_worlds.furnishing import interiors
from topoloc_worlds.noise import fractal_noise, rng_of, smooth_noise
from topoloc_worlds.scene import Color, Material, Picture

PIXELS_PER_METRE = 240
DADO = 1.05
"""Height of the wooden part of a panel, metres."""
_PASTELS: tuple[Color, ...] = (
    (0.80, 0.86, 0.82),
    (0.84, 0.83, 0.76),
    (0.79, 0.84, 0.89),
    (0.88, 0.81, 0.78),
)
_LEAVES: tuple[Color, ...] = (
    (0.36, 0.55, 0.42),
    (0.72, 0.50, 0.26),
    (0.28, 0.45, 0.62),
    (0.62, 0.34, 0.36),
)
_FLOORS: tuple[Color, ...] = ((0.60, 0.62, 0.63), (0.55, 0.59, 0.56), (0.63, 0.57, 0.50))


@dataclass(frozen=True, eq=False)
class Finishes:
    """Hold the materials of one hospital. `corners` are the different paints of the squares between
    wings."""

    panel: Material
    floor: Material
    ceiling: Material
    paint: Material
    corners: tuple[Material, ...]
    fittings: Fittings

    @staticmethod
    def of(seed: int, height: float) -> Finishes:
        rng = rng_of(seed, "hospital/finishes")
        style = int(rng.integers(len(_PASTELS)))
        accents: tuple[Color, ...] = (
            (0.86, 0.72, 0.38),
            (0.42, 0.60, 0.70),
            (0.60, 0.70, 0.48),
            (0.78, 0.52, 0.46),
        )
        return Finishes(
            panel=Material("matt", panel_picture(rng, height, _PASTELS[style], _LEAVES[style])),
            floor=Material("matt", _floor_picture(rng, _FLOORS[int(rng.integers(len(_FLOORS)))])),
            ceiling=interiors.ceiling_tiles(rng, tiles=2),
            paint=interiors.plaster(rng),
            corners=tuple(
                interiors.plaster(rng, accents[int(k)]) for k in rng.permutation(len(accents))
            ),
            fittings=Fittings.of(seed),
        )


def panel_picture(rng: np.random.Generator, height: float, tint: Color, leaf: Color) -> Picture:
    """A panel of a metre: wood decor below, above it pale foil printed with leaves, and the joint
    to the next panel."""
    size = round(PIXELS_PER_METRE * height), PIXELS_PER_METRE
    foil = (
        np.asarray(tint)
        * (1.0 + 0.008 * fractal_noise(rng, size, 30.0, 4) + 0.004 * smooth_noise(rng, size, 0.8))[
            ..., None
        ]
    )
    picture = np.clip(foil * 255.0, 0, 255).astype(np.uint8)
    edge = size[0] - round(PIXELS_PER_METRE * DADO)
    _print_leaves(rng, picture[:edge], leaf)
    picture[edge:] = _decor(rng, (size[0] - edge, size[1]))
    picture[edge - 4 : edge] = (176, 178, 180)
    for column in (0, 1, size[1] - 1):
        picture[:, column] = (picture[:, column] * 0.45).astype(np.uint8)
    for x in (10, size[1] - 11):
        for z in (0.2, 0.95, 1.2, height - 0.2):
            cv2.circle(
                picture,
                (x, size[0] - round(PIXELS_PER_METRE * z)),
                3,
                (120, 122, 124),
                -1,
                cv2.LINE_AA,
            )
    return picture


def _decor(rng: np.random.Generator, size: tuple[int, int]) -> Picture:
    """Beech with its grain upright."""
    grain = fractal_noise(rng, (max(size[0] // 14, 8), size[1]), 18.0, 5)
    shade = 1.0 + 0.06 * cv2.resize(grain, size[::-1], interpolation=cv2.INTER_CUBIC)
    return np.clip(shade[..., None] * np.asarray(interiors.BEECH) * 255.0, 0, 255).astype(np.uint8)


def _print_leaves(rng: np.random.Generator, picture: Picture, leaf: Color) -> None:
    """Stalks with pairs of leaves, and some seeds that fly."""
    height, width = picture.shape[:2]
    for _ in range(3):
        foot = np.array([rng.uniform(0.15, 0.85) * width, height - 1.0])
        lean, reach = rng.uniform(-0.25, 0.25), rng.uniform(0.45, 0.8) * height
        tone = np.asarray(leaf) * rng.uniform(0.8, 1.15)
        ink = tuple(int(v) for v in np.clip(tone * 255, 0, 255))
        tip = foot + reach * np.array([lean, -1.0])
        cv2.line(picture, foot.astype(int).tolist(), tip.astype(int).tolist(), ink, 2, cv2.LINE_AA)
        for share in np.linspace(0.25, 0.95, int(rng.integers(5, 8))):
            at = foot + share * (tip - foot)
            for side in (-1.0, 1.0):
                long, turn = rng.uniform(0.09, 0.15) * width, rng.uniform(20.0, 50.0)
                centre = at + long * np.array(
                    [side * np.cos(np.radians(turn)), -np.sin(np.radians(turn))]
                )
                axes = (int(long), int(long * rng.uniform(0.25, 0.4)))
                cv2.ellipse(
                    picture,
                    centre.astype(int).tolist(),
                    axes,
                    -side * turn,
                    0.0,
                    360.0,
                    ink,
                    -1,
                    cv2.LINE_AA,
                )
    for _ in range(int(rng.integers(8, 13))):
        at = (int(rng.uniform(0.06, 0.94) * width), int(rng.uniform(0.06, 0.6) * height))
        cv2.circle(
            picture, at, int(rng.integers(2, 5)), tuple(int(v * 200) for v in leaf), -1, cv2.LINE_AA
        )


def _floor_picture(rng: np.random.Generator, tint: Color) -> Picture:
    """Flecked vinyl, a metre by a metre, with one faint seam."""
    size = (PIXELS_PER_METRE, PIXELS_PER_METRE)
    flecks = (smooth_noise(rng, size, 1.0) > 2.0).astype(np.float32) - (
        smooth_noise(rng, size, 1.2) > 2.1
    )
    shade = (
        1.0
        + 0.03 * fractal_noise(rng, size, 24.0, 4)
        + 0.14 * cv2.GaussianBlur(flecks, (0, 0), 0.7)
    )
    shade[:1] *= 0.88
    return np.clip(shade[..., None] * np.asarray(tint) * 255.0, 0, 255).astype(np.uint8)
