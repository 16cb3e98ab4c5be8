"""Compute vectors of all mapping images and their whitening, for cnn-nn and vlad-nn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from torch import nn

from topoloc.retrieval.coarse import CoarseModel
from topoloc.retrieval.descriptor_index import learn_whitening, pack_projection
from topoloc.retrieval.inference import Predictor
from topoloc.retrieval.network_images import prepare_network_images
from topoloc_training.classifier_config import CnnNnConfig, VladNnConfig
from topoloc_training.stored_weights import rounded_to_half, to_arrays
from topoloc_training.training_set import Progress, TrainingSet, decode_pictures

_CHUNK = 64


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
