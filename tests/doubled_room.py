"""Make a map that contains one room twice, for tests of similar places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.mapping.topomap import TopoMetricMap, TopoNode
from topoloc.retrieval.vlad import SurfVlad

ELSEWHERE = Rigid3(exp_so3(np.array([0.0, 0.0, 1.0])), np.array([40.0, -15.0, 0.0]))
"""Pose of the second room in the world of the first."""


def _moved(node: TopoNode, node_id: int) -> TopoNode:
    summary = node.summary
    return replace(
        node,
        summary=replace(
            summary, node_id=node_id, world_from_cam=ELSEWHERE @ summary.world_from_cam
        ),
    )


def twice(topomap: TopoMetricMap, share_alike: float = 1.0) -> TopoMetricMap:
    """Return a map with a second copy of the room elsewhere. Only this share of its points
    looks the same."""
    num_nodes, rng = len(topomap.nodes), np.random.default_rng(0)
    copies = []
    for node in topomap.nodes:
        descriptors = node.features.descriptors.copy()
        other = rng.random(len(descriptors)) >= share_alike
        descriptors[other] = rng.normal(size=(np.count_nonzero(other), descriptors.shape[1]))
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        changed = replace(node, features=replace(node.features, descriptors=descriptors))
        copies.append(_moved(changed, num_nodes + node.summary.node_id))
    nodes = [*topomap.nodes, *copies]
    model = topomap.first_layer.coarse_models[SurfVlad.name]
    ids = model.arrays["node_ids"]
    arrays = dict(model.arrays) | {
        "vectors": np.concatenate([model.arrays["vectors"]] * 2),
        "node_ids": np.concatenate([ids, ids + num_nodes]).astype(ids.dtype),
    }
    coarse = {SurfVlad.name: replace(model, arrays=arrays)}
    return replace(
        topomap.with_first_layer(nodes=nodes, coarse_models=coarse),
        summaries=[node.summary for node in nodes],
        edges=[],
    )
