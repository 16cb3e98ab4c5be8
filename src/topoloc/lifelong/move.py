"""Move a map to another world: all its poses change, and no distance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.map_facts.map_building import with_map_statistics
from topoloc.mapping.edit import WaitCallback, edit_map
from topoloc.mapping.storage.entries import NodeSummary, TopoNode, VirtualNodes
from topoloc.mapping.topomap import Layer, TopoMetricMap
from topoloc.node_ids import LazySequence


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

    def move_summary(of: NodeSummary) -> NodeSummary:
        return replace(of, world_from_cam=new_from_old @ of.world_from_cam)

    def move_nodes(nodes: Sequence[TopoNode]) -> Sequence[TopoNode]:
        def read(row: int) -> TopoNode:
            return replace(nodes[row], summary=move_summary(nodes[row].summary))

        return LazySequence(partial(len, nodes), read)

    def move_layer(layer: Layer) -> Layer:
        return replace(layer, nodes=move_nodes(layer.nodes))

    images = topomap.place_images
    known, sides = topomap.georeference, topomap.sides
    if known is not None:
        enu_from_new = known.enu_from_world @ new_from_old.inverse()
        known = replace(known, enu_from_world=enu_from_new)
    return replace(
        topomap,
        summaries=[*map(move_summary, topomap.summaries)],
        layers={kind: move_layer(layer) for kind, layer in topomap.layers.items()},
        place_images=LazySequence(
            partial(len, images),
            lambda row: replace(
                images[row], world_from_cam=new_from_old @ images[row].world_from_cam
            ),
        ),
        sides=None if sides is None else _move_sides(sides, new_from_old, move_summary, move_nodes),
        georeference=known,
    )


def _move_sides(
    sides: VirtualNodes,
    new_from_old: Rigid3,
    move_summary: Callable[[NodeSummary], NodeSummary],
    move_nodes: Callable[[Sequence[TopoNode]], Sequence[TopoNode]],
) -> VirtualNodes:
    """Return the virtual nodes in another world, with the places of their retrieval model."""
    models = {
        name: replace(
            model, arrays={**model.arrays, "centres": new_from_old.apply(model.arrays["centres"])}
        )
        for name, model in sides.coarse_models.items()
    }
    summaries = [*map(move_summary, sides.summaries)]
    return replace(sides, summaries=summaries, nodes=move_nodes(sides.nodes), coarse_models=models)
