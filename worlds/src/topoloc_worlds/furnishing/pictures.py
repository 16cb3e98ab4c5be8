"""Pictures in the prints and on the screens of a world: views, paintings, diagrams; each another
one, sizes (height, width) in pixels."""

from __future__ import annotations

import cv2
import numpy as np

from topoloc_worlds.furnishing.lettering import PAPER, blank, ink_on, to_bytes, vivid
from topoloc_worlds.noise import fractal_noise, smooth_noise
from topoloc_worlds.scene import Color, Picture

_ZENITHS = ((0.2, 0.42, 0.75), (0.35, 0.5, 0.68), (0.25, 0.22, 0.45))
_HORIZONS = ((0.8, 0.88, 0.95), (0.95, 0.8, 0.6), (0.95, 0.6, 0.4))
_LANDS = ((0.3, 0.45, 0.2), (0.45, 0.38, 0.25), (0.2, 0.3, 0.4), (0.55, 0.5, 0.45))


def photograph(rng: np.random.Generator, size: tuple[int, int]) -> Picture:
    """A view: mountains or a town behind water, under a sky; or patches of colour such as modern
    painters make."""
    kind = rng.integers(0, 3)
    if kind == 2:
        return painting(rng, size)
    h, w = size
    horizon = int(h * rng.uniform(0.45, 0.7))
    top, low = (np.array(colors[int(rng.integers(0, 3))]) for colors in (_ZENITHS, _HORIZONS))
    share = np.linspace(0, 1.4, h).clip(0, 1)[:, None, None]
    clouds = np.clip(fractal_noise(rng, size, w / 6), 0, 2)[..., None] * (1 - share)
    picture = (top * (1 - share) + low * share) * (1 - 0.3 * clouds) + 0.25 * clouds
    for layer in range(3):
        ridge = horizon - h * (0.28 - 0.09 * layer) * np.abs(
            fractal_noise(rng, (1, w), w / (4 + 3 * layer), 5)[0]
        ) * (0.6 if kind else 1.0)
        shade = np.array(_LANDS[int(rng.integers(0, 4))]) * (0.45 + 0.2 * layer) + low * (
            0.4 - 0.2 * layer
        )
        land = shade + (0.03 if kind else 0.07) * fractal_noise(rng, size, 12)[..., None]
        if kind:
            house = max(w // 22, 2)
            ridge = np.repeat(ridge[::house], house)[:w]
            land[:: max(house // 3, 2), :: max(house // 4, 2)] = rng.uniform(0.1, 0.9, 3)
        below = np.arange(h)[:, None] > np.resize(ridge, w)[None]
        picture[below] = land[below]
    mirrored = picture[horizon - 1 :: -1][: h - horizon]
    picture[horizon : horizon + len(mirrored)] = (
        mirrored * 0.7 + 0.03 * smooth_noise(rng, mirrored.shape[:2], 2.0)[..., None]
    )
    return np.clip(picture * 255, 0, 255).astype(np.uint8)


def painting(rng: np.random.Generator, size: tuple[int, int]) -> Picture:
    """Patches of colour, such as modern painters make."""
    h, w = size
    picture = blank(size, vivid(rng))
    for _ in range(rng.integers(6, 14)):
        centre = (int(rng.integers(0, w)), int(rng.integers(0, h)))
        reach = int(rng.uniform(0.08, 0.35) * min(h, w))
        if rng.uniform() < 0.5:
            cv2.circle(picture, centre, reach, to_bytes(vivid(rng)), -1, cv2.LINE_AA)
        else:
            corners = np.array(centre) + rng.integers(-reach, reach + 1, (4, 2))
            cv2.fillPoly(
                picture,
                [cv2.convexHull(corners.astype(np.int32))],
                to_bytes(vivid(rng)),
                cv2.LINE_AA,
            )
    return picture


def plot(rng: np.random.Generator, size: tuple[int, int], paper: Color = PAPER) -> Picture:
    """A diagram: axes, a grid, curves or columns."""
    h, w = size
    picture = blank(size, paper)
    ink = to_bytes(ink_on(rng, paper))
    x0, y0, x1, y1 = int(w * 0.12), int(h * 0.1), int(w * 0.95), int(h * 0.85)
    faint = to_bytes((0.5 + 0.25 * paper[0], 0.5 + 0.25 * paper[1], 0.5 + 0.25 * paper[2]))
    for k in range(1, 5):
        cv2.line(picture, (x0, y1 - (y1 - y0) * k // 5), (x1, y1 - (y1 - y0) * k // 5), faint, 1)
    if rng.uniform() < 0.4:
        num = int(rng.integers(4, 10))
        for k in range(num):
            left = x0 + (x1 - x0) * k // num
            top = y1 - int((y1 - y0) * rng.uniform(0.1, 0.95))
            cv2.rectangle(
                picture,
                (left + 2, top),
                (left + (x1 - x0) * 7 // (10 * num), y1),
                to_bytes(vivid(rng)),
                -1,
            )
    else:
        xs = np.linspace(0, 1, 60)
        for _ in range(rng.integers(2, 5)):
            ys = 0.5 + 0.4 * np.sin(xs * rng.uniform(1, 9) + rng.uniform(0, 6)) * np.exp(
                -xs * rng.uniform(0, 3)
            )
            curve = np.column_stack([x0 + xs * (x1 - x0), y1 - ys * (y1 - y0)]).astype(np.int32)
            cv2.polylines(
                picture, [curve], False, to_bytes(vivid(rng)), max(1, h // 90), cv2.LINE_AA
            )
    cv2.polylines(
        picture,
        [np.array([[x0, y0], [x0, y1], [x1, y1]], np.int32)],
        False,
        ink,
        max(1, h // 120),
        cv2.LINE_AA,
    )
    return picture
