"""Open the coarse localizers of a map. They identify nodes by rows. They reduce the differences
between sessions of several illuminations, which have user-given names or are measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, replace

import numpy as np
from jaxtyping import Int

from topoloc.errors import MapError
from topoloc.mapping.storage.entries import Illumination, NodeSummary, Session
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
    by row. If the sessions have several illuminations, descriptor localizers reduce the weight of
    differences between these.

    Raises MapError if the map has no localizer of this name, or it is damaged.
    """
    own, first = (topomap.layers[one].coarse_models for one in (kind or topomap.kind, topomap.kind))
    model = own.get(name) or first.get(name)
    if model is None:
        available = ", ".join(first) or "none"
        raise MapError(f"the map has no coarse localizer {name!r} (it has: {available})")
    coarse = open_coarse_localizer(
        node_ids_to_rows(model, [summary.node_id for summary in topomap.summaries])
    )
    if len(topomap.sessions) > 1 and isinstance(coarse, DescriptorLocalizer):
        lights = find_node_illumination_groups(topomap.summaries, topomap.sessions)
        return coarse.suppress_group_differences(lights) if lights.any() else coarse
    return coarse


def node_ids_to_rows(model: CoarseModel, ids: Sequence[NodeId]) -> CoarseModel:
    """Return a stored model with the ids of its nodes replaced by rows. Descriptors of other nodes
    are removed."""
    known, num_nodes = model.arrays.get("node_ids"), model.settings.get("num_nodes")
    if known is None and isinstance(num_nodes, int) and 0 <= num_nodes <= 1_000_000:
        known = np.arange(num_nodes)  # one output per node, in the order of ids
    if known is None or known.ndim != 1 or known.dtype.kind not in "iu":
        return model  # opening the model reports the error
    is_numbered = list(ids) == list(range(len(ids)))
    if is_numbered and (len(known) == 0 or 0 <= known.min() <= known.max() < len(ids)):
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
        if np.shape(model.arrays.get(name, ()))[:1] == kept.shape
    }
    return replace(model, arrays={**model.arrays, **per_vector, "node_ids": of_known[kept]})


def compute_illumination_distance(a: Illumination, b: Illumination) -> float:
    """Return the distance between two illuminations: grey level, contrast, shares of dark and
    bright pixels, and colours with half the weight."""
    weights = np.array([1.0, 1.0, 1.0, 1.0, 0.5, 0.5])
    return float(np.linalg.norm(weights * np.subtract(astuple(a), astuple(b))))


def group_by_illumination(
    sessions: Sequence[Session], weights: Mapping[int, int]
) -> dict[int, int]:
    """Return the illumination group of each session by its id. Group 0 is the illumination of the
    session with the largest weight.

    Sessions are processed by decreasing weight (`weights` by id). Each joins the first group with
    similar illumination. If both have names, the names decide. A session without any information
    joins group 0.
    """
    leaders, groups = list[Session](), dict[int, int]()
    for session in sorted(sessions, key=lambda one: -weights.get(one.session_id, 0)):
        same = (k for k, leader in enumerate(leaders) if _is_same_illumination(session, leader))
        is_known = session.light is not None or session.light_name is not None
        group = next(same, len(leaders) if is_known or not leaders else 0)
        if group == len(leaders):
            leaders.append(session)
        groups[session.session_id] = group
    return groups


def find_node_illumination_groups(
    summaries: Sequence[NodeSummary], sessions: Sequence[Session]
) -> Int[np.ndarray, " nodes"]:
    """Return the illumination group (`group_by_illumination`) of each node's session. It is 0 if
    the session is unknown."""
    ids, counts = np.unique([summary.session_id for summary in summaries], return_counts=True)
    groups = group_by_illumination(sessions, dict(zip(ids.tolist(), counts.tolist(), strict=True)))
    return np.array([groups.get(summary.session_id, 0) for summary in summaries], np.int64)


def _is_same_illumination(a: Session, b: Session) -> bool:
    if a.light_name is not None and b.light_name is not None:
        return a.light_name == b.light_name
    # Sessions closer than this have the same illumination. Two walks of one path by day
    # differ by 0.02, two of a lab by 0.04, floors of a tower by up to 0.06. Day and night of
    # that path differ by 0.17.
    max_distance = 0.1
    return (
        a.light is not None
        and b.light is not None
        and compute_illumination_distance(a.light, b.light) < max_distance
    )
