"""Move a map to another world: all its poses change, and no distance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.map_facts.map_building import with_map_statistics
from topoloc.mapping.edit import WaitCallback, edit_map
from topoloc.mapping.storage.entries import NodeSummary, PlaceImage, TopoNode, change_each
from topoloc.mapping.topomap import TopoMetricMap

T = TypeVar("T", NodeSummary, PlaceImage)


def move_map(
    path: str | Path, new_from_old: Rigid3, name: str = "move", on_wait: WaitCallback | None = None
) -> None:
    """Move a map file to another world, as one edit of this name. The history keeps the transform
    as x, y, z, qx, qy, qz, qw. Its place on earth stays.

    Raises:
        MapError: the map is missing, damaged, or cannot be written.
    """
    w, *ijk = new_from_old.quat_wxyz().tolist()
    numbers = (*new_from_old.translation.tolist(), *ijk, w)
    text = " ".join(f"{number:.7g}" for number in numbers)
    with edit_map(path, on_wait) as edit:
        moved = with_map_statistics(move_world(edit.topomap, new_from_old))
        edit.commit(moved, name, {"new_from_old": text})


def move_world(topomap: TopoMetricMap, new_from_old: Rigid3) -> TopoMetricMap:
    """Return the map with all its poses in another world. Its statistics are no longer those of
    its nodes."""

    def move(of: T) -> T:
        return replace(of, world_from_cam=new_from_old @ of.world_from_cam)

    def move_node(node: TopoNode) -> TopoNode:
        return replace(node, summary=move(node.summary))

    known, sides = topomap.georeference, topomap.sides
    if known is not None:
        enu_from_new = known.enu_from_world @ new_from_old.inverse()
        known = replace(known, enu_from_world=enu_from_new)
    if sides is not None:  # with the places of their retrieval model
        models = dict(sides.coarse_models)
        for name, model in models.items():
            centres = new_from_old.apply(model.arrays["centres"])
            models[name] = replace(model, arrays={**model.arrays, "centres": centres})
        summaries, nodes = [*map(move, sides.summaries)], change_each(sides.nodes, move_node)
        sides = replace(sides, summaries=summaries, nodes=nodes, coarse_models=models)
    layers = {
        kind: replace(layer, nodes=change_each(layer.nodes, move_node))
        for kind, layer in topomap.layers.items()
    }
    return replace(
        topomap,
        summaries=[*map(move, topomap.summaries)],
        layers=layers,
        place_images=change_each(topomap.place_images, move),
        sides=sides,
        georeference=known,
    )
