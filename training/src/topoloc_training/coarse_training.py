"""Teaching a map a learned coarse localizer, from the mapping images that it keeps: no recording is
needed."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from topoloc.bounds import check_bounds
from topoloc.errors import EmptyMapError, TrainingError
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import CoarseModel
from topoloc_training.classifier_config import BackboneName, CnnFcConfig, CnnNnConfig, VladNnConfig
from topoloc_training.training_set import Progress, TrainingSet


@dataclass(frozen=True)
class CoarseTrainingConfig:
    """Settings of each learned coarse localizer."""

    cnn_fc: CnnFcConfig = field(default_factory=CnnFcConfig)
    cnn_nn: CnnNnConfig = field(default_factory=CnnNnConfig)
    vlad_nn: VladNnConfig = field(default_factory=VladNnConfig)


def train_coarse(
    topomap: TopoMetricMap,
    name: str,
    backbone: BackboneName,
    weights: str | None,
    config: CoarseTrainingConfig | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
) -> CoarseModel:
    """Train the coarse localizer `name` (cnn-fc, cnn-nn or vlad-nn) for this map.

    Args:
        weights: a file, ``scratch``, ``map`` for the weights of the map's own cnn-fc, or None for
            the published weights of the backbone.
        checkpoint: cnn-fc writes its state here after each epoch, and resumes from it if it exists.

    Raises:
        ConfigError: a value of `config` is out of its bounds.
        WeightsError: see `find_weights`.
        TrainingError: `name` does not learn, or the training failed.
        EmptyMapError, MapError: the map holds no images, or is damaged.
    """
    if name == "surf-vlad":
        raise TrainingError(
            "surf-vlad learns from the recording's local features: `topoloc build` makes it"
        )
    from topoloc_training.weights import MAP, find_weights  # PyTorch takes its time

    if weights == MAP and name != "cnn-fc":
        raise TrainingError(
            f"{name} learns new pictures as they join the map; only cnn-fc begins with what it"
            " knows"
        )
    module = importlib.import_module(f"topoloc_training.{name.replace('-', '_')}")
    config = config or CoarseTrainingConfig()
    check_bounds(config)
    of_name = {"cnn-fc": config.cnn_fc, "cnn-nn": config.cnn_nn, "vlad-nn": config.vlad_nn}[name]
    found = (
        module.weights_of_map(topomap, backbone)
        if weights == MAP
        else find_weights(backbone, weights)
    )
    arguments = (
        training_set_of(topomap),
        backbone,
        found,
        of_name,
        progress or (lambda stage, done, total: None),
    )
    model = module.train(*arguments, checkpoint) if name == "cnn-fc" else module.train(*arguments)
    return in_ids(model, [summary.node_id for summary in topomap.summaries])


def in_ids(model: CoarseModel, ids: Sequence[int]) -> CoarseModel:
    """The inverse of `topomap.node_ids_to_rows`: a model that was made of the map's rows, as the
    map keeps it."""
    if list(ids) == list(range(len(ids))):
        return model
    rows = model.arrays.get("node_ids", np.arange(len(ids)))
    return replace(model, arrays={**model.arrays, "node_ids": np.asarray(ids, np.int64)[rows]})


def training_set_of(topomap: TopoMetricMap) -> TrainingSet:
    """The map's images with their distances to its nodes. Raises EmptyMapError."""
    images = list(topomap.place_images)
    if not images or len(topomap.summaries) == 0:
        raise EmptyMapError("the map holds no mapping images to learn from")
    nodes = NodePoses.from_poses([summary.world_from_cam for summary in topomap.summaries])
    lambda_rot, d_thresh = topomap.config.lambda_rot, topomap.config.d_thresh
    return TrainingSet(
        jpegs=[image.jpeg for image in images],
        world_from_cams=[image.world_from_cam for image in images],
        node_ids=np.array([topomap.row_of(image.node_id) for image in images], np.int64),
        node_distances=np.stack(
            [node_distances(image.world_from_cam, nodes, lambda_rot) for image in images]
        ),
        d_thresh=d_thresh,
        lambda_rot=lambda_rot,
    )
