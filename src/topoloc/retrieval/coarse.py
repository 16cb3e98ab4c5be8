"""Define coarse localization: the selection of the map nodes that an image may show.

All coarse localizers implement `CoarseLocalizer.rank`. Their trained state is a `CoarseModel`,
which the map file stores. Names are the paper's. `surf-vlad` needs neither weights nor torch. Other
distributions add localizers with entry points of the group `topoloc.coarse_localizers`, which are
named as the models: topoloc-training those with trained networks.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int, UInt8

from topoloc.bounds import AtLeast, Between
from topoloc.errors import ConfigError, MapError, MissingExtraError
from topoloc.features.features import Features
from topoloc.node_ids import Row

COARSE_NAMES = ("surf-vlad", "cnn-fc", "cnn-nn", "vlad-nn")
_INSTALL = "pip install . ./training (in topoloc's source folder)"

Image = UInt8[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class VladConfig:
    """Hold the settings of surf-vlad."""

    num_words: Annotated[int, Between(1, 65_536)] = 64
    """Visual words of the vocabulary."""
    position_weight: Annotated[float | None, AtLeast(0)] = None
    """Distance that opposite image borders add between two descriptors (of length 1). 0 ignores
    positions. Unset: the default of the feature type."""
    dimension: Annotated[int, Between(1, 65_536)] = 128
    """Maximum length of a global descriptor after PCA."""
    seed: Annotated[int, Between(0, 1_000_000_000)] = 0
    """Seed of the vocabulary."""


@dataclass(frozen=True)
class NodeScore:
    """Hold the row of a candidate node in the open map and its score. Higher is better. Scores are
    comparable within one localizer only."""

    row: Row
    score: float


@dataclass(frozen=True, eq=False)
class CoarseModel:
    """Hold a coarse localizer as stored in the map: its settings and its arrays (vocabulary,
    vectors, node of each vector ...)."""

    name: str
    settings: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]


def model_array(
    model: CoarseModel, name: str, kinds: str, shape: tuple[int | None, ...]
) -> np.ndarray:
    """Return an array of a stored model after a check of its shape (None: any length but 0) and its
    dtype kind (NumPy's letters).

    Raises:
        MapError: the array is missing, not finite, or has another shape or type.
    """
    array = model.arrays.get(name)
    damaged = f"the map's coarse localizer {model.name!r} is damaged: {name} is"
    if (
        array is None
        or array.dtype.kind not in kinds
        or not (
            array.ndim == len(shape)
            and all(n > 0 and m in (None, n) for n, m in zip(array.shape, shape, strict=True))
        )
    ):
        found = "missing" if array is None else f"{array.dtype} {array.shape}"
        expected = " x ".join("any" if length is None else str(length) for length in shape)
        raise MapError(f"{damaged} {found}, not {expected} numbers")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise MapError(f"{damaged} not finite")
    return array


@runtime_checkable
class CoarseLocalizer(Protocol):
    """Rank the nodes that an image may show."""

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """Return up to `num_candidates` distinct nodes by their rows in the map, best first.
        `features` are those of `image`, also used by the fine step."""
        ...


@runtime_checkable
class DescriptorLocalizer(CoarseLocalizer, Protocol):
    """Rank nodes by global descriptors of images."""

    def suppress_group_differences(
        self, group_of_node: Int[np.ndarray, " nodes"]
    ) -> CoarseLocalizer:
        """Return a localizer with reduced differences between groups of nodes. `group_of_node` is
        indexed by a node's row."""
        ...


@runtime_checkable
class ExtendableLocalizer(CoarseLocalizer, Protocol):
    """Rank nodes with a model to which images can be added without training."""

    def extend_with_images(
        self, images: Sequence[Image], node_ids: Int[np.ndarray, " n"]
    ) -> CoarseModel:
        """Return the stored model extended by these images, each with the id of its node."""
        ...


Opener = Callable[[CoarseModel], CoarseLocalizer]
_extensions: dict[str, Opener] = {}


def register_coarse_localizer(name: str, open_model: Opener) -> None:
    """Add a coarse localizer, in this process: `open_model` makes it of the model of this name in a
    map, whose `node_ids` name the node of each of its `vectors`. Raises ConfigError."""
    if name in COARSE_NAMES:
        raise ConfigError(f"coarse localizer {name!r} is topoloc's; give yours another name")
    _extensions[name] = open_model


def open_coarse_localizer(model: CoarseModel) -> CoarseLocalizer:
    """Return the localizer of a stored model.

    Raises:
        MapError: the model is damaged, or this version does not support it.
        MissingExtraError: the model needs topoloc-training or PyTorch, which is not installed.
    """
    if model.name in _extensions:
        return _extensions[model.name](model)
    open_model = _load_opener(model.name)
    try:
        return open_model(model)
    except ConfigError as error:
        raise MapError(f"the map's coarse localizer {model.name!r} is damaged: {error}") from error


def _load_opener(name: str) -> Opener:
    """Load what opens models of this name, of topoloc or of another distribution."""
    if name == "surf-vlad":
        return importlib.import_module("topoloc.retrieval.vlad").open_model
    is_trained = name in COARSE_NAMES
    missing = "topoloc-training" if is_trained else None
    for entry_point in metadata.entry_points(group="topoloc.coarse_localizers", name=name):
        try:
            return entry_point.load()
        except ImportError as error:
            missing = error.name or str(error)
    if missing is not None:
        remedy = _INSTALL if is_trained else "install it"
        raise MissingExtraError(f"the coarse localizer {name!r} needs {missing}: {remedy}")
    raise MapError(
        f"the map's coarse localizer {name!r} is not known to this version (known:"
        f" {', '.join(COARSE_NAMES)}; others after topoloc.plugin.register_coarse_localizer)"
    )
