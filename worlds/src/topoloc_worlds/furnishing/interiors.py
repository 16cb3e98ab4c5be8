"""Make the materials of rooms, with faint, realistic structure.

Pictures are in sRGB. A colour of 0.91 there is a reflectance of 0.8. If a picture has a scale, its
docstring gives the length of one repeat.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from topoloc_worlds.furnishing.lettering import PAPER, to_bytes
from topoloc_worlds.noise import fractal_noise, smooth_noise
from topoloc_worlds.scene import Color, Material, Picture

WHITE: Color = (0.91, 0.905, 0.89)
BEECH: Color = (0.74, 0.58, 0.4)
OAK: Color = (0.6, 0.44, 0.28)
WALNUT: Color = (0.36, 0.24, 0.16)


def plaster(
    rng: np.random.Generator, tint: Color = WHITE, size: tuple[int, int] = (448, 800)
) -> Material:
    """Painted plaster, for a whole wall: almost nothing to see but faint stains, marks of shoes and
    chairs, filled holes."""
    h, w = size
    shade = 1 + 0.012 * fractal_noise(rng, size, w / 8, 4) + 0.004 * smooth_noise(rng, size, 0.8)
    shade -= (
        0.05
        * np.clip(np.linspace(-4, 1, h), 0, 1)[:, None]
        * (1 + fractal_noise(rng, size, 30)).clip(0, 2)
    )
    picture = _shaded(tint, shade)
    for _ in range(int(rng.integers(6, 14))):
        low = rng.uniform() < 0.7
        x, y = (
            int(rng.integers(0, w)),
            int(h * (rng.uniform(0.7, 0.97) if low else rng.uniform(0.1, 0.7))),
        )
        mark = np.zeros(size, np.float32)
        end = (x + int(rng.normal(0, w / 50)), y + int(rng.normal(0, h / 80)))
        cv2.line(mark, (x, y), end, 1.0, int(rng.integers(1, 3)), cv2.LINE_AA)
        picture = (
            picture * (1 - rng.uniform(0.04, 0.16) * cv2.GaussianBlur(mark, (0, 0), 0.8)[..., None])
        ).astype(np.uint8)
    for _ in range(int(rng.integers(2, 6))):
        at = (int(rng.integers(0, w)), int(rng.uniform(0.2, 0.6) * h))
        cv2.circle(picture, at, 1, to_bytes((0.45, 0.44, 0.42)), -1, cv2.LINE_AA)
    return Material("matt", picture)


def wood(
    rng: np.random.Generator,
    tone: Color = BEECH,
    size: tuple[int, int] = (256, 512),
    varnished: bool = True,
) -> Material:
    """Wood or veneer with its grain running across the picture: 1.2 m by 0.6 m."""
    h, w = size
    wave = cv2.resize(
        fractal_noise(rng, (h, max(w // 16, 8)), h / 6, 4), (w, h), interpolation=cv2.INTER_CUBIC
    )
    rings = np.sin(np.linspace(0, rng.uniform(40, 70), h)[:, None] + 3.0 * wave)
    fibres = cv2.resize(
        smooth_noise(rng, (h, max(w // 24, 8)), 0.7), (w, h), interpolation=cv2.INTER_CUBIC
    )
    shade = 1 + 0.07 * rings + 0.035 * fibres + 0.03 * fractal_noise(rng, size, w / 4, 2)
    return Material("polished" if varnished else "matt", _shaded(tone, shade), roughness=0.25)


def laminate(
    rng: np.random.Generator, tint: Color = (0.85, 0.85, 0.83), size: tuple[int, int] = (256, 512)
) -> Material:
    """The coated board of office furniture: plain, finely speckled, somewhat glossy; 1.2 m by 0.6
    m, with rings of cups and scratches."""
    picture = _shaded(
        tint, 1 + 0.01 * smooth_noise(rng, size, 0.7) + 0.012 * fractal_noise(rng, size, 60, 3)
    )
    for _ in range(int(rng.integers(1, 4))):
        centre = (int(rng.integers(0, size[1])), int(rng.integers(0, size[0])))
        ring = np.zeros(size, np.float32)
        cv2.ellipse(
            ring,
            centre,
            (17, 17),
            0.0,
            float(rng.uniform(0, 360)),
            float(rng.uniform(360, 560)),
            1.0,
            1,
            cv2.LINE_AA,
        )
        picture = (picture * (1 - 0.14 * ring[..., None])).astype(np.uint8)
    return Material("polished", picture, roughness=0.3)


def carpet(rng: np.random.Generator, tint: Color = (0.36, 0.4, 0.47), tiles: int = 4) -> Material:
    """Carpet tiles of half a metre laid in turns, worn and stained: 2 m by 2 m for four tiles a
    side."""
    side = 128
    size = (tiles * side, tiles * side)
    shade = np.ones(size, np.float32)
    for row in range(tiles):
        for column in range(tiles):
            stripes = np.repeat(
                rng.normal(0, 0.12, (1, side // 4)), 4, axis=1
            ) + 0.06 * smooth_noise(rng, (side, side), 0.7)
            tile = 1 + stripes + rng.normal(0, 0.025)
            if (row + column) % 2:
                tile = tile.T
            tile[0], tile[:, 0] = 0.86, 0.86
            shade[row * side : (row + 1) * side, column * side : (column + 1) * side] = tile
    shade *= 1 - 0.07 * np.clip(fractal_noise(rng, size, size[0] / 5, 4) - 0.8, 0, 1.5)
    return Material("matt", _shaded(tint, shade))


def linoleum(
    rng: np.random.Generator,
    tint: Color = (0.5, 0.52, 0.53),
    size: tuple[int, int] = (1024, 1024),
    roughness: float = 0.12,
) -> Material:
    """Marbled linoleum, waxed, with heel marks: 4 m by 4 m. The lower `roughness`, the clearer it
    mirrors."""
    streaks = cv2.resize(
        fractal_noise(rng, (size[0], size[1] // 6), 10, 4),
        size[::-1],
        interpolation=cv2.INTER_CUBIC,
    )
    speckles = (smooth_noise(rng, size, 1.0) > 2.0).astype(np.float32) - (
        smooth_noise(rng, size, 1.2) > 2.1
    )
    shade = (
        1
        + 0.045 * streaks
        + 0.16 * cv2.GaussianBlur(speckles, (0, 0), 0.7)
        + 0.02 * fractal_noise(rng, size, size[0] / 5, 3)
    )
    marks = np.zeros(size, np.float32)
    for _ in range(30):
        start = rng.integers(0, size[0], 2)
        cv2.line(
            marks,
            start.tolist(),
            (start + rng.normal(0, 14, 2)).astype(int).tolist(),
            float(rng.uniform(0.2, 1.0)),
            2,
            cv2.LINE_AA,
        )
    return Material(
        "polished",
        _shaded(tint, shade - 0.25 * cv2.GaussianBlur(marks, (0, 0), 1.0)),
        roughness=roughness,
    )


def stone_tiles(
    rng: np.random.Generator,
    tint: Color = (0.66, 0.63, 0.58),
    tiles: int = 4,
    roughness: float = 0.06,
) -> Material:
    """A polished floor of stone tiles with thin joints: 0.6 m a tile."""
    side = 160
    shade = 1 + 0.05 * fractal_noise(rng, (tiles * side, tiles * side), 24, 5)
    veins = np.abs(fractal_noise(rng, shade.shape, 60, 4))
    shade -= 0.1 * np.exp(-veins * 25)
    shade *= np.kron(1 + rng.normal(0, 0.035, (tiles, tiles)), np.ones((side, side)))
    for edge in range(0, tiles * side, side):
        shade[edge : edge + 2], shade[:, edge : edge + 2] = 0.6, 0.6
    return Material("polished", _shaded(tint, shade), roughness=roughness)


def fabric(rng: np.random.Generator, tint: Color) -> Material:
    """A woven cover: 0.2 m by 0.2 m."""
    size = (96, 96)
    y, x = np.mgrid[: size[0], : size[1]]
    weave = ((x // 2 + y // 2) % 2) * 0.14 - 0.07
    return Material(
        "matt",
        _shaded(
            tint,
            1
            + weave
            + 0.07 * smooth_noise(rng, size, 1.0)
            + 0.05 * fractal_noise(rng, size, 20, 3),
        ),
    )


def ceiling_tiles(rng: np.random.Generator, tiles: int = 4) -> Material:
    """Mineral fibre tiles with pin holes in a metal grid: 0.6 m a tile; here and there an old water
    stain."""
    side = 96
    size = (tiles * side, tiles * side)
    holes = (smooth_noise(rng, size, 0.8) > 1.9).astype(np.float32)
    shade = 1 - 0.2 * holes + 0.01 * fractal_noise(rng, size, 30, 3)
    shade *= np.kron(1 + rng.normal(0, 0.012, (tiles, tiles)), np.ones((side, side)))
    picture = _shaded((0.88, 0.88, 0.86), shade).astype(np.float32)
    stain = cv2.GaussianBlur(
        (fractal_noise(rng, size, side / 3, 4) > 2.4).astype(np.float32), (0, 0), 2.0
    )
    picture *= 1 - stain[..., None] * np.array([0.12, 0.2, 0.32])
    for edge in range(0, size[0], side):
        for line in (edge, edge - 1):
            picture[line], picture[:, line] = 226, 226
        picture[edge + 1], picture[:, edge + 1] = 140, 140
    return Material("matt", np.clip(picture, 0, 255).astype(np.uint8))


def concrete(
    rng: np.random.Generator, tint: Color = (0.63, 0.62, 0.6), size: tuple[int, int] = (512, 512)
) -> Material:
    """Bare concrete: clouds, pores, a joint of the formwork: 2.5 m by 2.5 m."""
    pores = cv2.GaussianBlur((smooth_noise(rng, size, 1.0) > 2.6).astype(np.float32), (0, 0), 0.7)
    shade = (
        1
        + 0.05 * fractal_noise(rng, size, size[0] / 5)
        - 0.35 * pores
        + 0.015 * smooth_noise(rng, size, 0.7)
    )
    shade[size[0] // 2 : size[0] // 2 + 2] *= 0.82
    return Material("matt", _shaded(tint, shade))


def brick_painted(
    rng: np.random.Generator, tint: Color = WHITE, rows: int = 16, columns: int = 8
) -> Material:
    """Brickwork painted over: 0.25 m by 0.0775 m a brick, so that 16 rows of 8 are 2 m by 1.24
    m."""
    brick_h, brick_w = 20, 64
    size = (rows * brick_h, columns * brick_w)
    shade = 1 + 0.02 * fractal_noise(rng, size, 16, 4)
    for row in range(rows):
        top = row * brick_h
        shift = (row % 2) * brick_w // 2
        for column in range(columns):
            left = column * brick_w + shift
            cells = np.arange(left, left + brick_w) % size[1]
            shade[top : top + brick_h, cells] *= 1 + rng.normal(0, 0.025)
            shade[top : top + brick_h, cells[:2]] *= 0.85
        shade[top : top + 2] *= 0.82
        shade[top + 2] *= 1.05
    return Material("matt", _shaded(tint, shade))


def painted_metal(rng: np.random.Generator, tint: Color = (0.72, 0.73, 0.74)) -> Material:
    """Powder coated sheet, as of cupboards and radiators, with chips and fingermarks: about 1 m."""
    size = (192, 192)
    chips = (smooth_noise(rng, size, 1.0) > 3.3).astype(np.float32)
    return Material(
        "polished",
        _shaded(tint, 1 + 0.012 * fractal_noise(rng, size, 40, 4) - 0.4 * chips),
        roughness=0.3,
    )


def plastic(tint: Color = (0.21, 0.21, 0.22), roughness: float = 0.25) -> Material:
    """Moulded plastic; the default is the black of computers."""
    return Material("polished", tint, roughness=roughness)


def rubber() -> Material:
    """Cables, wheels, feet."""
    return Material("matt", (0.16, 0.16, 0.16))


def brushed_metal(
    rng: np.random.Generator, tint: Color = (0.82, 0.83, 0.84), roughness: float = 0.25
) -> Material:
    """Aluminium or steel, brushed along the picture's rows."""
    size = (64, 64)
    lines = cv2.GaussianBlur(rng.standard_normal(size).astype(np.float32), (0, 0), 6.0, sigmaY=0.5)
    return Material("metal", _shaded(tint, 1 + 0.12 * lines), roughness=roughness)


