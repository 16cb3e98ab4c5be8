"""Place vectors that are comparable between maps: one vocabulary and one whitening for each kind of
features, shipped.

A map's own `surf-vlad` is sharper inside of it, but its words and axes are its own. These were
learned once, over recordings of many places (`topoloc_training.shared_vocabulary` in `training/`
makes them; each file says of what, when and how), so that vectors of tiles that never met can be
ranked together. The vector itself is `vlad.py`'s: VLAD of local features with their places in the
picture behind them, whitened. A vocabulary's `version` goes with each vector that is kept: vectors
of another version are not compared.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache, cached_property
from hashlib import blake2b
from importlib import resources
from typing import Any

import numpy as np
from jaxtyping import Float32

from topoloc.features.features import Features
from topoloc.retrieval.descriptor_index import Whitening
from topoloc.retrieval.vlad import VladConfig, append_positions, vlad

_FOLDER = "vocabularies"


@dataclass(frozen=True, eq=False)
class SharedVocabulary:
    """Words (with the features' weighted places behind them) and whitening of one kind of features;
    `about` says where they come from."""

    kind: str
    words: Float32[np.ndarray, "k d"]
    whitening: Whitening
    config: VladConfig
    about: dict[str, Any]

    @property
    def dimension(self) -> int:
        """Length of a place vector."""
        return len(self.whitening.projection)

    @cached_property
    def version(self) -> str:
        """What tells these words and axes from all others, 12 hexadecimal digits."""
        parts = (self.words, self.whitening.mean, self.whitening.projection)
        return blake2b(b"".join(part.tobytes() for part in parts), digest_size=6).hexdigest()

    def raw_descriptor(
        self, features: Features, width: int, height: int
    ) -> Float32[np.ndarray, " kd"]:
        """VLAD of the features of a picture of that size (pixels), before whitening."""
        return vlad(append_positions(features, width, height, self.config), self.words)

    def global_descriptor(
        self, features: Features, width: int, height: int
    ) -> Float32[np.ndarray, " p"]:
        """The place vector of a picture of that size (pixels): of unit length, the inner product of
        two is their likeness."""
        return self.whitening.apply(self.raw_descriptor(features, width, height)[None])[0]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """What the file keeps, half floats."""
        arrays = {
            "words": self.words,
            "mean": self.whitening.mean,
            "projection": self.whitening.projection,
        }
        about = np.array(
            json.dumps(
                self.about | {"kind": self.kind, "position_weight": self.config.position_weight}
            )
        )
        return {name: array.astype(np.float16) for name, array in arrays.items()} | {"about": about}


@cache
def shared_vocabulary(kind: str) -> SharedVocabulary | None:
    """That of a kind of features; None where none was learned for it."""
    path = resources.files("topoloc.retrieval").joinpath(_FOLDER, f"{kind}.npz")
    if not path.is_file():
        return None
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        words, mean, projection = (
            stored[name].astype(np.float32) for name in ("words", "mean", "projection")
        )
        about = json.loads(str(stored["about"]))
    config = VladConfig(
        num_words=len(words), position_weight=about["position_weight"], dimension=len(projection)
    )
    return SharedVocabulary(kind, words, Whitening(mean, projection), config, about)
