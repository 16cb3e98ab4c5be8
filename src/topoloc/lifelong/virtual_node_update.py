"""Side nodes of what joins a map: the walls along a way that it did not know, for those who come
the other way (`map/side_nodes.py`)."""

from __future__ import annotations

from collections.abc import Sequence

from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.entries import TopoNode, VirtualNodes
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.mapping.virtual_nodes import collect_virtual_nodes, select_virtual_view_nodes


def find_new_virtual_views(topomap: TopoMetricMap, world_from_cams: Sequence[Rigid3]) -> set[int]:
    """Which of the pictures that are to be nodes show walls that no side node shows. None where the
    map's are described otherwise than pictures are now."""
    config = topomap.config
    if topomap.sides is not None and topomap.sides.kind != config.virtual_view_type:
        return set()
    old = [summary.world_from_cam for summary in topomap.summaries]
    chosen = select_virtual_view_nodes([*old, *world_from_cams], config.nodes, config.sides)
    return {row - len(old) for row in chosen if row >= len(old)}


def add_virtual_nodes(topomap: TopoMetricMap, new_nodes: Sequence[TopoNode]) -> VirtualNodes | None:
    """The map's side nodes and more of the same kind, which know their nodes. What ranks them by
    looks is learned anew of all."""
    if not new_nodes:
        return topomap.sides
    before, kind = (
        ([], topomap.config.virtual_view_type)
        if topomap.sides is None
        else (list(topomap.sides.nodes), topomap.sides.kind)
    )
    return collect_virtual_nodes([*before, *new_nodes], kind, topomap.config.sides)
