"""Widen the cnn-fc of a map that has grown: keep its weights, and add an output for each new
node."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Int

from topoloc.errors import TrainingError
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.cnn_fc import NAME, open_model
from topoloc.retrieval.network_images import BackboneName
from topoloc_training.weights import Weights

MAP = "map"
"""Value instead of a file: start with the weights of the map's own cnn-fc."""
_OUTPUT_LAYERS = ("head.5.", "backbone.classifier.6.")


def weights_of_map(topomap: TopoMetricMap, backbone: BackboneName) -> Weights:
    """Return the network of the map's cnn-fc with an output for each node of the map.

    A new node starts with the output of the known node nearest by Eq. 1, whose images are most
    similar.

    Raises:
        TrainingError: the map has no cnn-fc, or one with another backbone, or one without any
            node of the map.
        MapError: the cnn-fc is damaged.
    """
    model = topomap.first_layer.coarse_models.get(NAME)
    if model is None:
        raise TrainingError(
            f"the map has no {NAME} to begin with; train one without --weights {MAP}"
        )
    open_model(model)  # a damaged one is named
    if (its := model.settings["backbone"]) != backbone:
        raise TrainingError(
            f"the map's {NAME} stands on {its}, not on {backbone}; give --backbone {its}"
        )
    outputs = _output_of_each_node(
        topomap, np.asarray(model.arrays.get("node_ids", np.arange(model.settings["num_nodes"])))
    )
    tensors = {}
    for name, array in model.arrays.items():
        if name.startswith("network."):
            name = name.removeprefix("network.")
            values = torch.from_numpy(np.asarray(array, np.float32))
            tensors[name.removeprefix("backbone.")] = (
                values[torch.from_numpy(outputs)] if name.startswith(_OUTPUT_LAYERS) else values
            )
    origin = model.settings.get("weights") or {"file": "", "sha256": ""}
    return Weights(
        backbone,
        tensors,
        origin["file"],
        origin["sha256"],
        num_outputs=int(model.settings["num_nodes"]),
    )


def _output_of_each_node(
    topomap: TopoMetricMap, node_ids: Int[np.ndarray, " outputs"]
) -> Int[np.ndarray, " nodes"]:
    output_of = {int(node_id): output for output, node_id in enumerate(node_ids)}
    known = [row for row, summary in enumerate(topomap.summaries) if summary.node_id in output_of]
    if not known:
        raise TrainingError(
            f"the map's {NAME} knows none of its nodes; train one without --weights {MAP}"
        )
    poses = NodePoses.from_poses([topomap.summaries[row].world_from_cam for row in known])
    outputs = []
    for summary in topomap.summaries:
        nearest = known[
            int(node_distances(summary.world_from_cam, poses, topomap.config.lambda_rot).argmin())
        ]
        outputs.append(
            output_of.get(summary.node_id, output_of[topomap.summaries[nearest].node_id])
        )
    return np.array(outputs, np.int64)