def chrome() -> Material:
    """Handles and lamp arms."""
    return Material("metal", (0.86, 0.87, 0.88), roughness=0.12)


def glass_pane() -> Material:
    """A thin clear pane."""
    return Material("glass", (1.0, 1.0, 1.0))


def printed(picture: Picture) -> Material:
    """Paper, card or foil with something on it."""
    return Material("matt", picture)


def laminated(picture: Picture) -> Material:
    """A print behind foil or varnish: it shines at a slant."""
    return Material("polished", picture, roughness=0.15)


def screen(picture: Picture, on: bool = True, radiance: float = 0.08) -> Material:
    """Make a computer screen. It is dark and slightly reflecting if it is off."""
    return (
        Material("light", picture, radiance=radiance)
        if on
        else Material("polished", (0.12, 0.12, 0.13), roughness=0.15)
    )


def ceiling_lamp(on: bool, radiance: float = 1.0, color: Color = (1.0, 0.97, 0.9)) -> Material:
    """The opal cover of an office lamp."""
    return (
        Material("light", color, radiance=radiance)
        if on
        else Material("polished", (0.88, 0.88, 0.86), roughness=0.3)
    )


def bulb(on: bool, radiance: float = 3.0) -> Material:
    """The opal cover of a desk lamp: warm, small and bright."""
    return ceiling_lamp(on, radiance, (1.0, 0.85, 0.62))


