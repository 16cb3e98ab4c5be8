"""Make contents of computer screens: program code, a desktop with windows, diagrams, a document, a
terminal."""

from __future__ import annotations

import cv2
import numpy as np

from topoloc_worlds.furnishing.lettering import (
    NAMES,
    WORDS,
    blank,
    paragraph,
    sentence,
    to_bytes,
    vivid,
    write,
)
from topoloc_worlds.furnishing.pictures import photograph, plot
from topoloc_worlds.furnishing.prints import Area
from topoloc_worlds.scene import Picture

_SYNTAX = (
    (0.85, 0.85, 0.82),
    (0.55, 0.75, 0.95),
    (0.8, 0.55, 0.75),
    (0.6, 0.8, 0.5),
    (0.9, 0.65, 0.4),
)


def screen_content(rng: np.random.Generator, size: tuple[int, int] = (405, 720)) -> Picture:
    """A screen at work: one or two programs, or a desktop with windows over a photograph."""
    h, w = size
    kind = rng.integers(0, 3)
    if kind == 0:
        picture = blank(size, (0.1, 0.1, 0.12))
        split = int(w * rng.uniform(0.45, 0.7))
        _code(picture, rng, (0, 0, split, h))
        _window(picture, rng, (split, 0, w - split, h))
    else:
        picture = photograph(rng, size) if kind == 1 else blank(size, vivid(rng))
        for k in range(5):
            cv2.rectangle(picture, (10, 12 + 52 * k), (40, 42 + 52 * k), to_bytes(vivid(rng)), -1)
            write(picture, str(rng.choice(WORDS)), (8, 54 + 52 * k), 10, (1.0, 1.0, 1.0), 44)
        for _ in range(int(rng.integers(2, 4))):
            width, height = int(w * rng.uniform(0.35, 0.6)), int(h * rng.uniform(0.4, 0.7))
            _window(
                picture,
                rng,
                (
                    int(rng.integers(60, w - width)),
                    int(rng.integers(0, h - 24 - height)),
                    width,
                    height,
                ),
            )
    picture[h - 20 :] = to_bytes((0.15, 0.16, 0.2))
    for k in range(8):
        cv2.rectangle(picture, (8 + 26 * k, h - 16), (24 + 26 * k, h - 4), to_bytes(vivid(rng)), -1)
    write(
        picture,
        f"{rng.integers(8, 20)}:{rng.integers(10, 60)}",
        (w - 48, h - 6),
        13,
        (0.95, 0.95, 0.95),
        44,
    )
    return picture


def _window(picture: Picture, rng: np.random.Generator, area: Area) -> None:
    x, y, width, height = area
    bar = 16
    picture[y : y + bar, x : x + width] = to_bytes((0.75, 0.77, 0.8))
    write(
        picture,
        f"{rng.choice(NAMES)} - {rng.choice(WORDS)}",
        (x + 6, y + 12),
        11,
        (0.1, 0.1, 0.1),
        width * 0.6,
    )
    cv2.circle(picture, (x + width - 10, y + 8), 4, (200, 60, 50), -1, cv2.LINE_AA)
    inside = (x, y + bar, width, height - bar)
    kind = rng.integers(0, 4)
    if kind == 0:
        _code(picture, rng, inside)
    elif kind == 1:
        picture[y + bar : y + height, x : x + width] = plot(
            rng, (height - bar, width), (0.97, 0.97, 0.97)
        )
    elif kind == 2:
        picture[y + bar : y + height, x : x + width] = photograph(rng, (height - bar, width))
    else:
        picture[y + bar : y + height, x : x + width] = 248
        write(
            picture,
            sentence(rng, 3),
            (x + 14, y + bar + 28),
            20,
            (0.1, 0.1, 0.2),
            width * 0.8,
            bold=True,
        )
        paragraph(
            picture, rng, (x + 14, y + bar + 40, width - 28, height - bar - 50), 11, (0.2, 0.2, 0.2)
        )


def _code(picture: Picture, rng: np.random.Generator, area: Area) -> None:
    """Indented lines of coloured words on a dark ground, with line numbers."""
    x, y, width, height = area
    picture[y : y + height, x : x + width] = to_bytes((0.11, 0.12, 0.14))
    indent = 0
    for row in range(height // 13):
        base = y + 11 + 13 * row
        write(picture, str(row + 1), (x + 4, base), 9, (0.4, 0.42, 0.45), 16)
        indent = int(np.clip(indent + rng.integers(-1, 2), 0, 4))
        left = x + 26 + 14 * indent
        for _ in range(int(rng.integers(0, 6))):
            word = f"{rng.choice(WORDS)}{rng.choice(['', '()', ' =', ':', ','])}"
            if left + 8 * len(word) > x + width - 6:
                break
            left += (
                int(
                    write(
                        picture, word, (left, base), 10.5, _SYNTAX[int(rng.integers(0, 5))], width
                    )
                )
                + 6
            )
