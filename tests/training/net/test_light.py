"""Test random light: the image keeps eight bits, a seed fixes it, and its content stays visible."""

from __future__ import annotations

import cv2
import numpy as np

from topoloc_training.net.light import changed


def textured(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).random((24, 32)).astype(np.float32)
    return cv2.resize(noise, (160, 120), interpolation=cv2.INTER_CUBIC).clip(0, 1)


def likeness(first: np.ndarray, second: np.ndarray) -> float:
    """Return the correlation of two images without slow changes of brightness."""
    flat = [
        np.log(image + 0.02) - cv2.GaussianBlur(np.log(image + 0.02), (0, 0), 8)
        for image in (first, second)
    ]
    flat = [cv2.GaussianBlur(image, (0, 0), 2).ravel() for image in flat]
    return float(np.corrcoef(*flat)[0, 1])


def test_many_lights_are_pictures_of_the_same():
    picture = textured()
    pictures = [changed(picture, 1.0, np.random.default_rng(seed)) for seed in range(40)]
    for light in pictures:
        assert light.shape == picture.shape
        assert light.dtype == np.float32
        assert 0 <= light.min() <= light.max() <= 1
        assert np.abs(light * 255 - np.round(light * 255)).max() < 1e-3
    similar = [likeness(picture, light) for light in pictures]
    assert np.median(similar) > 0.5
    assert (
        np.median(similar) > np.median([likeness(textured(1), light) for light in pictures]) + 0.4
    )
    levels = [light.mean() for light in pictures]
    assert min(levels) < 0.25 < max(levels) - 0.2, "night and day"


def test_a_seed_fixes_the_light():
    first, again, other = (
        changed(textured(), 1.0, np.random.default_rng(seed)) for seed in (3, 3, 4)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
