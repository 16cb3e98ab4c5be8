"""Test a shared vocabulary learned from a few images: it distinguishes their places, and its
file is exact."""

from __future__ import annotations

import io

import numpy as np

from topoloc.features.features import Features
from topoloc_training.shared_vocabulary import learn_vocabulary


def _picture(seed: int, noise_seed: int) -> tuple[Features, int, int]:
    """Return the features of a place, one per `seed`, with variations by `noise_seed`."""
    rng, noise = np.random.default_rng(seed), np.random.default_rng(noise_seed)
    descriptors = rng.standard_normal((150, 64)) + 0.2 * noise.standard_normal((150, 64))
    unit = (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.float32)
    points, zero = rng.uniform(0, 200, (150, 2)).astype(np.float32), np.zeros(150, np.float32)
    return Features(points, zero, zero, zero, unit), 200, 200


def test_places_are_distinguished():
    recordings = {
        "a": [_picture(seed, seed) for seed in range(12)],
        "b": [_picture(seed, seed) for seed in range(12, 24)],
    }
    vocabulary = learn_vocabulary("surf", recordings, num_words=8, dimension=16)
    assert vocabulary.about["recordings"] == {"a": 12, "b": 12}
    mapped = np.stack([vocabulary.global_descriptor(*_picture(seed, seed)) for seed in range(24)])
    asked = np.stack(
        [vocabulary.global_descriptor(*_picture(seed, 100 + seed)) for seed in range(24)]
    )
    assert np.array_equal(np.argmax(asked @ mapped.T, axis=1), np.arange(24))


def test_the_file_contains_the_learned_words():
    vocabulary = learn_vocabulary(
        "surf", {"a": [_picture(seed, seed) for seed in range(8)]}, num_words=4, dimension=8
    )
    file = io.BytesIO()
    np.savez(file, **vocabulary.to_arrays())  # pyright: ignore[reportArgumentType]
    file.seek(0)
    stored = np.load(file)
    assert np.array_equal(stored["words"].astype(np.float32), vocabulary.words)
    assert np.array_equal(stored["projection"].astype(np.float32), vocabulary.whitening.projection)
