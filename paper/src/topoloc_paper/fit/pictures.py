"""Pictures made harder, and pictures of no place at all."""

from __future__ import annotations

import cv2
import numpy as np


def darkened(image: np.ndarray, gamma: float, seed: int) -> np.ndarray:
    """A third of the light, less of it to the right, another response, and noise."""
    rng = np.random.default_rng(seed)
    gradient = np.linspace(1.0, 0.3, image.shape[1])[None, :]
    light = image / 255.0 / 3.0 * (gradient if image.ndim == 2 else gradient[..., None])
    return np.clip(255.0 * light**gamma + rng.normal(0.0, 4.0, image.shape), 0, 255).astype(
        np.uint8
    )


def drawn_pictures(num: int) -> list[np.ndarray]:
    """Noise, clouds, lettering, shapes and wallpaper, 640x480."""
    rng = np.random.default_rng(0)
    makers = (_noise, _clouds, _lettering, _shapes, _wallpaper)
    return [np.clip(makers[i % len(makers)](rng), 0, 255).astype(np.uint8) for i in range(num)]


def _noise(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(128, rng.uniform(10, 60), (480, 640))


def _clouds(rng: np.random.Generator) -> np.ndarray:
    step = int(rng.integers(2, 9))
    return cv2.resize(
        rng.normal(128, 60, (480 // step, 640 // step)), (640, 480), interpolation=cv2.INTER_CUBIC
    )


def _lettering(rng: np.random.Generator) -> np.ndarray:
    picture = np.full((480, 640), int(rng.uniform(100, 255)), np.uint8)
    for _ in range(60):
        word = "".join(chr(letter) for letter in rng.integers(65, 90, 8))
        place = (int(rng.integers(-50, 640)), int(rng.integers(0, 480)))
        cv2.putText(
            picture,
            word,
            place,
            cv2.FONT_HERSHEY_SIMPLEX,
            float(rng.uniform(0.4, 3)),
            int(rng.uniform(0, 255)),
            int(rng.integers(1, 6)),
        )
    return picture


def _shapes(rng: np.random.Generator) -> np.ndarray:
    picture = np.full((480, 640), 200, np.uint8)
    for _ in range(120):
        x, y, size, level = (
            int(rng.integers(0, 640)),
            int(rng.integers(0, 480)),
            int(rng.integers(3, 120)),
            int(rng.uniform(0, 255)),
        )
        if rng.random() < 0.5:
            cv2.circle(picture, (x, y), size // 2 + 1, level, -1)
        else:
            cv2.rectangle(picture, (x, y), (x + size, y + int(rng.integers(3, 120))), level, -1)
    return picture


def _wallpaper(rng: np.random.Generator) -> np.ndarray:
    side = int(rng.integers(30, 160))
    tile = cv2.resize(rng.normal(128, 50, (40, 40)), (side, side))
    return np.tile(tile, (480 // side + 1, 640 // side + 1))[:480, :640]
