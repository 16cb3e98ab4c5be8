"""Things with something printed on them: books, cartons, stickers, signs. Each piece another one.

All but the exit sign take a generator; they give sRGB pictures of one side, sizes are (height,
width) in pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from topoloc_worlds.furnishing.lettering import BOOKS, NAMES, blank, ink_on, to_bytes, vivid, write
from topoloc_worlds.furnishing.prints import pasted
from topoloc_worlds.noise import fractal_noise, smooth_noise
from topoloc_worlds.scene import Picture


def book_spines(
    rng: np.random.Generator, widths_px: Sequence[int], height_px: int = 192
) -> Picture:
    """Books side by side, seen from their backs: title along the back, author, bands. One strip of
    the picture a book."""
    spines = []
    for width in widths_px:
        cover = (
            vivid(rng)
            if rng.uniform() < 0.7
            else (lambda v: (v, v, v))(float(rng.choice([0.08, 0.25, 0.85, 0.93])))
        )
        spine = blank((width, height_px), cover)  # lying, so that the title can be written along it
        ink = ink_on(rng, cover)
        if rng.uniform() < 0.5:
            band = vivid(rng)
            start = int(height_px * rng.uniform(0.02, 0.8))
            spine[:, start : start + int(height_px * rng.uniform(0.04, 0.2))] = to_bytes(band)
        write(
            spine,
            str(rng.choice(BOOKS)),
            (height_px * 0.07, width * 0.68),
            width * rng.uniform(0.45, 0.75),
            ink,
            height_px * 0.6,
            bold=True,
        )
        write(
            spine,
            str(rng.choice(NAMES)),
            (height_px * 0.74, width * 0.66),
            width * 0.4,
            ink,
            height_px * 0.22,
        )
        rounded = 1 - 0.35 * np.abs(np.linspace(-1, 1, width)) ** 3
        spines.append(np.rot90((spine * rounded[:, None, None]).astype(np.uint8), -1))
    return np.ascontiguousarray(np.concatenate(spines, axis=1))


def door_sign(rng: np.random.Generator, size: tuple[int, int] = (120, 180)) -> Picture:
    """The plate beside a door: room number and names."""
    h, w = size
    picture = blank(size, (0.86, 0.87, 0.88))
    picture[: h // 12] = to_bytes(vivid(rng))
    number = f"{rng.choice(list('ABCE'))} {rng.integers(1, 5)}.{rng.integers(1, 60):02d}"
    write(picture, number, (w * 0.07, h * 0.42), h * 0.32, (0.1, 0.12, 0.2), w * 0.8, bold=True)
    for k in range(int(rng.integers(1, 4))):
        name = f"{rng.choice(['', '', 'Dr. '])}{rng.choice(NAMES)}"
        write(picture, name, (w * 0.07, h * (0.6 + 0.16 * k)), h * 0.14, (0.2, 0.2, 0.2), w * 0.8)
    return picture


def exit_sign(size: tuple[int, int] = (100, 240)) -> Picture:
    """The green sign above an emergency exit: a runner, an arrow, a door."""
    h, w = size
    picture = blank(size, (0.02, 0.5, 0.26))
    white, stroke = (245, 250, 245), max(2, h // 12)
    cv2.rectangle(
        picture,
        (int(w * 0.62), int(h * 0.14)),
        (int(w * 0.88), int(h * 0.88)),
        white,
        stroke // 2 + 1,
    )
    cv2.circle(picture, (int(w * 0.36), int(h * 0.24)), h // 11, white, -1, cv2.LINE_AA)
    limbs = (
        ((0.34, 0.36), (0.3, 0.6)),
        ((0.3, 0.6), (0.4, 0.74), (0.36, 0.9)),
        ((0.3, 0.6), (0.2, 0.76), (0.1, 0.76)),
        ((0.34, 0.38), (0.46, 0.46)),
        ((0.34, 0.38), (0.24, 0.5)),
    )
    for limb in limbs:
        cv2.polylines(
            picture,
            [np.array([(x * w, y * h) for x, y in limb], np.int32)],
            False,
            white,
            stroke,
            cv2.LINE_AA,
        )
    cv2.arrowedLine(
        picture,
        (int(w * 0.44), int(h * 0.62)),
        (int(w * 0.6), int(h * 0.62)),
        white,
        stroke // 2 + 1,
        cv2.LINE_AA,
        tipLength=0.4,
    )
    return picture


def carton(rng: np.random.Generator, size: tuple[int, int] = (160, 220)) -> Picture:
    """One side of a cardboard box: tape, a label, arrows, the maker's name."""
    h, w = size
    brown = (
        np.array([0.66, 0.52, 0.36]) * rng.uniform(0.85, 1.1)
        + 0.012 * smooth_noise(rng, size, 1.0)[..., None]
        + 0.02 * fractal_noise(rng, size, 40)[..., None]
    )
    picture = np.clip(brown * 255, 0, 255).astype(np.uint8)
    dark = (0.22, 0.15, 0.1)
    tape = slice(int(h * 0.02), int(h * 0.16))
    picture[tape] = np.clip(picture[tape] * 0.9 + 18, 0, 255).astype(np.uint8)
    write(
        picture,
        str(rng.choice(NAMES)).upper(),
        (w * 0.06, h * 0.42),
        h * 0.2,
        vivid(rng) if rng.uniform() < 0.5 else dark,
        w * 0.5,
        bold=True,
    )
    if rng.uniform() < 0.7:
        pasted(
            picture,
            label(rng, (int(h * 0.36), int(w * 0.36))),
            (w * rng.uniform(0.6, 0.78), h * rng.uniform(0.4, 0.7)),
            rng.normal(0, 0.05),
        )
    for k in range(2):
        foot = int(w * (0.1 + 0.1 * k))
        cv2.arrowedLine(
            picture,
            (foot, int(h * 0.9)),
            (foot, int(h * 0.6)),
            to_bytes(dark),
            max(2, h // 50),
            cv2.LINE_AA,
            tipLength=0.35,
        )
    return picture


def label(rng: np.random.Generator, size: tuple[int, int] = (60, 100)) -> Picture:
    """A sticker: a bar code, a number and an address."""
    h, w = size
    picture = blank(size, (0.94, 0.94, 0.93))
    bars = np.repeat(rng.integers(0, 2, w), rng.integers(1, 4, w))[: int(w * 0.8)]
    picture[int(h * 0.6) : int(h * 0.9), int(w * 0.1) : int(w * 0.1) + len(bars)] = np.where(
        bars[None, :, None] > 0, 20, 240
    )
    write(
        picture,
        f"{rng.integers(10**6, 10**7)}",
        (w * 0.08, h * 0.25),
        h * 0.2,
        (0.05, 0.05, 0.05),
        w * 0.8,
        bold=True,
    )
    write(picture, str(rng.choice(NAMES)), (w * 0.08, h * 0.48), h * 0.16, (0.1, 0.1, 0.1), w * 0.8)
    return picture