def _shaded(tint: Color, shade: Float[np.ndarray, "h w"]) -> Picture:
    """A colour made lighter and darker by a factor a pixel."""
    return np.clip(shade[..., None] * np.asarray(tint) * 255 + 0.5, 0, 255).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Finishes:
    """The materials that a room's furniture shares: one shop delivered it all, and few materials
    make a fast renderer."""

    board: Material
    veneer: Material
    metal: Material
    dark_metal: Material
    chrome: Material
    black: Material
    grey: Material
    ivory: Material
    rubber: Material
    cover: Material
    paper: Material


def finishes_of(rng: np.random.Generator) -> Finishes:
    """Another office's furniture for every generator."""
    tones = (BEECH, OAK, WALNUT)
    covers = ((0.16, 0.2, 0.32), (0.35, 0.12, 0.12), (0.14, 0.15, 0.16), (0.16, 0.3, 0.26))
    return Finishes(
        board=laminate(rng),
        veneer=wood(rng, tones[int(rng.integers(0, 3))]),
        metal=painted_metal(rng),
        dark_metal=painted_metal(rng, (0.3, 0.31, 0.33)),
        chrome=chrome(),
        black=plastic(),
        grey=plastic((0.5, 0.51, 0.53), 0.35),
        ivory=plastic((0.84, 0.82, 0.76), 0.3),
        rubber=rubber(),
        cover=fabric(rng, covers[int(rng.integers(0, 4))]),
        paper=Material("matt", PAPER),
    )
