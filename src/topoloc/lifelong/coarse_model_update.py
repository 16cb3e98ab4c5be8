"""Coarse localizers learn the pictures of a new session: k-NN adds vectors, under the vocabulary or
the network that is there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from topoloc.errors import MissingExtraError
from topoloc.features.features import Features
from topoloc.mapping.topomap import PlaceImage, TopoMetricMap
from topoloc.retrieval.coarse import CoarseModel, ExtendableLocalizer, open_coarse_localizer
from topoloc.retrieval.network_images import decode_stored_image
from topoloc.retrieval.vlad import SurfVlad


@dataclass(frozen=True, eq=False)
class PlaceFeatures:
    """What a mapping picture of this size (pixels) shows, and the id of the node that it belongs
    to."""

    features: Features
    width: int
    height: int
    node_id: int


@dataclass(frozen=True, eq=False)
class UpdatedCoarseModels:
    """A map's coarse localizers with what was added, and the names of those that could not learn
    it."""

    models: dict[str, CoarseModel]
    not_updated: list[str]


def update_coarse_models(
    topomap: TopoMetricMap,
    views: Mapping[str, Sequence[PlaceFeatures]],
    images: Sequence[PlaceImage],
) -> UpdatedCoarseModels:
    """The map's coarse localizers with new places: those by local features learn `views`, by their
    kinds, and those that compare a network's vectors the small pictures `images`. One with an
    output a node (cnn-fc) is to be trained, and without PyTorch no network is asked.

    Raises:
        MapError: a coarse localizer of the map, or a picture, is damaged.
    """
    models, not_updated = dict(topomap.coarse_models), []
    for name, model in models.items():
        of_name, _, of_kind = name.partition("@")
        if of_name == SurfVlad.name:
            models[name] = _add_features(model, views.get(of_kind or topomap.kind, []))
        elif images:
            grown = _add_images(model, images)
            models[name] = grown or model
            not_updated += [] if grown else [name]
    return UpdatedCoarseModels(models, sorted(not_updated))


def _add_features(model: CoarseModel, views: Sequence[PlaceFeatures]) -> CoarseModel:
    if not views:
        return model
    described = [(view.features, view.width, view.height) for view in views]
    grown = SurfVlad.from_model(model).extend_with_features(
        described, np.array([view.node_id for view in views])
    )
    return replace(grown.to_model(), name=model.name)


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
