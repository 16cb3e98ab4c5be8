"""Coarse localizers learn the pictures of a new session: k-NN adds vectors, under the vocabulary that is there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from topoloc.features.features import Features
from topoloc.map.topomap import TopoMetricMap
from topoloc.places.coarse import CoarseModel
from topoloc.places.vlad import SurfVlad


@dataclass(frozen=True, eq=False)
class PlaceView:
    """What a mapping picture of this size (pixels) shows, and the id of the node that it belongs to."""

    features: Features
    width: int
    height: int
    node_id: int


def with_place_views(topomap: TopoMetricMap, views: Mapping[str, Sequence[PlaceView]]) -> dict[str, CoarseModel]:
    """The map's coarse localizers, those by local features with these pictures, by their kinds; others know none of them."""
    models = dict(topomap.coarse_models)
    for kind, of_kind in views.items():
        name = SurfVlad.name if kind == topomap.kind else f"{SurfVlad.name}@{kind}"
        if name in models and of_kind:
            grown = SurfVlad.from_model(models[name]).with_images(
                [(view.features, view.width, view.height) for view in of_kind], np.array([view.node_id for view in of_kind])
            )
            models[name] = replace(grown.to_model(), name=name)
    return models
