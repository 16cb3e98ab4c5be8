"""Find the junctions of maps, and the shortest route from one node to another.

The stored edges are the transitions of the camera between nodes. Two walks that cross have no
common edge, because Eq. 1 counts rotation: their nodes at the crossing look in different
directions. Here places within D_thresh of each other are neighbours whichever way the camera looks.
That is Eq. 1 with lambda 0, since a robot that turns on the spot does not travel. Edges are
traversed in both directions.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from topoloc.errors import MapError
from topoloc.geometry.rigid import Rigid3

if TYPE_CHECKING:
    from topoloc.mapping.topomap import TopoMetricMap

_PLACES_PER_REACH = 4
_MAX_STEPS = 100  # places along one edge; longer edges are gaps of a recording
_INNER, _OUTER = 3.0, 6.0
"""Radii of the ring in which directions of travel are counted, in reaches. A reach is D_thresh, by
default 15 % of the scene's median depth. A branch that ends within the ring does not count."""
_MIN_COS = np.cos(np.deg2rad(40.0))
"""Directions that differ by less than 40 degrees are one. Two lanes that part to less than four
reaches are one direction, and walks that cross at 45 degrees make a junction."""


@dataclass(frozen=True, eq=False)
class Junction:
    """Hold a place from which at least three separate directions of travel lead away.

    `node` is the number of the nearest node in the graph. `position` is in metres of the world.
    `num_ways` is the number of directions.
    """

    node: int
    position: Float[np.ndarray, "3"]
    num_ways: int


@dataclass(frozen=True, eq=False)
class Route:
    """Hold a shortest route: the numbers of its nodes, and the metres travelled to each."""

    nodes: list[int]
    metres: list[float]


