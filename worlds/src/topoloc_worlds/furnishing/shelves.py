"""Build shelves with books, folders and boxes, in their own frames as `furniture`; metres."""

from __future__ import annotations

from math import sin

import numpy as np

from topoloc_worlds.furnishing.furniture import carton_box, crate
from topoloc_worlds.furnishing.interiors import Finishes, laminated
from topoloc_worlds.furnishing.lettering import vivid
from topoloc_worlds.furnishing.printed_things import book_spines, label
from topoloc_worlds.scene import Material, Mesh, Surface
from topoloc_worlds.shapes import box, join, placed, surfaces_placed, turned


def bookshelf(
    rng: np.random.Generator,
    finishes: Finishes,
    width: float = 0.9,
    height: float = 2.0,
    boards: int = 5,
) -> list[Surface]:
    """Open shelves, full of books, folders and boxes, with gaps."""
    w, d, t = width / 2, 0.15, 0.018
    case = [
        box((-w, -d, 0), (-w + t, d, height), texels=0.8),
        box((w - t, -d, 0), (w, d, height), texels=0.8),
    ]
    step = (height - 0.06) / boards
    case += [
        box((-w + t, -d, 0.05 + step * k), (w - t, d, 0.05 + step * k + t), texels=0.8)
        for k in range(boards)
    ]
    case += [
        box((-w, -d, height - t), (w, d, height), texels=0.8),
        box((-w + t, d - 0.008, 0.05), (w - t, d, height), texels=0.8),
    ]
    parts = [Surface("bookshelf", join(case), finishes.veneer)]
    for k in range(boards):
        floor = (0.0, 0.0, 0.05 + step * k + t)
        kind = rng.choice(["books", "books", "folders", "boxes"])
        row = folder_row if kind == "folders" else book_row
        if kind == "boxes":
            contents = _storage_boxes(rng, width - 0.08, step - 0.06)
        else:
            contents = row(rng, (width - 0.08) * rng.uniform(0.55, 1.0), min(0.3, step - 0.06))
            contents = surfaces_placed(contents, (-w + 0.03, 0, 0))
        parts += surfaces_placed(contents, floor)
    return parts


def book_row(
    rng: np.random.Generator, length: float, height: float, depth: float = 0.19
) -> list[Surface]:
    """Books standing side by side from the origin towards +x, their backs at y = -depth/2; the last
    ones lean."""
    widths = []
    while sum(widths) < length - 0.05:
        widths.append(float(rng.uniform(0.016, 0.055)))
    num_leaning = int(rng.integers(0, 3))
    starts = np.concatenate([[0.0], np.cumsum(widths)])
    spines = book_spines(rng, [round(w * 800) for w in widths], 224)
    books, pages = [], []
    for k, width in enumerate(widths):
        high, deep = height * rng.uniform(0.72, 1.0), depth * rng.uniform(0.75, 1.0)
        back = -depth / 2 + abs(rng.normal(0, 0.008))
        x, share = starts[k], starts[k : k + 2] / starts[-1]
        lean = rng.uniform(0.1, 0.2) if k >= len(widths) - num_leaning else 0.0
        block = box((0, back, 0), (width * 0.96, back + deep, high), faces="sewt")
        uv = block.uv.copy()
        uv[:, 0] = share[0] + (share[1] - share[0]) * (0.1 + 0.8 * uv[:, 0])
        # The covers are as plain as the lowest edge of the back.
        uv[4:12] = [(share[0] + share[1]) / 2, 0.995]
        cover = Mesh(block.vertices[:12], block.faces[:6], uv[:12])
        top = box(
            (0.002, back + 0.004, high - 0.004),
            (width * 0.9, back + deep - 0.004, high - 0.003),
            faces="t",
        )
        books.append(
            placed(turned(cover, (0, 1, 0), -lean), (x + high * sin(lean) * 0.5 * (lean > 0), 0, 0))
        )
        pages.append(
            placed(turned(top, (0, 1, 0), -lean), (x + high * sin(lean) * 0.5 * (lean > 0), 0, 0))
        )
    return [
        Surface("books", join(books), laminated(spines)),
        Surface("books", join(pages), Material("matt", (0.86, 0.83, 0.74))),
    ]


def folder_row(rng: np.random.Generator, length: float, height: float) -> list[Surface]:
    """Ring binders of few colours, each with its label and finger hole."""
    num = max(1, int(length / 0.078))
    picture = np.zeros((192, 48 * num, 3), np.uint8)
    colors = [vivid(rng), (0.12, 0.12, 0.13), (0.75, 0.76, 0.76)]
    blocks = []
    for k in range(num):
        strip = picture[:, 48 * k : 48 * (k + 1)]
        strip[:] = np.round(np.asarray(colors[int(rng.integers(0, 3))]) * 255)
        strip[40:110, 8:40] = np.rot90(label(rng, (32, 70)))
        strip[150:168, 16:32] = 25
        strip[:, :1] = 12
        block = box(
            (0.078 * k, -0.1, 0), (0.078 * k + 0.075, 0.15, min(height, 0.32)), faces="sewt"
        )
        uv = block.uv.copy()
        uv[:, 0] = (k + 0.04 + 0.92 * uv[:, 0]) / num
        uv[4:] = [(k + 0.5) / num, 0.98]
        blocks.append(Mesh(block.vertices, block.faces, uv))
    return [Surface("folders", join(blocks), laminated(picture))]


def _storage_boxes(rng: np.random.Generator, length: float, height: float) -> list[Surface]:
    """Plastic boxes and cartons next to each other on a board."""
    parts: list[Surface] = []
    x = -length / 2
    while (width := float(rng.uniform(0.18, 0.32))) < length / 2 - x:
        high = height * rng.uniform(0.45, 0.9)
        if rng.uniform() < 0.6:
            parts += surfaces_placed(crate(rng, width, 0.26, high), (x + width / 2, 0, 0))
        else:
            parts += surfaces_placed(carton_box(rng, (width, 0.26, high)), (x + width / 2, 0, 0))
        x += width + 0.02
    return parts
