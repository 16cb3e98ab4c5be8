"""Make the textures of streets: plaster, brick, stone, concrete, roof tiles, slabs, bark, leaves,
earth."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32

from topoloc_worlds.noise import fractal_noise, smooth_noise
from topoloc_worlds.scene import Color, Picture

Field = Float32[np.ndarray, "h w"]
WALL_SIZE = (576, 704)
WALL_METRES = (11.52, 14.08)
"""Height and width of a wall's picture: 2 cm a texel."""


def blotches(
    rng: np.random.Generator, size: tuple[int, int], coarsest_px: float, octaves: int = 4
) -> Field:
    """Noise of large grains, drawn small and enlarged: mean 0, variance about 1, without a seam."""
    h, w = size
    small = (max(h // 8, 8), max(w // 8, 8))
    noise = np.pad(fractal_noise(rng, small, coarsest_px / 8, octaves), 1, mode="wrap")
    step_y, step_x = h / small[0], w / small[1]
    large = cv2.resize(
        noise, (round(w + 2 * step_x), round(h + 2 * step_y)), interpolation=cv2.INTER_CUBIC
    )
    return large[round(step_y) : round(step_y) + h, round(step_x) : round(step_x) + w]


def colored(color: Color, value: Field) -> Picture:
    """One colour, lightened and darkened by a field around 1."""
    return np.clip(np.asarray(color, np.float32) * value[..., None] * 255.0, 0, 255).astype(
        np.uint8
    )


def weathering(rng: np.random.Generator, size: tuple[int, int]) -> Field:
    """Return the ageing of a wall as a factor: blotches, streaks of rain from above, damp at the
    foot."""
    h, w = size
    streaks = cv2.GaussianBlur(
        np.repeat(smooth_noise(rng, (8, w), 1.5)[:1], h, axis=0), (0, 0), 1.0
    )
    depth = np.clip(blotches(rng, size, 60.0), 0, 2)
    foot = np.exp(-(h - 1 - np.arange(h, dtype=np.float32)) / (h * 0.05))[:, None] * (
        0.5 + 0.5 * np.clip(blotches(rng, size, 40.0) + 0.5, 0, 1)
    )
    return (
        1.0
        + 0.035 * blotches(rng, size, 90.0)
        - 0.05 * np.clip(streaks, 0, 2) * depth
        - 0.22 * foot
    )


def plaster(rng: np.random.Generator, color: Color) -> Picture:
    """Make a plastered wall with a few cracks, mended places and some gaps in the plaster."""
    size = WALL_SIZE
    value = weathering(rng, size) + 0.018 * smooth_noise(rng, size, 0.8)
    for _ in range(rng.integers(2, 6)):
        y, x = int(rng.integers(0, size[0])), int(rng.integers(0, size[1]))
        cv2.rectangle(
            value,
            (x, y),
            (x + int(rng.integers(20, 110)), y + int(rng.integers(15, 80))),
            float(value[y, x]) * float(rng.uniform(0.93, 1.06)),
            -1,
        )
    value += 0.01 * smooth_noise(rng, size, 1.2)
    for _ in range(rng.integers(4, 9)):
        cv2.polylines(value, [crack(rng, size, 90)], False, 0.72, 1, cv2.LINE_AA)
    picture = colored(color, value)
    bare = blotches(rng, size, 50.0) > rng.uniform(2.0, 2.8)
    picture[bare] = colored((0.5, 0.42, 0.36), 1.0 + 0.1 * smooth_noise(rng, size, 1.0))[bare]
    return picture


def crack(rng: np.random.Generator, size: tuple[int, int], length: int) -> np.ndarray:
    """A line that wanders, as points (x, y) for OpenCV to draw."""
    start = rng.uniform([0, 0], [size[1], size[0]])
    wander = np.cumsum(rng.normal(0, 0.35, length))
    turns = (
        rng.uniform(0, 2 * np.pi)
        + 0.9 * np.tanh(wander - wander.mean())
        + rng.normal(0, 0.3, length)
    )
    return np.round(
        start + np.cumsum(2.5 * np.column_stack([np.cos(turns), np.sin(turns)]), axis=0)
    ).astype(np.int32)


def brickwork(rng: np.random.Generator, color: Color, joint: Color) -> Picture:
    """Bricks of 24 by 8 cm with their joints, each of its own shade."""
    h, w = WALL_SIZE
    picture = colored(joint, 1.0 + 0.05 * smooth_noise(rng, (h, w), 1.0))
    course, length = 4, 11
    shades = rng.normal(1.0, 0.10, (h // course, w // length + 1)) * np.where(
        rng.uniform(size=(h // course, w // length + 1)) < 0.06, 0.7, 1.0
    )
    for row in range(h // course):
        shift = (length // 2) * (row % 2)
        columns = ((np.arange(w) + shift) % w) // length
        inside = ((np.arange(w) + shift) % length) > 0
        tone = np.asarray(color)[None] * shades[row, columns][:, None] * 255
        picture[row * course : row * course + course - 1, inside] = np.clip(tone, 0, 255).astype(
            np.uint8
        )[inside]
    value = weathering(rng, (h, w)) + 0.03 * smooth_noise(rng, (h, w), 0.7)
    return np.clip(picture * value[..., None], 0, 255).astype(np.uint8)


def ashlar(rng: np.random.Generator, color: Color, course: int = 24, length: int = 48) -> Picture:
    """Make blocks of stone, or panels of concrete if they are large."""
    h, w = WALL_SIZE
    value = weathering(rng, (h, w)) + 0.025 * smooth_noise(rng, (h, w), 1.0)
    for row, y in enumerate(range(0, h, course)):
        start = (row % 2) * length // 2 if length < 80 else 0
        for x in range(start - length, w, length):
            shade = float(rng.normal(1.0, 0.035))
            value[y : y + course, max(x, 0) : max(x + length, 0)] *= shade
            cv2.line(value, (x, y), (x, y + course), 0.68, 1)
            cv2.line(value, (x + 1, y), (x + 1, y + course), 1.06, 1)
        cv2.line(value, (0, y), (w, y), 0.66, 1)
        cv2.line(value, (0, y + 1), (w, y + 1), 1.05, 1)
    return colored(color, value)


def roof_tiles(rng: np.random.Generator, color: Color) -> Picture:
    """Rows of pantiles, 2.56 m square at 2 cm."""
    h = w = 256
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    wave = 0.5 + 0.5 * np.cos(2 * np.pi * x / 12.8)
    row = (y % 16) / 16
    shades = cv2.resize(
        rng.normal(1.0, 0.09, (16, 20)).astype(np.float32), (w, h), interpolation=cv2.INTER_NEAREST
    )
    return colored(
        color,
        shades * (0.62 + 0.3 * wave) * (0.75 + 0.35 * row) + 0.08 * blotches(rng, (h, w), 50.0),
    )


def slabs(
    rng: np.random.Generator, size: tuple[int, int], stone_px: tuple[int, int], color: Color
) -> Picture:
    """Pavement: rows of slabs with dark joints, chewing gum, stains and a mended strip."""
    h, w = size
    sh, sw = stone_px
    value = (
        1.0
        + 0.05 * blotches(rng, size, 60.0)
        + 0.05 * smooth_noise(rng, size, 0.8)
        + 0.03 * smooth_noise(rng, size, 3.0)
    )
    for row, y in enumerate(range(0, h, sh)):
        for x in range(-(row % 2) * sw // 2, w, sw):
            value[y : y + sh, max(x, 0) : x + sw] *= float(rng.normal(1.0, 0.07))
            if x > 0:
                cv2.line(value, (x, y), (x, y + sh), 0.6, 1)
        cv2.line(value, (0, y), (w, y), 0.58, 1)
    for _ in range(rng.integers(15, 40)):
        centre = (int(rng.integers(0, w)), int(rng.integers(0, h)))
        cv2.circle(
            value, centre, int(rng.integers(1, 3)), float(rng.uniform(0.55, 0.8)), -1, cv2.LINE_AA
        )
    for _ in range(rng.integers(1, 4)):
        stain = np.zeros(size, np.float32)
        cv2.circle(
            stain,
            (int(rng.integers(0, w)), int(rng.integers(0, h))),
            int(rng.integers(6, 22)),
            1.0,
            -1,
        )
        value *= 1.0 - 0.25 * cv2.GaussianBlur(stain, (0, 0), 4)
    return colored(color, value)


def foliage(
    rng: np.random.Generator, size: tuple[int, int], color: Color, leaf_px: float = 4.0
) -> Picture:
    """Many leaves over each other, seen from so near that each shows; the dark between them is
    deep."""
    h, w = size
    picture = colored(color, np.full(size, 0.28, np.float32))
    for layer in range(4):
        for _ in range(int(h * w / (leaf_px * leaf_px) / 3)):
            shade = (0.4 + 0.16 * layer) * float(rng.uniform(0.7, 1.4))
            tint = np.clip(
                np.asarray(color) * shade * [float(rng.uniform(0.85, 1.3)), 1.0, 0.9] * 255, 0, 255
            )
            centre = (int(rng.integers(0, w)), int(rng.integers(0, h)))
            axes = (
                max(1, round(leaf_px * float(rng.uniform(0.5, 1.1)))),
                max(1, round(leaf_px * float(rng.uniform(0.25, 0.5)))),
            )
            cv2.ellipse(
                picture, centre, axes, float(rng.uniform(0, 180)), 0, 360, tint.tolist(), -1
            )
    return picture


def grass(rng: np.random.Generator) -> Picture:
    """A lawn of 5 m square with bare and dry places."""
    size = (320, 320)
    value = (
        1.0
        + 0.16 * smooth_noise(rng, size, 0.8)
        + 0.08 * smooth_noise(rng, size, 2.5)
        + 0.1 * blotches(rng, size, 60.0)
    )
    picture = colored((0.33, 0.38, 0.2), value)
    dry = (blotches(rng, size, 40.0) > 1.3) & (smooth_noise(rng, size, 1.0) > -0.3)
    picture[dry] = colored((0.47, 0.41, 0.28), value)[dry]
    return picture


def bark(rng: np.random.Generator) -> Picture:
    """Bark of a plane or lime tree: furrows up the stem, lighter scales."""
    size = (256, 96)
    furrows = cv2.resize(smooth_noise(rng, (64, 96), 1.2), (96, 256), interpolation=cv2.INTER_CUBIC)
    value = 1.0 + 0.25 * furrows + 0.08 * smooth_noise(rng, size, 1.0)
    picture = colored((0.34, 0.3, 0.25), value)
    scale = blotches(rng, size, 40.0) > 1.1
    picture[scale] = colored((0.52, 0.5, 0.42), value)[scale]
    return picture


def planks(rng: np.random.Generator, color: Color, num: int = 14) -> Picture:
    """A fence or gate of upright boards, 2 m wide."""
    h, w = 128, 14 * num
    grain = cv2.resize(smooth_noise(rng, (16, w), 0.8), (w, h))
    tone = np.repeat(rng.normal(1.0, 0.09, num), 14)[None, :].astype(np.float32)
    value = tone * (1.0 + 0.07 * grain) + 0.03 * smooth_noise(rng, (h, w), 1.0)
    value[:, ::14] = 0.25
    return colored(color, value)
