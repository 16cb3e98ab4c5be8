"""Find the junctions of maps, and the shortest route from one node to another.

The stored edges are the transitions of the camera between nodes. Two walks that cross have no
common edge, because Eq. 1 counts rotation: their nodes at the crossing look in different
directions. Here places within D_thresh of each other are neighbours whichever way the camera looks.
That is Eq. 1 with lambda 0, since a robot that turns on the spot does not travel. Edges are
traversed in both directions.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

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
    """

    nodes: Float[np.ndarray, "n 3"]
    place_of: Int[np.ndarray, " n"]
    places: Float[np.ndarray, "p 3"]
    reach: Float[np.ndarray, " p"]
    metres: csr_array

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
        metres, before = dijkstra(
            self.metres, directed=False, indices=first, return_predecessors=True
        )
        if not np.isfinite(metres[last]):
            raise MapError(
                "no walk connects the two nodes; a recording from one to the other does"
                " (topoloc update)"
            )
        path = [last]
        while path[-1] != first:
            path.append(int(before[path[-1]]))
        path.reverse()
        nearest = np.atleast_1d(KDTree(self.nodes).query(self.places[path])[1])
        offsets = np.linalg.norm(self.nodes[[start, end]] - self.places[[first, last]], axis=1)
        nodes, along = [start], [0.0]
        for place, node in zip(path, nearest.tolist(), strict=True):
            if node not in (start, end, nodes[-1]):
                nodes.append(node)
                along.append(float(offsets[0] + metres[place]))
        return Route([*nodes, end], [*along, float(offsets.sum() + metres[last])])

    def find_junctions(self) -> list[Junction]:
        """Return the junctions, in the order of their nodes."""
        tree = KDTree(self.places)
        found = [self._find_ways(tree, place) for place in range(len(self.places))]
        rows = np.flatnonzero([len(ends) > 2 for ends in found])
        count, labels = connected_components(self.metres[rows][:, rows], directed=False)
        junctions = list[Junction]()
        for label in range(count):
            members = rows[labels == label]
            offsets = np.linalg.norm(self.places[members] - self.places[members].mean(0), axis=1)
            num_ways = np.array([len(found[row]) for row in members])
            chosen = members[np.lexsort((offsets, -num_ways))[0]]
            # The sum of the distances to the ends of its branches is least at the junction.
            sums = dijkstra(self.metres, directed=False, indices=found[chosen]).sum(axis=0)
            position = self.places[members[sums[members].argmin()]]
            junctions.append(Junction(self.nearest_node(position), position, int(num_ways.max())))
        return sorted(junctions, key=lambda junction: junction.node)

    def _find_ways(self, tree: KDTree, place: int) -> list[int]:
        """Return a far place on each of the directions of travel that lead away from a place."""
        reach, centre = self.reach[place], self.places[place]
        near = np.array(tree.query_ball_point(centre, _OUTER * reach), np.int64)
        metres = np.linalg.norm(self.places[near] - centre, axis=1)
        is_ring = metres > _INNER * reach
        directions = (self.places[near] - centre) / np.maximum(metres, 1e-12)[:, None]
        if len(_separate(directions[metres > (_OUTER - 1) * reach])) < 3:
            return []
        links = self.metres[near][:, near]
        _, parts = connected_components(links, directed=False)
        is_ring &= parts == parts[metres.argmin()]
        ring = np.flatnonzero(is_ring)
        _, arms = connected_components(links[ring][:, ring], directed=False)
        ends = list[int]()
        for arm in np.unique(arms):
            members = ring[arms == arm]
            if metres[members].max() > (_OUTER - 0.5) * reach:
                ends.append(int(members[metres[members].argmax()]))
        return near[[ends[k] for k in _separate(directions[ends])]].tolist()


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
    near = KDTree(places).query_pairs(reach.max(), output_type="ndarray")
    limits = reach[near].max(axis=1)
    near = near[np.linalg.norm(places[near[:, 1]] - places[near[:, 0]], axis=1) <= limits]
    pairs = np.unique(np.sort(np.concatenate([walked, near]), axis=1), axis=0)
    one, other = pairs[pairs[:, 0] < pairs[:, 1]].T
    metres = np.linalg.norm(places[other] - places[one], axis=1)
    size = (len(places), len(places))
    return WalkGraph(
        nodes, place_of[: len(nodes)], places, reach, csr_array((metres, (one, other)), shape=size)
    )
