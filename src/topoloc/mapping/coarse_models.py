"""Open the coarse localizers of a map. They identify nodes by rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from topoloc.errors import MapError
from topoloc.mapping.session_illumination import find_node_illumination_groups
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import NodeId
from topoloc.retrieval.coarse import (
    CoarseLocalizer,
    CoarseModel,
    DescriptorLocalizer,
    open_coarse_localizer,
)


def open_map_coarse_localizer(
    topomap: TopoMetricMap, name: str, kind: str | None = None
) -> CoarseLocalizer:
    """Open a map's coarse localizer for a feature type, by default the first. It identifies nodes
    by row.

    If the sessions have several illuminations, descriptor localizers reduce the weight of
    differences between these.

    Raises:
        MapError: the map has no localizer of this name, or it is damaged.
    """
    own, first = (topomap.layers[one].coarse_models for one in (kind or topomap.kind, topomap.kind))
    model = own.get(name) or first.get(name)
    if model is None:
        available = ", ".join(first) or "none"
        raise MapError(f"the map has no coarse localizer {name!r} (it has: {available})")
    coarse = open_coarse_localizer(
        node_ids_to_rows(model, [summary.node_id for summary in topomap.summaries])
    )
    lights = (
        find_node_illumination_groups(topomap.summaries, topomap.sessions)
        if len(topomap.sessions) > 1
        else None
    )
    return (
        coarse.suppress_group_differences(lights)
        if isinstance(coarse, DescriptorLocalizer) and lights is not None and lights.any()
        else coarse
    )


def node_ids_to_rows(model: CoarseModel, ids: Sequence[NodeId]) -> CoarseModel:
    """Return a stored model with the ids of its nodes replaced by rows. Descriptors of other nodes
    are removed."""
    known = model.arrays.get("node_ids", _output_node_ids(model))
    if known is None or known.ndim != 1 or known.dtype.kind not in "iu":
        return model  # opening the model reports the error
    if list(ids) == list(range(len(ids))) and (
        len(known) == 0 or 0 <= known.min() <= known.max() < len(ids)
    ):
        return model
    rows: dict[int, int] = {node_id: row for row, node_id in enumerate(ids)}
    of_known = np.array([rows.get(int(node_id), -1) for node_id in known], np.int64)
    if "vectors" not in model.arrays:  # one output per node
        return replace(model, arrays={**model.arrays, "node_ids": of_known})
    kept = of_known >= 0
    if not kept.any():
        raise MapError(f"the map's coarse localizer {model.name!r} knows none of its nodes")
    per_vector = {
        name: model.arrays[name][kept]
        for name in ("vectors", "centres", "cell_vectors")
        if len(model.arrays.get(name, ())) == len(kept)
    }
    return replace(model, arrays={**model.arrays, **per_vector, "node_ids": of_known[kept]})


def _output_node_ids(model: CoarseModel) -> np.ndarray | None:
    """Return the node ids of a model with one output per node, in the order of ids."""
    num_nodes = model.settings.get("num_nodes")
    return (
        np.arange(num_nodes) if isinstance(num_nodes, int) and 0 <= num_nodes <= 1_000_000 else None
    )
