"""Add the images of a new session to a map's coarse localizers.

k-NN localizers receive new vectors. Their vocabulary or network stays the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from topoloc.errors import MissingExtraError
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.mapping.topomap import Layer, PlaceImage, TopoMetricMap
from topoloc.node_ids import NodeId
from topoloc.retrieval.coarse import CoarseModel, ExtendableLocalizer, open_coarse_localizer
from topoloc.retrieval.network_images import decode_stored_image
from topoloc.retrieval.vlad import SurfVlad

DescribedPlace = tuple[Features, Camera, NodeId]
"""The local features of a mapping image, its camera model, and the id of its node."""


def update_coarse_models(
    topomap: TopoMetricMap,
    views: Mapping[str, Sequence[DescribedPlace]],
    images: Sequence[PlaceImage],
) -> tuple[TopoMetricMap, list[str]]:
    """Return the map with new places added to its coarse localizers, and the names of those that
    were not updated.

    Localizers that use local features are extended with `views`. Localizers that compare network
    descriptors are extended with `images`. A localizer with one output per node (cnn-fc) cannot be
    extended, because it would need training. No network localizer is extended if PyTorch is
    missing.

    Raises:
        MapError: a coarse localizer of the map, or an image, is damaged.
    """
    layers, not_updated = dict[str, Layer](), list[str]()
    for kind, layer in topomap.layers.items():
        models = dict(layer.coarse_models)
        for name, model in models.items():
            if name == SurfVlad.name:
                models[name] = _add_features(model, views.get(kind, []))
            elif images:
                extended = _add_images(model, images)
                models[name] = extended or model
                not_updated += [] if extended else [name]
        layers[kind] = replace(layer, coarse_models=models)
    return replace(topomap, layers=layers), sorted(not_updated)


def _add_features(model: CoarseModel, views: Sequence[DescribedPlace]) -> CoarseModel:
    if not views:
        return model
    described = [(features, camera.width, camera.height) for features, camera, _ in views]
    node_ids = np.array([node_id for *_, node_id in views])
    return SurfVlad.from_model(model).extend_with_features(described, node_ids).to_model()


def _add_images(model: CoarseModel, images: Sequence[PlaceImage]) -> CoarseModel | None:
    try:
        localizer = open_coarse_localizer(model)
    except MissingExtraError:
        return None
    if not isinstance(localizer, ExtendableLocalizer):
        return None
    return localizer.extend_with_images(
        [decode_stored_image(image.jpeg) for image in images],
        np.array([image.node_id for image in images]),
    )
