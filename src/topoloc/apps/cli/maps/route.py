"""topoloc route MAP|ATLAS FROM TO."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from topoloc import Atlas, Rigid3, TopoMetricMap, open_place
from topoloc.apps import core_names
from topoloc.apps.cli.output import (
    File,
    UsageError,
    print_line,
    print_table,
    print_warning,
    write_json,
)
from topoloc.apps.cli.tile_option import TileOption, select_world

# of tiles: the keys that name a tile, its map, and world_from_map
Maps = Iterator[tuple[dict[str, Any], TopoMetricMap, Rigid3]]


@dataclass(frozen=True)
class Command:
    """Options of `topoloc route`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """A map file, or an atlas: the tiles of the shared world with most nodes."""
    start: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FROM")]
    """The node where the route begins: its id, of a tile TILE/ID, or a position x,y,z in metres of
    the world, for the nearest node."""
    end: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TO")]
    """The node where it ends, in the same form."""
    tile: TileOption = None
    """Use only this tile of an atlas, in its own world."""
    json: File = None
    """Write the route as JSON to this file (- for standard output)."""

    def run(self) -> int:
        place = open_place(self.map)
        place.select_tiles(self.tile)  # refuses a tile that does not exist
        ids = list[dict[str, Any]]()

        def read(maps: Maps) -> Iterator[tuple[TopoMetricMap, Rigid3]]:
            for of_tile, topomap, world_from_map in maps:
                ids.extend(of_tile | {"node": one.node_id} for one in topomap.summaries)
                yield topomap, world_from_map

        graph = core_names.WalkGraph.from_maps(read(place.visit(self._open_map, self._open_tiles)))
        numbers = {_name(one): number for number, one in enumerate(ids)}
        ends = [_find_node(text, numbers, graph) for text in (self.start, self.end)]
        route = graph.find_route(*ends)
        nodes = [
            ids[number]
            | {
                "metres": round(metres, 3),
                "position": graph.nodes[number].round(4).tolist(),
            }
            for number, metres in zip(route.nodes, route.metres, strict=True)
        ]
        if self.json != "-":
            _print(nodes)
        write_json(self.json, {"metres": nodes[-1]["metres"], "nodes": nodes})
        return 0

    def _open_map(self, path: str) -> Maps:
        with TopoMetricMap.load(Path(path)) as topomap:
            topomap.require_scale("a route")
            yield {}, topomap, Rigid3.identity()

    def _open_tiles(self, atlas: Atlas) -> Maps:
        world = select_world(atlas, self.tile)
        for placed, topomap in world.open_tiles(atlas, print_warning):
            yield {"tile": placed.tile.tile_id}, topomap, placed.world_from_map


def _name(node: dict[str, Any]) -> str:
    return f"{node['tile']}/{node['node']}" if "tile" in node else f"{node['node']}"


def _find_node(text: str, numbers: dict[str, int], graph: core_names.WalkGraph) -> int:
    """Return the number of the node that a text names, or that is nearest to its position."""
    if text in numbers:
        return numbers[text]
    if "," not in text:
        first, *_, last = [*numbers, *numbers]
        raise UsageError(
            f"there is no node {text[:80]!r}: give an id such as {first} or {last}, or a position"
            " x,y,z"
        )
    try:
        position = np.array([float(part) for part in text.split(",")])
    except ValueError:
        position = np.zeros(0)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise UsageError(f"{text[:80]!r} is not a position: give x,y,z in metres, such as 1.5,0,-2")
    return graph.nearest_node(position)


def _print(nodes: list[dict[str, Any]]) -> None:
    print_line(f"{nodes[-1]['metres']:.2f} m from node {_name(nodes[0])} to {_name(nodes[-1])}")
    rows = [
        (f"{one['metres']:.2f}", _name(one), *(f"{value:.2f}" for value in one["position"]))
        for one in nodes
    ]
    print_table([("metres", "node", "x", "y", "z"), *rows])
