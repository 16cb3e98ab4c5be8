"""Make printed and written pieces for walls and windows: sheets, posters, boards. Each piece is
different.

All take a generator and return an sRGB picture. Sizes are (height, width) in pixels.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

from topoloc_worlds.furnishing.lettering import (
    BOOKS,
    PAPER,
    TITLES,
    blank,
    ink_on,
    paragraph,
    sentence,
    to_bytes,
    vivid,
    write,
)
from topoloc_worlds.furnishing.pictures import painting, photograph, plot
from topoloc_worlds.noise import fractal_noise
from topoloc_worlds.scene import Picture
from topoloc_worlds.shapes import Number

Area = tuple[int, int, int, int]
"""x, y, width, height in pixels."""


def poster(rng: np.random.Generator, size: tuple[int, int] = (720, 512)) -> Picture:
    """A poster: a picture with a headline, a scientific one with columns and diagrams, or an
    announcement."""
    h, w = size
    style = rng.integers(0, 3)
    paper = vivid(rng) if style == 2 else PAPER
    picture = blank(size, paper)
    title = str(rng.choice(TITLES))
    if style == 0:
        picture[: int(h * 0.7)] = photograph(rng, (int(h * 0.7), w))
        write(
            picture, title, (w * 0.06, h * 0.84), h * 0.13, ink_on(rng, paper), w * 0.88, bold=True
        )
        paragraph(
            picture,
            rng,
            (int(w * 0.06), int(h * 0.87), int(w * 0.6), int(h * 0.1)),
            h * 0.03,
            ink_on(rng, paper),
        )
    elif style == 1:
        head = vivid(rng)
        picture[: int(h * 0.15)] = to_bytes(head)
        write(
            picture,
            f"{title} and {rng.choice(BOOKS)}",
            (w * 0.05, h * 0.09),
            h * 0.07,
            (1.0, 1.0, 1.0),
            w * 0.9,
            bold=True,
        )
        _columns(picture, rng, (int(w * 0.04), int(h * 0.18), int(w * 0.92), int(h * 0.8)))
    else:
        ink = ink_on(rng, paper)
        picture[int(h * 0.35) : int(h * 0.68), int(w * 0.08) : int(w * 0.92)] = painting(
            rng, (int(h * 0.68) - int(h * 0.35), int(w * 0.92) - int(w * 0.08))
        )
        write(picture, title.upper(), (w * 0.08, h * 0.2), h * 0.16, ink, w * 0.84, bold=True)
        write(
            picture,
            f"{rng.integers(1, 29)}. {rng.choice(['May', 'June', 'March', 'October'])}",
            (w * 0.08, h * 0.3),
            h * 0.08,
            ink,
            w * 0.6,
        )
        paragraph(
            picture,
            rng,
            (int(w * 0.08), int(h * 0.72), int(w * 0.8), int(h * 0.22)),
            h * 0.045,
            ink,
        )
    return picture


def _columns(picture: Picture, rng: np.random.Generator, area: Area) -> None:
    """Two columns of text, diagrams and pictures."""
    x, y, width, height = area
    column = int(width * 0.47)
    for left in (x, x + width - column):
        top = y
        while top < y + height - height // 6:
            part = min(int(height * rng.uniform(0.14, 0.3)), y + height - top)
            kind = rng.uniform()
            if kind < 0.55:
                write(
                    picture,
                    str(rng.choice(TITLES)),
                    (left, top + height * 0.035),
                    height * 0.035,
                    ink_on(rng, PAPER),
                    column,
                    bold=True,
                )
                below = top + int(height * 0.045)
                paragraph(
                    picture,
                    rng,
                    (left, below, column, top + part - below),
                    height * 0.02,
                    (0.15, 0.15, 0.15),
                )
            else:
                maker = plot if kind < 0.85 else photograph
                picture[top : top + part - 6, left : left + column] = maker(rng, (part - 6, column))
            top += part + height // 60


def notice(rng: np.random.Generator, size: tuple[int, int] = (297, 210)) -> Picture:
    """A sheet of paper: a headline and text, sometimes a picture or a diagram; white or of coloured
    paper."""
    h, w = size
    tint = rng.uniform(0.75, 0.95, 3) if rng.uniform() < 0.3 else np.array(PAPER)
    paper = (float(tint[0]), float(tint[1]), float(tint[2]))
    picture = blank(size, paper)
    ink = ink_on(rng, paper)
    write(
        picture,
        str(rng.choice(TITLES)),
        (w * 0.1, h * 0.16),
        h * rng.uniform(0.07, 0.13),
        ink,
        w * 0.8,
        bold=True,
    )
    top = int(h * 0.22)
    if rng.uniform() < 0.5:
        part = int(h * rng.uniform(0.2, 0.4))
        maker = plot if rng.uniform() < 0.4 else photograph
        picture[top : top + part, int(w * 0.1) : int(w * 0.9)] = maker(
            rng, (part, int(w * 0.9) - int(w * 0.1))
        )
        top += part + int(h * 0.03)
    line = h * float(rng.choice([0.028, 0.034, 0.05]))
    paragraph(
        picture,
        rng,
        (int(w * 0.1), top, int(w * 0.8), int(h * 0.92) - top),
        line,
        (0.13, 0.13, 0.15),
    )
    return picture


def pasted(
    picture: Picture, piece: UInt8[np.ndarray, "h2 w2 3"], at: tuple[Number, Number], angle: Number
) -> None:
    """Puts a piece, turned by `angle`, into the picture with its centre at `at` (x, y), with a thin
    shadow."""
    h, w = piece.shape[:2]
    turn = cv2.getRotationMatrix2D(((w - 1) / 2, (h - 1) / 2), float(np.degrees(angle)), 1.0)
    turn[:, 2] += np.array(at) - [(w - 1) / 2, (h - 1) / 2]
    out = (picture.shape[1], picture.shape[0])
    covered = cv2.warpAffine(np.full((h, w), 1.0, np.float32), turn, out, flags=cv2.INTER_LINEAR)
    shadow = cv2.GaussianBlur(np.roll(covered, (3, 2), (0, 1)), (0, 0), 2.0)
    shown = cv2.warpAffine(
        piece, turn, out, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    mixed = (
        picture * (1 - 0.35 * shadow[..., None]) * (1 - covered[..., None])
        + shown * covered[..., None]
    )
    picture[:] = np.clip(mixed, 0, 255).astype(np.uint8)


def notice_board(rng: np.random.Generator, size: tuple[int, int] = (560, 840)) -> Picture:
    """A cork board full of sheets, cards and pins, in a wooden frame. Meant for about 2.8 pixels a
    centimetre and more."""
    h, w = size
    cork = np.array([0.66, 0.5, 0.33]) + 0.05 * fractal_noise(rng, size, 6, 4)[..., None]
    picture = np.clip(cork * 255, 0, 255).astype(np.uint8)
    num_columns, num_rows = max(2, w // 170), max(1, h // 220)
    for row in range(num_rows):
        for column in range(num_columns):
            if rng.uniform() < 0.15:
                continue
            scale = h / num_rows / 330 * rng.uniform(0.7, 1.05)
            sheet = (
                notice(rng, (int(297 * scale), int(210 * scale)))
                if rng.uniform() < 0.75
                else photograph(rng, (int(130 * scale), int(180 * scale)))
            )
            x = w * (column + 0.5) / num_columns + rng.normal(0, 10)
            y = h * (row + 0.5) / num_rows + rng.normal(0, 10)
            pasted(picture, sheet, (x, y), rng.normal(0, 0.04))
            cv2.circle(
                picture,
                (int(x), int(y - sheet.shape[0] * 0.46)),
                max(3, h // 130),
                to_bytes(vivid(rng)),
                -1,
                cv2.LINE_AA,
            )
    cv2.rectangle(picture, (0, 0), (w - 1, h - 1), (116, 82, 52), max(6, h // 40))
    return picture


def whiteboard(rng: np.random.Generator, size: tuple[int, int] = (640, 960)) -> Picture:
    """A whiteboard that was worked at: boxes with arrows, formulas, lists, half wiped writing
    below."""
    h, w = size
    grey = 0.9 - 0.012 * np.abs(fractal_noise(rng, size, 40))[..., None] * np.ones(3)
    picture = np.clip(grey * 255, 0, 255).astype(np.uint8)
    inks = ((0.1, 0.12, 0.45), (0.7, 0.1, 0.1), (0.08, 0.08, 0.1), (0.05, 0.4, 0.15))
    paragraph(
        picture,
        rng,
        (int(w * 0.5), int(h * 0.1), int(w * 0.45), int(h * 0.8)),
        h * 0.05,
        (0.83, 0.83, 0.86),
    )
    _draw_diagram(picture, rng, inks)
    for k in range(int(rng.integers(3, 6))):
        text = str(
            rng.choice(
                [
                    "E(T) = sum |x - K T X|^2",
                    "p(z|x) ~ N(0, S)",
                    "d = f b / Z",
                    "R = exp(w^)",
                    "x' F x = 0",
                    "A x = b",
                    "todo: calibrate",
                    "s(q,n) > 0.7",
                ]
            )
        )
        at = (w * rng.uniform(0.05, 0.1), h * (0.58 + 0.09 * k))
        write(
            picture, text, at, h * rng.uniform(0.05, 0.08), inks[int(rng.integers(0, 4))], w * 0.45
        )
    for k in range(int(rng.integers(3, 8))):
        write(
            picture,
            f"- {sentence(rng, int(rng.integers(2, 5)))}",
            (w * 0.56, h * (0.2 + 0.09 * k)),
            h * 0.055,
            inks[int(rng.integers(0, 4))],
            w * 0.4,
        )
    return picture


def _draw_diagram(
    picture: Picture, rng: np.random.Generator, inks: tuple[tuple[float, float, float], ...]
) -> None:
    """Draw three labelled boxes, joined by arrows, into the left half of a picture."""
    h, w = picture.shape[:2]
    nodes = [(w * (0.12 + 0.16 * k), h * (0.25 + 0.2 * rng.uniform())) for k in range(3)]
    for k, (x, y) in enumerate(nodes):
        ink = to_bytes(inks[int(rng.integers(0, 4))])
        cv2.rectangle(
            picture,
            (int(x - w * 0.05), int(y - h * 0.05)),
            (int(x + w * 0.05), int(y + h * 0.05)),
            ink,
            3,
            cv2.LINE_AA,
        )
        write(
            picture,
            str(rng.choice(BOOKS)).split()[0],
            (x - w * 0.045, y + h * 0.015),
            h * 0.035,
            inks[0],
            w * 0.09,
        )
        if k:
            start = nodes[k - 1]
            cv2.arrowedLine(
                picture,
                (int(start[0] + w * 0.05), int(start[1])),
                (int(x - w * 0.05), int(y)),
                ink,
                3,
                cv2.LINE_AA,
                tipLength=0.15,
            )


def calendar(rng: np.random.Generator, size: tuple[int, int] = (480, 320)) -> Picture:
    """A wall calendar: a photograph above, the days of the month below."""
    h, w = size
    picture = blank(size, (0.96, 0.96, 0.95))
    picture[: h // 2] = photograph(rng, (h // 2, w))
    write(
        picture,
        str(rng.choice(["January", "April", "June", "September", "November"])),
        (w * 0.06, h * 0.59),
        h * 0.07,
        (0.7, 0.1, 0.1),
        w * 0.8,
        bold=True,
    )
    first = int(rng.integers(0, 7))
    for day in range(30):
        row, column = divmod(day + first, 7)
        color = (0.75, 0.1, 0.1) if column == 6 else (0.12, 0.12, 0.12)
        write(
            picture,
            str(day + 1),
            (w * (0.06 + 0.13 * column), h * (0.67 + 0.06 * row)),
            h * 0.045,
            color,
            w * 0.1,
        )
    return picture
