"""Build the scenes behind panes: rooms with curtains and blinds, display windows of shops, and the
boards above them."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64

from topoloc_worlds.furnishing.lettering import NAMES, blank, ink_on, to_bytes, vivid, write
from topoloc_worlds.furnishing.prints import photograph, poster
from topoloc_worlds.noise import smooth_noise
from topoloc_worlds.scene import Picture

ROOMS = (3, 8)
"""Rows and columns of the picture of rooms."""
SHOPS = (3, 4)
SIGNS = (14, 2)
_TRADES = (
    "BAKERY", "BOOKS", "CAFE", "PHARMACY", "FLOWERS", "OPTICIAN", "HAIR", "BICYCLES", "SHOES", "WINE", "PIZZA", "JEWELLER", "PHONES",  # noqa: E501
    "TRAVEL", "MARKET", "BANK", "TAILOR", "TOYS", "HARDWARE", "TEA HOUSE", "BUTCHER", "MUSIC", "LAUNDRY", "KIOSK", "SUSHI",  # noqa: E501
    "BAR", "ANTIQUES", "PRINTS",
)  # fmt: skip


def cells(
    rng: np.random.Generator, num: int, grid: tuple[int, int]
) -> Float64[np.ndarray, "n 2 2"]:
    """For each of `num` panes the corner (u, v) and the size of one cell of a picture that has rows
    and columns of cells, at random."""
    rows, columns = grid
    picks = rng.integers(0, rows * columns, num)
    corner = np.column_stack([(picks % columns) / columns, (picks // columns) / rows])
    return np.stack([corner, np.broadcast_to([1.0 / columns, 1.0 / rows], (num, 2))], axis=1)


def rooms(rng: np.random.Generator) -> Picture:
    """Windows of homes and offices, 24 of 1.2 by 1.5 m, as they look with light inside; by day it
    is dark in there."""
    return _grid([_room(rng, (120, 96)) for _ in range(ROOMS[0] * ROOMS[1])], ROOMS)


def _grid(pictures: list[np.ndarray], grid: tuple[int, int]) -> np.ndarray:
    rows, columns = grid
    return np.concatenate(
        [np.concatenate(pictures[r * columns : (r + 1) * columns], axis=1) for r in range(rows)],
        axis=0,
    )


def _room(rng: np.random.Generator, size: tuple[int, int]) -> Picture:
    h, w = size
    wall = np.asarray([0.62, 0.54, 0.42]) * rng.uniform(0.75, 1.2)
    shade = (1.0 - 0.45 * np.abs(np.linspace(-1, 1, h))[:, None]) * (
        1.0 - 0.3 * np.linspace(0, 1, w)[None] * rng.uniform(-1, 1)
    )
    picture = np.clip(wall * shade[..., None] * 255, 0, 255).astype(np.uint8)
    for _ in range(rng.integers(1, 4)):
        x, y = int(rng.integers(0, w - 20)), int(rng.integers(h // 2, h - 10))
        cv2.rectangle(
            picture, (x, y), (x + int(rng.integers(12, 45)), h), to_bytes((0.3, 0.22, 0.15)), -1
        )
    x, y = int(rng.integers(8, w - 30)), int(rng.integers(20, h // 2))
    cv2.rectangle(picture, (x, y), (x + 22, y + 16), to_bytes(vivid(rng)), -1)
    style = rng.integers(0, 6)
    cloth = np.asarray([(0.86, 0.84, 0.8), (0.75, 0.7, 0.62), vivid(rng)][int(rng.integers(0, 3))])
    if style in (0, 1, 4):
        reach = int(w * rng.uniform(0.12, 0.32))
        for x0, x1 in ((0, reach), (w - reach, w)):
            folds = 0.82 + 0.16 * np.sin(np.arange(x1 - x0) * rng.uniform(0.6, 1.1))
            picture[:, x0:x1] = np.clip(cloth * folds[:, None] * 255, 0, 255).astype(np.uint8)
    if style in (1, 2):
        down = int(h * rng.uniform(0.25, 0.95))
        slats = 0.72 + 0.2 * ((np.arange(down) % 5) / 5)
        picture[:down] = np.clip(
            np.asarray([0.9, 0.89, 0.86]) * slats[:, None, None] * 255, 0, 255
        ).astype(np.uint8)
    if style == 3:
        net = (
            0.7 + 0.12 * np.sin(np.arange(w) * 0.8)[None, :] + 0.04 * smooth_noise(rng, (h, w), 1.5)
        )
        picture = np.clip(0.35 * picture + 0.65 * 255 * net[..., None], 0, 255).astype(np.uint8)
    if rng.uniform() < 0.4:
        _plant(rng, picture, int(rng.integers(15, w - 15)), h)
    return picture


def _plant(rng: np.random.Generator, picture: Picture, x: int, foot: int) -> None:
    cv2.rectangle(picture, (x - 6, foot - 12), (x + 6, foot), to_bytes((0.55, 0.28, 0.18)), -1)
    for _ in range(18):
        tip = (x + int(rng.normal(0, 9)), foot - int(rng.uniform(14, 36)))
        cv2.line(
            picture, (x, foot - 12), tip, to_bytes((0.1, float(rng.uniform(0.25, 0.45)), 0.12)), 2
        )


def displays(rng: np.random.Generator) -> Picture:
    """Display windows of shops, 12 of 3.6 by 2.4 m, lit from inside."""
    return _grid([_display(rng, (150, 224)) for _ in range(SHOPS[0] * SHOPS[1])], SHOPS)


def _display(rng: np.random.Generator, size: tuple[int, int]) -> Picture:
    h, w = size
    back = np.asarray([0.6, 0.56, 0.5]) * rng.uniform(0.4, 1.1)
    picture = np.clip(
        back * np.linspace(1.15, 0.7, h)[:, None, None] * np.ones((1, w, 1)) * 255, 0, 255
    ).astype(np.uint8)
    for x in range(20, w, 44):
        cv2.circle(picture, (x, 8), 4, (255, 250, 235), -1)
    for shelf in range(int(h * 0.3), h - 16, 30):
        x = 4
        while x < w - 14:
            width, height = int(rng.integers(5, 16)), int(rng.integers(8, 25))
            if rng.uniform() < 0.75:
                cv2.rectangle(
                    picture,
                    (x, shelf + 26 - height),
                    (x + width, shelf + 26),
                    to_bytes(vivid(rng)),
                    -1,
                )
            x += width + int(rng.integers(1, 9))
        cv2.rectangle(picture, (0, shelf + 26), (w, shelf + 28), (88, 70, 54), -1)
    if rng.uniform() < 0.4:
        for x in range(30, w - 20, int(rng.integers(45, 70))):
            _dummy(rng, picture, x)
    for _ in range(rng.integers(1, 3)):
        piece = poster(rng, (96, 68)) if rng.uniform() < 0.6 else photograph(rng, (60, 84))
        x, y = int(rng.integers(0, w - piece.shape[1])), int(rng.integers(10, h - piece.shape[0]))
        picture[y : y + piece.shape[0], x : x + piece.shape[1]] = piece
    if rng.uniform() < 0.5:
        write(
            picture,
            str(rng.choice(["SALE", "NEW", "-30%", "OPEN"])),
            (w * 0.2, h * 0.55),
            28.0,
            (0.95, 0.95, 0.9),
            w * 0.6,
            bold=True,
        )
    return picture


def _dummy(rng: np.random.Generator, picture: Picture, x: int) -> None:
    """A figure that shows clothes."""
    h, coat = picture.shape[0], to_bytes(vivid(rng))
    skin = to_bytes((0.75, 0.62, 0.52))
    cv2.circle(picture, (x, 42), 6, skin, -1)
    cv2.fillPoly(
        picture, [np.array([[x - 12, 52], [x + 12, 52], [x + 9, 95], [x - 9, 95]], np.int32)], coat
    )
    for side in (-5, 5):
        cv2.line(picture, (x + side, 95), (x + side, h - 8), to_bytes((0.15, 0.15, 0.22)), 6)


def signs(rng: np.random.Generator) -> Picture:
    """Boards above shops, 28 of 5 by 0.6 m."""
    names = rng.permutation(len(_TRADES))
    boards = []
    for i in range(SIGNS[0] * SIGNS[1]):
        paper = (
            vivid(rng)
            if rng.uniform() < 0.6
            else ((0.92, 0.91, 0.88) if rng.uniform() < 0.5 else (0.08, 0.09, 0.11))
        )
        board = blank((56, 448), paper)
        ink = ink_on(rng, paper)
        title = _TRADES[int(names[i % len(_TRADES)])]
        text = title if rng.uniform() < 0.4 else f"{title} {rng.choice(NAMES)}"
        left = float(rng.uniform(30, 120))
        write(board, text, (left, 42.0), 36.0, ink, 400 - left, bold=bool(rng.uniform() < 0.7))
        if rng.uniform() < 0.5:
            cv2.circle(board, (int(left) - 18, 28), 14, to_bytes(vivid(rng)), -1, cv2.LINE_AA)
        cv2.rectangle(board, (0, 0), (447, 55), to_bytes((0.25, 0.25, 0.25)), 2)
        boards.append(board)
    return _grid(boards, SIGNS)
