"""Coarse localization: which node of the map is this image of?

Every coarse localizer answers the same question behind `CoarseLocalizer.rank`; what it has learnt
travels in a `CoarseModel`, which the map file stores. Names are the paper's; `surf-vlad` needs
neither weights nor torch.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import numpy as np
from jaxtyping import Int, UInt8

from topoloc.bounds import parse_value
from topoloc.errors import ConfigError, MapError, MissingExtraError
from topoloc.features.features import Features

CoarseName = Literal["surf-vlad", "cnn-fc", "cnn-nn", "vlad-nn"]
COARSE_NAMES: tuple[CoarseName, ...] = get_args(CoarseName)
_MODULES = {"surf-vlad": "vlad", "cnn-fc": "cnn_fc", "cnn-nn": "cnn_nn", "vlad-nn": "vlad_nn"}

Image = UInt8[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class NodeScore:
    """A candidate node; a higher score is a better one, comparable within one localizer only.

    `node_id` is the node's id in what is reported, and its row in the open map while a query is
    answered (`CoarseLocalizer.rank`).
    """

    node_id: int
    score: float


@dataclass(frozen=True, eq=False)
class CoarseModel:
    """A coarse localizer as the map keeps it: its settings and its arrays (vocabulary, vectors,
    node of each vector ...)."""

    name: str
    settings: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]


def model_array(
    model: CoarseModel, name: str, kinds: str, shape: tuple[int | None, ...]
) -> np.ndarray:
    """An array of a stored model, of this shape (None: any length but 0) and of one of these kinds
    of numbers (NumPy's letters).

    Raises:
        MapError: it is missing, of another shape or type, or not finite.
    """
    array = model.arrays.get(name)
    fits = array is not None and array.dtype.kind in kinds and array.ndim == len(shape)
    if (
        array is None
        or not fits
        or any(
            n == 0 or (m is not None and n != m) for n, m in zip(array.shape, shape, strict=True)
        )
    ):
        found = "missing" if array is None else f"{array.dtype} {array.shape}"
        expected = " x ".join("any" if length is None else str(length) for length in shape)
        raise MapError(
            f"the map's coarse localizer {model.name!r} is damaged: {name} is {found}, not"
            f" {expected} numbers"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise MapError(
            f"the map's coarse localizer {model.name!r} is damaged: {name} is not finite"
        )
    return array


@runtime_checkable
class CoarseLocalizer(Protocol):
    """Names the nodes that an image may belong to."""

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """Up to `num_candidates` distinct nodes by their rows in the map, best first. `features`
        are those of `image` that the fine step uses too."""
        ...


@runtime_checkable
class DescriptorLocalizer(CoarseLocalizer, Protocol):
    """One that compares vectors of pictures."""

    def suppress_group_differences(
        self, group_of_node: Int[np.ndarray, " nodes"]
    ) -> CoarseLocalizer:
        """The same with less of what sets groups of nodes, by their rows, apart on the whole."""
        ...


@runtime_checkable
class ExtendableLocalizer(CoarseLocalizer, Protocol):
    """One that learns a picture by its vector alone."""

    def extend_with_images(
        self, images: Sequence[Image], node_ids: Int[np.ndarray, " n"]
    ) -> CoarseModel:
        """The stored model with these pictures, each of the node with this id."""
        ...


def open_coarse_localizer(model: CoarseModel) -> CoarseLocalizer:
    """The localizer of a stored model.

    Raises:
        MapError: the model is damaged, or of a name that this version does not know.
        MissingExtraError: it needs torch, which is not installed.
    """
    name = model.name.partition("@")[0]  # behind it stands the kind of features that it ranks by
    if name not in COARSE_NAMES:
        raise MapError(
            f"the map's coarse localizer {model.name!r} is not known to this version (known:"
            f" {', '.join(COARSE_NAMES)})"
        )
    try:
        return importlib.import_module(f"topoloc.retrieval.{_MODULES[name]}").open_model(model)
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise MissingExtraError(
            f"the coarse localizer {model.name!r} needs PyTorch: pip install 'topoloc[deep]'"
        ) from error
    except ConfigError as error:
        raise MapError(f"the map's coarse localizer {model.name!r} is damaged: {error}") from error


def read_setting(model: CoarseModel, name: str, of: Any) -> Any:
    """A setting of a stored model, of this type, without the keys of other versions. Raises
    ConfigError."""
    return parse_value(of, model.settings.get(name), name, is_strict=False)
