"""Compute global descriptors that are comparable between maps, with one shipped vocabulary and
whitening per feature type.

A map's own `surf-vlad` is more precise within the map, but its words and axes are its own. The
shared ones were learned once over recordings of many places, so that the vectors of separate tiles
can be ranked together. `topoloc_training.shared_vocabulary` in `training/` learns them, and each
file documents its data.

The vector is that of `vlad.py`: whitened VLAD of local features with their image positions
appended. The `version` of a vocabulary is stored with each vector. Vectors of different versions
are not compared.
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
from topoloc.retrieval.coarse import VladConfig
from topoloc.retrieval.descriptor_index import Whitening
from topoloc.retrieval.vlad import append_positions, vlad

_FOLDER = "vocabularies"


@dataclass(frozen=True, eq=False)
class SharedVocabulary:
    """Hold the words (with weighted positions appended) and the whitening of one feature type.
    `about` documents their origin."""

    kind: str
    words: Float32[np.ndarray, "k d"]
    whitening: Whitening
    config: VladConfig
    about: dict[str, Any]

    @property
    def dimension(self) -> int:
        """Return the length of a global descriptor."""
        return len(self.whitening.projection)

    @cached_property
    def version(self) -> str:
        """Return an identifier of the words and axes, 12 hexadecimal digits."""
        parts = (self.words, self.whitening.mean, self.whitening.projection)
        return blake2b(b"".join(part.tobytes() for part in parts), digest_size=6).hexdigest()

    def raw_descriptor(
        self, features: Features, width: int, height: int
    ) -> Float32[np.ndarray, " kd"]:
        """Return the VLAD of the features of an image of that size (pixels), before whitening."""
        return vlad(append_positions(features, width, height, self.config), self.words)

    def global_descriptor(
        self, features: Features, width: int, height: int
    ) -> Float32[np.ndarray, " p"]:
        """Return the global descriptor of an image of that size (pixels). It has unit length, and
        the inner product of two is their similarity."""
        return self.whitening.apply(self.raw_descriptor(features, width, height)[None])[0]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays stored in the file, as half floats."""
        arrays = {"words": self.words, **vars(self.whitening)}
        own = {"kind": self.kind, "position_weight": self.config.position_weight}
        about = {"about": np.array(json.dumps(self.about | own))}
        return {name: array.astype(np.float16) for name, array in arrays.items()} | about


@cache
def shared_vocabulary(kind: str) -> SharedVocabulary | None:
    """Return the vocabulary of a feature type, or None if there is none."""
    folder = resources.files("topoloc.retrieval").joinpath(_FOLDER)
    # the name may come from a file: it is compared, and never a part of a path
    path = next((file for file in folder.iterdir() if file.name == f"{kind}.npz"), None)
    if path is None:
        return None
    with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        words, mean, projection = (
            stored[name].astype(np.float32) for name in ("words", "mean", "projection")
        )
        about = json.loads(str(stored["about"]))
    config = VladConfig(len(words), about["position_weight"], len(projection))
    return SharedVocabulary(kind, words, Whitening(mean, projection), config, about)
