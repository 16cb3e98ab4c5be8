"""Test the shipped vocabularies: small, with a stated source, and equal for each reader."""

from __future__ import annotations

from importlib import resources

import numpy as np
import pytest

from topoloc.features.feature_types import FEATURE_TYPES
from topoloc.features.features import Features
from topoloc.retrieval.shared_vocabulary import shared_vocabulary


def _files() -> list[str]:
    return sorted(
        path.name
        for path in resources.files("topoloc.retrieval").joinpath("vocabularies").iterdir()
    )


def test_they_are_small_and_of_known_feature_types():
    assert _files() == ["surf.npz", "topoloc-net.npz"]
    folder = resources.files("topoloc.retrieval").joinpath("vocabularies")
    assert sum(len(folder.joinpath(name).read_bytes()) for name in _files()) <= 1_500_000


@pytest.mark.parametrize("kind", ["surf", "topoloc-net"])
def test_they_name_their_training_data(kind: str):
    vocabulary = shared_vocabulary(kind)
    assert vocabulary is not None
    about = vocabulary.about
    assert sum(about["recordings"].values()) > 500
    assert about["date"]
    assert about["command"].startswith(f"python -m topoloc_training.shared_vocabulary {kind} ")
    assert vocabulary.words.shape[1] == FEATURE_TYPES[kind].descriptor_size + 2
    assert len(vocabulary.version) == 12


def test_other_feature_types_have_none():
    assert shared_vocabulary("sift") is None


def test_pictures_of_the_same_things_have_like_vectors():
    """An object is a set of descriptors near some words. Each image adds its own noise."""
    vocabulary = shared_vocabulary("surf")
    assert vocabulary is not None
    words = vocabulary.words[:, :64]

    def global_descriptor(first: int, noise_seed: int) -> np.ndarray:
        things, noise = np.random.default_rng(first), np.random.default_rng(noise_seed)
        descriptors = (
            words[first + things.integers(0, 8, 200)]
            + 0.05 * things.standard_normal((200, 64))
            + 0.02 * noise.standard_normal((200, 64))
        )
        unit = (descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)).astype(np.float32)
        zero = np.zeros(200, np.float32)
        features = Features(
            things.uniform(0, 300, (200, 2)).astype(np.float32), zero, zero, zero, unit
        )
        return vocabulary.global_descriptor(features, 320, 320)

    one, again, other = global_descriptor(0, 1), global_descriptor(0, 2), global_descriptor(16, 3)
    assert [float(np.linalg.norm(each)) for each in (one, again, other)] == pytest.approx(
        [1.0] * 3, abs=1e-4
    )
    assert one @ again > one @ other + 0.3
    assert np.isfinite(vocabulary.global_descriptor(Features.empty(64), 320, 320)).all()
