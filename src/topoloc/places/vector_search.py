"""What cnn-nn and vlad-nn share: a network turns a picture into a vector; the nodes of the nearest mapping images answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from jaxtyping import Float32
from torch import nn

from topoloc.errors import MapError
from topoloc.features.features import Features
from topoloc.places.classifier_config import CnnNnConfig, PictureConfig, VladNnConfig
from topoloc.places.coarse import CoarseModel, Image, NodeScore, model_array, setting
from topoloc.places.inference import Predictor, from_arrays, rounded_to_half, to_arrays
from topoloc.places.neighbours import PlaceIndex, Whitening, learn_whitening
from topoloc.places.training_set import PictureShape, Progress, TrainingSet, decode_pictures, network_pictures

_CHUNK = 64


def fit_vectors(
    name: str,
    network: nn.Module,
    training_set: TrainingSet,
    config: CnnNnConfig | VladNnConfig,
    facts: Mapping[str, Any],
    progress: Progress,
) -> CoarseModel:
    """The model of a network: vectors of all mapping images and their whitening; `facts` go with its settings.

    The network's weights are rounded to half floats, as the map keeps them.

    Raises:
        MapError: a mapping image is damaged.
    """
    pictures, shape = decode_pictures(training_set)
    predict = Predictor(rounded_to_half(network))
    raw = []
    for start in range(0, len(pictures), _CHUNK):
        raw.append(predict(network_pictures(pictures[start : start + _CHUNK], shape, config.picture)))
        progress(f"{name}: vectors", min(start + _CHUNK, len(pictures)), len(pictures))
    vectors = np.concatenate(raw)
    whitening = learn_whitening(vectors, config.dimension)
    whitening = Whitening(whitening.mean, whitening.projection.astype(np.float16).astype(np.float32))
    arrays = to_arrays(network) | {"mean": whitening.mean, "projection": whitening.projection.astype(np.float16)}
    arrays |= {"vectors": whitening.apply(vectors).astype(np.float16), "node_ids": training_set.node_ids.astype(np.int32)}
    settings = {**facts, "config": asdict(config), "picture_shape": [shape.width, shape.height]}
    return CoarseModel(name, settings, arrays)


class VectorSearch:
    """The coarse localizers `cnn-nn` and `vlad-nn`.

    Raises:
        MapError: the model's arrays do not belong together.
    """

    def __init__(self, model: CoarseModel, network: nn.Module, picture: PictureConfig) -> None:
        try:
            self._picture, self._shape = picture, PictureShape(*setting(model, "picture_shape", tuple[int, int]))
            self._predict = Predictor(from_arrays(network, model.arrays))
        except (KeyError, RuntimeError, ValueError) as error:
            raise MapError(f"the map's coarse localizer {model.name!r} is damaged: {' '.join(str(error).split())[:200]}") from error
        self._name, mean = model.name, model_array(model, "mean", "f", (None,)).astype(np.float32, copy=False)
        projection = model_array(model, "projection", "f", (None, len(mean))).astype(np.float32)
        vectors = model_array(model, "vectors", "f", (None, len(projection))).astype(np.float32)
        self._whitening = Whitening(mean, projection)
        self._index = PlaceIndex(vectors, model_array(model, "node_ids", "iu", (len(vectors),)))

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """See `CoarseLocalizer.rank`; scores are cosines. The local features are not looked at."""
        return self._index.rank_nodes(self.vectors([image])[0], num_candidates)

    def rank_batch(self, images: Sequence[Image], num_candidates: int) -> list[list[NodeScore]]:
        """`rank` of many images, which go through the network together."""
        return [self._index.rank_nodes(vector, num_candidates) for vector in self.vectors(images)]

    def vectors(self, images: Sequence[Image]) -> Float32[np.ndarray, "n d"]:
        """The images' unit vectors."""
        raw = self._predict(network_pictures(images, self._shape, self._picture))
        if raw.shape[1] != len(self._whitening.mean):
            raise MapError(f"the map's coarse localizer {self._name!r} is damaged: its whitening is not that of its network")
        return self._whitening.apply(raw)
