"""Learn the shared vocabularies of `topoloc/retrieval/vocabularies` from recordings of many places.

    python -m topoloc_training.shared_vocabulary KIND OUT.npz RECORDING ...

A shipped vocabulary may be learned only from rendered worlds and from recordings whose licence
allows it. Each recording has the same weight, independent of its length. Words are k-means centres.
The whitening is learned from whole images and from halves of their features, because a map's nodes
keep only features with a 3-D position.
"""

from __future__ import annotations

import datetime
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float32

import topoloc
from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig, find_feature_type
from topoloc.features.features import Features
from topoloc.recordings.frame import to_grey
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import as_monocular
from topoloc.retrieval.coarse import VladConfig
from topoloc.retrieval.descriptor_index import Whitening, learn_whitening
from topoloc.retrieval.shared_vocabulary import SharedVocabulary
from topoloc.retrieval.vlad import append_positions, learn_words

NUM_PICTURES = 160  # of each recording
NUM_WORDS, DIMENSION = 32, 128

Described = tuple[Features, int, int]
"""The features of a picture, its width and height."""


def learn_vocabulary(
    kind: str, recordings: dict[str, list[Described]], num_words: int, dimension: int
) -> SharedVocabulary:
    """Return words and whitening of images of several recordings, rounded to the precision of the
    file."""
    config = VladConfig(
        num_words=num_words,
        dimension=dimension,
        position_weight=find_feature_type(kind).position_weight,
    )
    pictures = [picture for described in recordings.values() for picture in described]
    descriptors = np.concatenate([append_positions(*picture, config) for picture in pictures])
    words = _rounded(learn_words(descriptors, config))
    unwhitened = SharedVocabulary(
        kind, words, Whitening(np.zeros(1, np.float32), np.zeros((1, 1), np.float32)), config, {}
    )
    rng = np.random.default_rng(0)
    raw = np.stack(
        [
            unwhitened.raw_descriptor(*picture)
            for picture in [*pictures, *(_half(picture, rng) for picture in pictures)]
        ]
    )
    whitening = learn_whitening(raw, dimension)
    about = {
        "recordings": {name: len(described) for name, described in recordings.items()},
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "topoloc": topoloc.__version__,
    }
    return SharedVocabulary(
        kind,
        words,
        Whitening(_rounded(whitening.mean), _rounded(whitening.projection)),
        config,
        about,
    )


def _half(picture: Described, rng: np.random.Generator) -> Described:
    features, width, height = picture
    return (
        features.select(np.sort(rng.permutation(len(features))[: len(features) // 2])),
        width,
        height,
    )


def _rounded(values: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    return np.ascontiguousarray(values.astype(np.float16).astype(np.float32))


def _described(path: str, config: FeatureConfig) -> list[Described]:
    sequence = as_monocular(open_sequence(path))
    rows = np.unique(np.linspace(0, len(sequence) - 1, NUM_PICTURES).round().astype(int))
    described = []
    for row in rows:
        grey = to_grey(sequence[int(row)].image)
        described.append((extract_features(grey, config), grey.shape[1], grey.shape[0]))
    return described


def main(args: list[str]) -> None:
    kind, out, *paths = args
    recordings = {Path(path).name: _described(path, FeatureConfig(kind=kind)) for path in paths}
    vocabulary = learn_vocabulary(kind, recordings, NUM_WORDS, DIMENSION)
    vocabulary.about["command"] = (
        f"python -m topoloc_training.shared_vocabulary {kind} {Path(out).name}"
        f" {' '.join(recordings)}"
    )
    with Path(out).open("wb") as file:
        np.savez_compressed(file, **vocabulary.to_arrays())  # pyright: ignore[reportArgumentType]
    print(f"{out}: version {vocabulary.version}, {Path(out).stat().st_size} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
