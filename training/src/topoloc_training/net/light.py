"""Simulate light and weather of another time in a grey image.

An image is (h, w) float32 in [0, 1]. Every change is drawn from the given generator, so a seed
determines the result.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float
from numpy.random import Generator

Grey = Float[np.ndarray, "h w"]


def changed(picture: Grey, strength: float, generator: Generator) -> Grey:
    """The picture in another light. `strength` in [0, 1]: how many changes, and whether it may be
    night, rain or fog."""
    result = picture.astype(np.float32)
    if generator.random() < 0.8 * strength:
        result = _relit(result, generator, 0.3 + 0.9 * strength * generator.random())
    if generator.random() < 0.5 * strength:
        result = _shaded(result, generator)
    if generator.random() < 0.7 * strength:
        change = _WEATHERS[int(generator.choice(len(_WEATHERS), p=_WEATHER_SHARES))]
        result = change(result, generator)
    if generator.random() < 0.3 + 0.3 * strength:
        result = _blurred(result, generator)
    result = _exposed(result, generator, strength)
    if generator.random() < 0.25 * strength:
        quality = int(generator.integers(25, 90))
        encoded = cv2.imencode(
            ".jpg", (result * 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality]
        )[1]
        result = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE), np.float32) / 255
    return result


def _field(shape: tuple[int, ...], generator: Generator, cells: int) -> Grey:
    """Smooth noise of unit deviation, `cells` cells along the width."""
    rows = max(2, round(cells * shape[0] / shape[1]))
    coarse = generator.standard_normal((rows, cells)).astype(np.float32)
    return cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)


def _relit(picture: Grey, generator: Generator, amount: float) -> Grey:
    """Lit from elsewhere: multiplied by a smooth field."""
    field = _field(picture.shape, generator, int(generator.integers(2, 7)))
    return picture * np.exp(amount * field)


def _shaded(picture: Grey, generator: Generator) -> Grey:
    """Shadows or patches of light with edges."""
    height, width = picture.shape
    factor = np.ones_like(picture)
    for _ in range(int(generator.integers(1, 4))):
        corners = generator.uniform(-0.3, 1.3, (int(generator.integers(3, 6)), 2)) * (width, height)
        cv2.fillPoly(factor, [corners.astype(np.int32)], float(np.exp(generator.normal(-0.3, 0.7))))
    return picture * cv2.GaussianBlur(factor, (0, 0), float(generator.uniform(0.5, 6)))


def _night(picture: Grey, generator: Generator) -> Grey:
    """Little light left, falling off from lamps that shine into the picture; vignetting."""
    height, width = picture.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    light = np.full_like(picture, generator.uniform(0.03, 0.3))
    glare = np.zeros_like(picture)
    for _ in range(int(generator.integers(0, 4))):
        distance = (x - generator.uniform(-0.2, 1.2) * width) ** 2 + (
            y - generator.uniform(-0.3, 1.1) * height
        ) ** 2
        reach = generator.uniform(0.1, 0.6) * width
        light += generator.uniform(0.2, 1.2) * np.exp(-distance / reach**2)
        if generator.random() < 0.6:
            glare += generator.uniform(0.2, 1.0) * np.exp(
                -distance / (generator.uniform(0.01, 0.06) * width) ** 2
            )
    middle = (x / width - 0.5) ** 2 + (y / height - 0.5) ** 2
    light *= 1 - generator.uniform(0, 0.9) * middle
    return picture ** generator.uniform(1.0, 1.5) * light + glare


def _rain(picture: Grey, generator: Generator) -> Grey:
    """Streaks, a veil and less contrast."""
    height, width = picture.shape
    streaks = np.zeros_like(picture)
    slope, length = generator.normal(0, 0.25), generator.uniform(6, 30)
    for x, y in generator.uniform(0, 1, (int(generator.integers(20, 200)), 2)) * (width, height):
        end = (int(x + slope * length), int(y + length))
        cv2.line(streaks, (int(x), int(y)), end, float(generator.uniform(0.1, 0.5)), 1, cv2.LINE_AA)
    veiled = _fog(picture, generator, 0.4) if generator.random() < 0.7 else picture
    return veiled + cv2.GaussianBlur(streaks, (0, 0), 0.7) * generator.uniform(0.2, 0.7)


def _fog(picture: Grey, generator: Generator, thickest: float = 0.85) -> Grey:
    """Blend the image with one grey, most in distant parts."""
    rows = np.linspace(-1, 1, picture.shape[0], dtype=np.float32)[:, None]
    far = np.exp(-(((rows - generator.uniform(-0.5, 0.3)) / generator.uniform(0.4, 1.2)) ** 2))
    veil = np.clip(
        generator.uniform(0.1, thickest) * far * (1 + 0.3 * _field(picture.shape, generator, 4)),
        0,
        0.9,
    )
    return picture * (1 - veil) + generator.uniform(0.3, 0.9) * veil


def _wet(picture: Grey, generator: Generator) -> Grey:
    """Darken rough surfaces: the contrast changes at the middle greys."""
    level, slope = generator.uniform(0.2, 0.7), generator.uniform(3, 8)
    return picture * (0.45 + 0.55 / (1 + np.exp(-slope * (picture - level))))


_WEATHERS: tuple[Callable[[Grey, Generator], Grey], ...] = (_night, _rain, _fog, _wet)
_WEATHER_SHARES = (0.55, 0.2, 0.15, 0.1)


def _blurred(picture: Grey, generator: Generator) -> Grey:
    """Out of focus, or moved."""
    if generator.random() < 0.5:
        return cv2.GaussianBlur(picture, (0, 0), float(generator.uniform(0.4, 1.6)))
    length = int(generator.integers(2, 8))
    kernel = np.zeros((length, length), np.float32)
    angle = generator.uniform(0, np.pi)
    reach = (length - 1) / 2 * np.array([np.cos(angle), np.sin(angle)])
    ends = ((length - 1) / 2 + np.array([-reach, reach])).round().astype(int)
    cv2.line(kernel, ends[0].tolist(), ends[1].tolist(), 1.0, 1, cv2.LINE_AA)
    return cv2.filter2D(picture, -1, kernel / kernel.sum())


def _exposed(picture: Grey, generator: Generator, strength: float) -> Grey:
    """A camera's exposure, photon and read noise, curve, clipping and eight bits."""
    light = cv2.pow(np.maximum(picture, 0).astype(np.float32), 2.2)
    wanted = np.exp(generator.normal(-1.9, 0.2 + 0.5 * strength))
    light = light * np.clip(wanted / (light.mean() + 1e-6), 0.05, 20)
    electrons = np.exp(generator.uniform(np.log(4000 / (1 + 60 * strength)), np.log(4000)))
    read = generator.uniform(1, 4) / electrons
    noise = generator.standard_normal(light.shape, dtype=np.float32)
    light = light + noise * np.sqrt(np.minimum(light, 1) / electrons + read**2)
    curve = cv2.pow(
        np.clip(light, 0, 1), 1 / generator.uniform(2.2 - 0.6 * strength, 2.2 + 0.6 * strength)
    )
    return (np.round(curve * 255) / 255).astype(np.float32)
