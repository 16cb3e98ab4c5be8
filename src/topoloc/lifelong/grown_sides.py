"""Side nodes of what joins a map: the walls along a way that it did not know, for those who come
the other way (`map/side_nodes.py`)."""

from __future__ import annotations

from collections.abc import Sequence

from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.entries import SideNodes, TopoNode
from topoloc.mapping.side_nodes import gather_sides, nodes_with_sides
from topoloc.mapping.topomap import TopoMetricMap


def new_walls(topomap: TopoMetricMap, world_from_cams: Sequence[Rigid3]) -> set[int]:
    """Which of the pictures that are to be nodes show walls that no side node shows. None where the
    map's are described otherwise than pictures are now."""
    config = topomap.config
    if topomap.sides is not None and topomap.sides.kind != config.kind_of_sides:
        return set()
    old = [summary.world_from_cam for summary in topomap.summaries]
    chosen = nodes_with_sides([*old, *world_from_cams], config.nodes, config.sides)
    return {row - len(old) for row in chosen if row >= len(old)}


def grown_sides(topomap: TopoMetricMap, more: Sequence[TopoNode]) -> SideNodes | None:
    """The map's side nodes and more of the same kind, which know their nodes. What ranks them by
    looks is learned anew of all."""
    if not more:
        return topomap.sides
    before, kind = (
        ([], topomap.config.kind_of_sides)
        if topomap.sides is None
        else (list(topomap.sides.nodes), topomap.sides.kind)
    )
    return gather_sides([*before, *more], kind, topomap.config.sides)
