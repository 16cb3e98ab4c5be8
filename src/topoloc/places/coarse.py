"""Coarse localization: which node of the map is this image of?

Every coarse localizer answers the same question behind `CoarseLocalizer.rank`; what it has learnt travels in a
`CoarseModel`, which the map file stores. Names are the paper's; `surf-vlad` needs neither weights nor torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from topoloc.features.features import Features

Image = UInt8[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class NodeScore:
    """A candidate node; a higher score is a better one, comparable within one localizer only."""

    node_id: int
    score: float


@dataclass(frozen=True, eq=False)
class CoarseModel:
    """A coarse localizer as the map keeps it: its settings and its arrays (vocabulary, vectors, node of each vector ...)."""

    name: str
    settings: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]


@runtime_checkable
class CoarseLocalizer(Protocol):
    """Names the nodes that an image may belong to."""

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """Up to `num_candidates` distinct nodes, best first. `features` are those of `image` that the fine step uses too."""
        ...


def open_coarse(model: CoarseModel) -> CoarseLocalizer:
    """The localizer of a stored model. Raises MapError for a name that this version does not know."""
    from topoloc.errors import MapError
    from topoloc.places.vlad import SurfVlad

    if model.name == SurfVlad.name:
        return SurfVlad.from_model(model)
    raise MapError(f"the map's coarse localizer {model.name!r} is not known to this version (known: {SurfVlad.name})")
