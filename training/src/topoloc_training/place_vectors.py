"""Rank nodes by the nearest mapping images under the vectors of a network, and compute the vectors
and their whitening: for cnn-nn and vlad-nn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Int
from torch import nn

from topoloc.errors import MapError
from topoloc.features.features import Features
from topoloc.retrieval.coarse import CoarseModel, Image, NodeScore, model_array
from topoloc.retrieval.descriptor_index import (
    DescriptorIndex,
    Whitening,
    learn_whitening,
    pack_projection,
    unpack_projection,
)
from topoloc_training.classifier_config import CnnNnConfig, NetworkInputConfig, VladNnConfig
from topoloc_training.inference import Predictor
from topoloc_training.network_images import ImageShape, prepare_network_images
from topoloc_training.stored_networks import (
    load_network_weights,
    read_setting,
    rounded_to_half,
    to_arrays,
)
from topoloc_training.training_set import Progress, TrainingSet, decode_pictures

_CHUNK = 64  # images that are prepared for the network together


def fit_vectors(
    name: str,
    network: nn.Module,
    training_set: TrainingSet,
    config: CnnNnConfig | VladNnConfig,
    facts: Mapping[str, Any],
    progress: Progress,
) -> CoarseModel:
    """The model of a network: vectors of all mapping images and their whitening; `facts` go with
    its settings.

    The network's weights are rounded to half floats, as the map keeps them.

    Raises:
        MapError: a mapping image is damaged.
    """
    pictures, shape = decode_pictures(training_set)
    predict = Predictor(rounded_to_half(network))
    raw = []
    for start in range(0, len(pictures), _CHUNK):
        raw.append(
            predict(prepare_network_images(pictures[start : start + _CHUNK], shape, config.picture))
        )
        progress(f"{name}: vectors", min(start + _CHUNK, len(pictures)), len(pictures))
    vectors = np.concatenate(raw)
    whitening = learn_whitening(vectors, config.dimension)
    arrays = to_arrays(network) | {
        "mean": whitening.mean,
        **pack_projection(whitening.projection),
        "vectors": whitening.apply(vectors).astype(np.float16),
        "node_ids": training_set.node_ids.astype(np.int32),
    }
    settings = {**facts, "config": asdict(config), "picture_shape": [shape.width, shape.height]}
    return CoarseModel(name, settings, arrays)


class NetworkDescriptorLocalizer:
    """Implement the coarse localizers `cnn-nn` and `vlad-nn`.

    Raises:
        MapError: the model's arrays are inconsistent.
    """

    def __init__(
        self, model: CoarseModel, network: nn.Module, input_config: NetworkInputConfig
    ) -> None:
        self._model, self._input_config = model, input_config
        try:
            self._shape = ImageShape(*read_setting(model, "picture_shape", tuple[int, int]))
            self._predict = Predictor(load_network_weights(network, model.arrays))
        except (KeyError, RuntimeError, ValueError) as error:
            raise MapError(
                f"the map's coarse localizer {model.name!r} is damaged:"
                f" {' '.join(str(error).split())[:200]}"
            ) from error
        mean = model_array(model, "mean", "f", (None,)).astype(np.float32, copy=False)
        projection = unpack_projection(model, len(mean))
        vectors = model_array(model, "vectors", "f", (None, len(projection))).astype(np.float32)
        self._whitening = Whitening(mean, projection)
        node_rows = model_array(model, "node_ids", "iu", (len(vectors),))
        self._index = DescriptorIndex(vectors, node_rows)

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """Rank nodes as in `CoarseLocalizer.rank`. Scores are cosines. The local features are not
        used."""
        return self._index.rank_nodes(self.vectors([image])[0], num_candidates)

    def rank_batch(self, images: Sequence[Image], num_candidates: int) -> list[list[NodeScore]]:
        """Rank nodes for many images, which pass through the network together."""
        return [self._index.rank_nodes(vector, num_candidates) for vector in self.vectors(images)]

    def extend_with_images(
        self, images: Sequence[Image], node_ids: Int[np.ndarray, " n"]
    ) -> CoarseModel:
        """Return the model extended by the descriptors of these images (see `ExtendableLocalizer`).
        The whitening is unchanged."""
        known = self._model.arrays
        parts = [self.vectors(images[k : k + _CHUNK]) for k in range(0, len(images), _CHUNK)]
        dtype = known["vectors"].dtype
        vectors = np.concatenate([known["vectors"], *(part.astype(dtype) for part in parts)])
        all_node_ids = np.concatenate([known["node_ids"], node_ids.astype(known["node_ids"].dtype)])
        return replace(self._model, arrays={**known, "vectors": vectors, "node_ids": all_node_ids})

    def vectors(self, images: Sequence[Image]) -> Float32[np.ndarray, "n d"]:
        """Return the unit vectors of the images.

        Raises:
            MapError: the whitening does not fit the network.
        """
        raw = self._predict(prepare_network_images(images, self._shape, self._input_config))
        if raw.shape[1] != len(self._whitening.mean):
            raise MapError(
                f"the map's coarse localizer {self._model.name!r} is damaged: its whitening is not"
                " that of its network"
            )
        return self._whitening.apply(raw)