@dataclass(frozen=True, eq=False)
class WalkGraph:
    """Hold the places along the edges of maps, with the metres between neighbours.

    Node k is at `nodes[k]` (metres). The nodes of all maps are numbered in their order. Places are
    about a quarter of a reach apart, also between nodes, so that the crossing of two edges is found
    where it is. Place i is at `places[i]`: at its first node, if it has one. `reach` (metres) is
    the D_thresh of its map. Places within it are neighbours. Node k is at place `place_of[k]`.
    `links[i]` holds the metres from place i to each of its neighbours.
    """

    nodes: Float[np.ndarray, "n 3"]
    place_of: Int[np.ndarray, " n"]
    places: Float[np.ndarray, "p 3"]
    reach: Float[np.ndarray, " p"]
    links: list[dict[int, float]]

    @staticmethod
    def from_maps(maps: Iterable[tuple[TopoMetricMap, Rigid3]]) -> WalkGraph:
        """Return the graph of maps, each with world_from_map. Raises MapError: no map has a
        node."""
        centres, reaches, edges, first = [np.zeros((0, 3))], [np.zeros(0)], [], 0
        for topomap, world_from_map in maps:
            rows = [topomap.rows_of((edge.source_id, edge.target_id)) for edge in topomap.edges]
            edges.append(np.array(rows, np.int64).reshape(-1, 2) + first)
            centres.append(world_from_map.apply(topomap.node_poses.centres))
            reaches.append(np.full(len(centres[-1]), _find_reach(topomap, edges[-1] - first)))
            first += len(centres[-1])
        if first == 0:
            raise MapError("the map has no nodes")
        return _join_places(*map(np.concatenate, (centres, reaches, edges)))

    def nearest_node(self, position: Float[np.ndarray, "3"]) -> int:
        """Return the number of the node nearest to a position (metres)."""
        return int(np.linalg.norm(self.nodes - position, axis=1).argmin())

    def find_route(self, start: int, end: int) -> Route:
        """Return the shortest route between two nodes, by their numbers, with the nodes nearest to
        it. Raises MapError: no walk connects them."""
        first, last = self.place_of[[start, end]].tolist()
        metres, before = self._find_ways_from(first)
        if math.isinf(metres[last]):
            raise MapError(
                "no walk connects the two nodes; a recording from one to the other does"
                " (topoloc update)"
            )
        path = [last]
        while path[-1] != first:
            path.append(before[path[-1]])
        path.reverse()
        offsets = np.linalg.norm(self.nodes[[start, end]] - self.places[[first, last]], axis=1)
        nodes, along = [start], [0.0]
        for place in path:
            if (node := self.nearest_node(self.places[place])) not in (start, end, nodes[-1]):
                nodes.append(node)
                along.append(float(offsets[0] + metres[place]))
        return Route([*nodes, end], [*along, float(offsets.sum() + metres[last])])

    def find_junctions(self) -> list[Junction]:
        """Return the junctions, in the order of their nodes."""
        grid = _Grid(self.places, _OUTER * float(self.reach.max()))
        found = [self._find_ways(grid, place) for place in range(len(self.places))]
        junctions = list[Junction]()
        for part in self._find_parts(row for row, ends in enumerate(found) if len(ends) > 2):
            members = np.array(part)
            offsets = np.linalg.norm(self.places[members] - self.places[members].mean(0), axis=1)
            num_ways = np.array([len(found[row]) for row in part])
            chosen = part[int(np.lexsort((offsets, -num_ways))[0])]
            # The sum of the distances to the ends of its branches is least at the junction.
            sums = np.sum([self._find_ways_from(end)[0] for end in found[chosen]], axis=0)
            position = self.places[members[sums[members].argmin()]]
            junctions.append(Junction(self.nearest_node(position), position, int(num_ways.max())))
        return sorted(junctions, key=lambda junction: junction.node)

    def _find_ways(self, grid: _Grid, place: int) -> list[int]:
        """Return a far place on each of the directions of travel that lead away from a place."""
        reach, centre = float(self.reach[place]), self.places[place]
        near = grid.find_near(centre, _OUTER * reach)
        offsets = self.places[near] - centre
        metres = np.linalg.norm(offsets, axis=1)
        directions = offsets / np.maximum(metres, 1e-12)[:, None]
        if len(_separate(directions[metres > (_OUTER - 1) * reach])) < 3:
            return []
        metres_of = dict(zip(near, metres.tolist(), strict=True))
        here = next(part for part in self._find_parts(near) if place in part)
        ends = list[int]()
        for arm in self._find_parts(row for row in here if metres_of[row] > _INNER * reach):
            end = max(arm, key=lambda row: metres_of[row])
            if metres_of[end] > (_OUTER - 0.5) * reach:
                ends.append(end)
        away = self.places[ends] - centre
        return [ends[k] for k in _separate(away / np.linalg.norm(away, axis=1)[:, None])]

    def _find_ways_from(self, start: int) -> tuple[list[float], list[int]]:
        """Return the metres from a place to each one, infinite without a way, and the place before
        each one (Dijkstra)."""
        metres, before = [math.inf] * len(self.places), [start] * len(self.places)
        metres[start], queue = 0.0, [(0.0, start)]
        while queue:
            so_far, place = heappop(queue)
            if so_far > metres[place]:
                continue
            for other, step in self.links[place].items():
                if so_far + step < metres[other]:
                    metres[other], before[other] = so_far + step, place
                    heappush(queue, (metres[other], other))
        return metres, before

    def _find_parts(self, places: Iterable[int]) -> list[list[int]]:
        """Return the parts of some places that are linked."""
        left, parts = dict.fromkeys(places), list[list[int]]()
        while left:
            part = [left.popitem()[0]]
            for place in part:
                linked = [other for other in self.links[place] if other in left]
                for other in linked:
                    del left[other]
                part += linked
            parts.append(sorted(part))
        return parts


