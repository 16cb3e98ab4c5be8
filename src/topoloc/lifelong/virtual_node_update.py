"""Add virtual nodes for the new content of a map (`mapping/virtual_nodes.py`).

They show the walls along new parts of the trajectory, for queries in the reverse direction.
"""

from __future__ import annotations

from collections.abc import Sequence

from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.storage.entries import TopoNode, VirtualNodes
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.mapping.virtual_nodes import collect_virtual_nodes, select_virtual_view_nodes


def find_new_virtual_views(topomap: TopoMetricMap, world_from_cams: Sequence[Rigid3]) -> set[int]:
    """Return which of the poses need virtual views that no virtual node of the map provides. Return
    an empty set if the map's virtual nodes have another feature type than new images."""
    config = topomap.config
    if topomap.sides is not None and topomap.sides.kind != config.virtual_view_type:
        return set()
    old = [summary.world_from_cam for summary in topomap.summaries]
    chosen = select_virtual_view_nodes([*old, *world_from_cams], config.nodes, config.sides.spacing)
    return {row - len(old) for row in chosen if row >= len(old)}


def add_virtual_nodes(topomap: TopoMetricMap, new_nodes: Sequence[TopoNode]) -> VirtualNodes | None:
    """Return the map's virtual nodes with new ones of the same feature type. The retrieval model is
    learned anew from all of them."""
    if not new_nodes:
        return topomap.sides
    before, kind = (
        ([], topomap.config.virtual_view_type)
        if topomap.sides is None
        else (list(topomap.sides.nodes), topomap.sides.kind)
    )
    return collect_virtual_nodes([*before, *new_nodes], kind)
