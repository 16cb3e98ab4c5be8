"""Make the textures of the corridor's walls and floor. They are as long as the wall, so no part
repeats."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32

from topoloc_worlds.noise import fractal_noise, smooth_noise
from topoloc_worlds.scene import Color, Picture

PIXELS_PER_METRE = 150
_Layer = Float32[np.ndarray, "h w"]
_Painting = Float32[np.ndarray, "h w 3"]


def wall_paint(
    rng: np.random.Generator, length: float, height: float, tint: Color, dado: Color | None = None
) -> Picture:
    """A painted wall: nearly bare, with roller marks, faint stains, mended spots and the scuffs of
    trolleys and chairs.

    Args:
        dado: colour of the lower part, up to 1.1 m, in washable paint.
    """
    size = _pixels(height), _pixels(length)
    paint = np.broadcast_to(np.asarray(tint, np.float32), (*size, 3)).copy()
    if dado is not None:
        edge = size[0] - _pixels(1.1)
        paint[edge:] = dado
        paint[edge - 2 : edge] *= 0.72
    paint *= (1.0 + 0.012 * _stains(rng, size) + 0.006 * smooth_noise(rng, size, 0.7))[..., None]
    _mend(rng, paint, length)
    above_floor = (np.arange(size[0], dtype=np.float32)[::-1] / PIXELS_PER_METRE)[:, None, None]
    paint *= 1.0 - 0.06 * np.exp(-above_floor / 0.12)
    _blend(paint, _scuffs(rng, size, int(1.3 * length), low=0.12, high=0.95), (0.25, 0.23, 0.22))
    _blend(paint, _hand_marks(rng, size, int(0.4 * length)), (0.45, 0.40, 0.35))
    return _picture(paint)


def linoleum_floor(
    rng: np.random.Generator, length: float, width: float, field: Color, border: Color
) -> Picture:
    """Marbled sheets laid lengthwise between two darker borders, welded every few metres, with the
    black marks of soles."""
    size = _pixels(width), _pixels(length)
    floor = np.broadcast_to(np.asarray(field, np.float32), (*size, 3)).copy()
    edge = _pixels(0.22)
    floor[:edge] = border
    floor[-edge:] = border
    marble = cv2.resize(
        fractal_noise(rng, (size[0], size[1] // 5), coarsest_px=7.0, octaves=4),
        size[::-1],
        interpolation=cv2.INTER_LINEAR,
    )
    floor *= (1.0 + 0.05 * marble + 0.02 * _stains(rng, size))[..., None]
    veins = np.clip(np.abs(marble) < 0.06, 0, 1).astype(np.float32)
    floor *= (1.0 - 0.06 * cv2.GaussianBlur(veins, (0, 0), 0.8))[..., None]
    for x in np.cumsum(rng.uniform(1.8, 6.0, 16)):
        if x < length:
            column = _pixels(float(x))
            floor[:, column : column + 1] *= 0.84
    floor[size[0] // 2 : size[0] // 2 + 1] *= 0.88
    _blend(
        floor, _scuffs(rng, size, int(3 * length), low=0.1, high=width - 0.1), (0.12, 0.11, 0.11)
    )
    return _picture(floor)


def paving(rng: np.random.Generator, slabs: int = 6) -> Picture:
    """Square concrete slabs, `slabs` each way, no two of one grey."""
    slab = 64
    greys = 0.60 + 0.05 * rng.standard_normal((slabs, slabs))
    ground = np.kron(greys, np.ones((slab, slab))).astype(np.float32)
    ground *= 1.0 + 0.06 * fractal_noise(rng, ground.shape, coarsest_px=16.0)
    for i in range(slabs):
        for image in (ground, ground.T):
            image[i * slab : i * slab + 2] *= 0.55
    return _picture(
        np.repeat(ground[..., None], 3, axis=2) * np.array([1.0, 0.98, 0.94], np.float32)
    )


def lawn(rng: np.random.Generator) -> Picture:
    size = (384, 384)
    grass = fractal_noise(rng, size, coarsest_px=40.0, octaves=6)
    blades = smooth_noise(rng, size, 0.8)
    tone = (0.36 + 0.05 * grass + 0.04 * blades)[..., None]
    return _picture(tone * np.array([0.92, 1.18, 0.48], np.float32) + 0.02)


def _pixels(metres: float) -> int:
    return round(metres * PIXELS_PER_METRE)


def _picture(colors: _Painting) -> Picture:
    return np.round(np.clip(colors, 0.0, 1.0) * 255.0).astype(np.uint8)


def _blend(painting: _Painting, mask: _Layer, color: Color) -> None:
    painting += mask[..., None] * (np.asarray(color, np.float32) - painting)


def _stains(rng: np.random.Generator, size: tuple[int, int]) -> _Layer:
    """Clouds from hand's size up to a metre, made small and enlarged: they have no fine grain."""
    small = fractal_noise(
        rng, (max(size[0] // 6, 8), max(size[1] // 6, 8)), coarsest_px=18.0, octaves=4
    )
    return cv2.resize(small, size[::-1], interpolation=cv2.INTER_CUBIC)


def _scuffs(
    rng: np.random.Generator, size: tuple[int, int], count: int, low: float, high: float
) -> _Layer:
    """Short, nearly level strokes between two distances from the lower edge (metres)."""
    mask = np.zeros(size, np.float32)
    for _ in range(count):
        x, y = rng.uniform(0, size[1]), size[0] - PIXELS_PER_METRE * rng.uniform(low, high)
        reach, slope = PIXELS_PER_METRE * rng.exponential(0.09), rng.normal(0.0, 0.18)
        end = (int(x + reach), int(y + slope * reach))
        cv2.line(
            mask,
            (int(x), int(y)),
            end,
            float(rng.uniform(0.08, 0.4)),
            int(rng.integers(1, 3)),
            cv2.LINE_AA,
        )
    return cv2.GaussianBlur(mask, (0, 0), 0.7)


def _hand_marks(rng: np.random.Generator, size: tuple[int, int], count: int) -> _Layer:
    mask = np.zeros(size, np.float32)
    for _ in range(count):
        centre = (
            int(rng.uniform(0, size[1])),
            int(size[0] - PIXELS_PER_METRE * rng.uniform(0.8, 1.6)),
        )
        axes = int(rng.uniform(4, 16)), int(rng.uniform(3, 9))
        cv2.ellipse(
            mask,
            centre,
            axes,
            float(rng.uniform(0, 180)),
            0,
            360,
            float(rng.uniform(0.02, 0.08)),
            -1,
        )
    return cv2.GaussianBlur(mask, (0, 0), 4.0)


def _mend(rng: np.random.Generator, paint: _Painting, length: float) -> None:
    """Filled holes and patches painted over, a shade off."""
    height, width = paint.shape[:2]
    for _ in range(int(length / 3)):
        w, h = (_pixels(float(rng.uniform(0.08, 0.5))) for _ in range(2))
        x, y = int(rng.uniform(0, width)), int(rng.uniform(0.1, 0.8) * height)
        paint[y : y + h, x : x + w] *= rng.uniform(0.97, 1.02)
    for _ in range(int(2 * length)):
        x, y = int(rng.uniform(0, width)), int(height - PIXELS_PER_METRE * rng.uniform(1.1, 2.2))
        cv2.circle(
            paint,
            (x, y),
            1,
            [float(v) * 0.75 for v in paint[min(y, height - 1), min(x, width - 1)]],
            -1,
        )