class _Grid:
    """Find points within a distance, up to the side of a cell (metres)."""

    def __init__(self, points: Float[np.ndarray, "p 3"], side: float) -> None:
        self._points, self._side = points, side
        self._rows: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for row, cell in enumerate(np.floor(points / side).astype(np.int64).tolist()):
            self._rows[tuple(cell)].append(row)

    def find_near(self, centre: Float[np.ndarray, "3"], metres: float) -> list[int]:
        """Return the rows of the points within a distance of a position, in order."""
        cell, rows = np.floor(centre / self._side).astype(np.int64).tolist(), list[int]()
        for steps in product((-1, 0, 1), repeat=3):
            rows += self._rows.get(tuple(map(sum, zip(cell, steps, strict=True))), ())
        rows.sort()
        is_near = np.linalg.norm(self._points[rows] - centre, axis=1) <= metres
        return np.array(rows, np.int64)[is_near].tolist()


def describe_junctions(topomap: TopoMetricMap) -> list[dict[str, Any]]:
    """Return the junctions of a map as JSON: the nearest node's id, position (metres, world) and
    number of directions. A map without nodes has none."""
    if len(topomap.summaries) == 0:
        return []
    found = WalkGraph.from_maps([(topomap, Rigid3.identity())]).find_junctions()
    return [
        {
            "node": topomap.summaries[junction.node].node_id,
            "position": junction.position.round(4).tolist(),
            "ways": junction.num_ways,
        }
        for junction in found
    ]


def _separate(directions: Float[np.ndarray, "n 3"]) -> list[int]:
    """Return rows of directions that are separate, each the farthest from those before."""
    chosen, cosines = list[int](), np.full(len(directions), -1.0)
    while len(directions) and (not chosen or cosines.min() < _MIN_COS):
        chosen.append(int(cosines.argmin()))
        cosines = np.maximum(cosines, directions @ directions[chosen[-1]])
    return chosen


def _find_reach(topomap: TopoMetricMap, edges: Int[np.ndarray, "m 2"]) -> float:
    """Return D_thresh, or the median length of the edges if the map's file does not name it."""
    if topomap.config.nodes.d_thresh is not None:
        return topomap.config.nodes.d_thresh
    steps = np.diff(topomap.node_poses.centres[edges], axis=1)
    return max(float(np.median(np.linalg.norm(steps, axis=2))), 1e-3) if len(edges) else 1.0


def _join_places(
    nodes: Float[np.ndarray, "n 3"], reaches: Float[np.ndarray, " n"], edges: Int[np.ndarray, "m 2"]
) -> WalkGraph:
    """Return the graph of nodes with their reaches (metres), and the edges between them."""
    start, end = np.unique(np.sort(edges, axis=1), axis=0).T
    lengths = np.linalg.norm(nodes[end] - nodes[start], axis=1)
    steps = np.ceil(_PLACES_PER_REACH * lengths / reaches[start]).astype(np.int64)
    counts = np.clip(steps, 1, _MAX_STEPS) + 1
    edge = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (step / (counts - 1)[edge])[:, None]
    between = (1.0 - share) * nodes[start[edge]] + share * nodes[end[edge]]
    points, reach = (
        np.concatenate([nodes, between]),
        np.concatenate([reaches, reaches[start[edge]]]),
    )
    cells = np.column_stack([np.floor(_PLACES_PER_REACH * points / reach[:, None]), reach])
    _, chosen, place_of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    places, reach = points[chosen], reach[chosen]
    walked = place_of[len(nodes) :]
    walked = np.column_stack([walked[:-1], walked[1:]])[edge[:-1] == edge[1:]]
    links: list[dict[int, float]] = [{} for _ in places]
    for one, other in walked.tolist():
        if one != other:
            links[one][other] = links[other][one] = math.dist(places[one], places[other])
    grid = _Grid(places, float(reach.max()))
    for one, centre in enumerate(places):
        for other in grid.find_near(centre, float(reach[one])):
            if one != other:
                links[one][other] = links[other][one] = math.dist(centre, places[other])
    return WalkGraph(nodes, place_of[: len(nodes)], places, reach, links)
