"""Test that junctions are found where walks branch or cross and nowhere else, and that routes are
as short as the walks allow."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from topoloc.errors import MapError
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.mapping.junctions import WalkGraph, describe_junctions
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import NodeId
from walked_maps import D_THRESH, Corners, map_of_walks, walk_along

SQUARE = [(0.0, 0.0), (12.0, 0.0), (12.0, 12.0), (0.0, 12.0), (0.0, 0.0)]
MIDDLE = [(6.0, 0.0), (6.0, 12.0)]


def graph_of(topomap: TopoMetricMap) -> WalkGraph:
    return WalkGraph.from_maps([(topomap, Rigid3.identity())])


def shifted(corners: Corners, metres: float) -> Corners:
    """Return a lap a little inside of another one."""
    centre = np.mean(corners[:-1], axis=0)
    moved = np.array(corners) - metres * np.sign(np.array(corners) - centre)
    return [(float(x), float(y)) for x, y in moved]


@pytest.mark.parametrize(
    ("walks", "expected"),
    [
        ([[(-8.0, 0.0), (8.0, 0.0)], [(1.0, -8.0), (1.0, 8.0)]], [(1.0, 0.0)]),
        ([[(-8.0, 0.0), (8.0, 0.0)], [(-6.0, -6.0), (6.0, 6.0)]], [(0.0, 0.0)]),
        ([[(-8.0, 0.0), (8.0, 0.0)], [(2.0, 8.0), (2.0, 0.0)]], [(2.0, 0.0)]),
        ([SQUARE, MIDDLE], [(6.0, 0.0), (6.0, 12.0)]),
        ([SQUARE, MIDDLE[::-1], shifted(SQUARE, 0.3)], [(6.0, 0.0), (6.0, 12.0)]),
        ([[(-8.0, 0.0), (8.0, 0.0), (8.0, 6.0), (0.0, 6.0), (0.0, -8.0)]], [(0.0, 0.0)]),
    ],
    ids=["crossing", "45 degrees", "T", "branches", "two laps", "crosses itself"],
)
def test_junctions_are_where_walks_branch_or_cross(
    walks: Sequence[Corners], expected: Sequence[tuple[float, float]]
):
    found = graph_of(map_of_walks(*map(walk_along, walks))).find_junctions()
    assert len(found) == len(expected)
    for place in expected:
        offsets = [np.linalg.norm(one.position[:2] - place) for one in found]
        assert min(offsets) < 1.0


@pytest.mark.parametrize(
    "walks",
    [
        [SQUARE],
        [[*SQUARE, (6.0, 0.0)]],
        [SQUARE, shifted(SQUARE, 0.3)],
        [SQUARE, shifted(SQUARE, 0.6)[::-1]],
        [[(0.0, 0.0), (9.0, 0.0), (0.0, 0.1)]],
        [[(0.0, 0.0), (9.0, 0.0)], [(6.0, -0.2), (6.0, 0.2)]],
        [[(0.0, 0.0), (9.0, 0.0)], [(4.0, 3.0), (4.0, 9.0)]],
    ],
    ids=["lap", "overlap", "two laps", "reverse lap", "there and back", "wiggle", "apart"],
)
def test_plain_laps_have_no_junction(walks: Sequence[Corners]):
    assert graph_of(map_of_walks(*map(walk_along, walks))).find_junctions() == []


def test_turning_on_the_spot_makes_no_junction():
    line = walk_along([(0.0, 0.0), (9.0, 0.0)])
    turns = np.linspace(0.0, 2.0 * np.pi, 90)
    spot = [
        Rigid3(line[45].rotation @ exp_so3(np.array([0.0, turn, 0.0])), line[45].translation)
        for turn in turns
    ]
    topomap = map_of_walks([*line[:45], *spot, *line[45:]])
    assert len(topomap.summaries) > 90
    assert describe_junctions(topomap) == []


def test_the_number_of_ways_and_the_nearest_node_are_named():
    topomap = map_of_walks(*map(walk_along, ([(-8.0, 0.0), (8.0, 0.0)], [(0.0, -8.0), (0.0, 8.0)])))
    (one,) = describe_junctions(topomap)
    assert one["ways"] == 4
    node = topomap.summaries[topomap.row_of(NodeId(one["node"]))].world_from_cam
    assert np.linalg.norm(node.translation - one["position"]) < D_THRESH


def test_a_crossing_is_found_between_distant_nodes():
    """Nodes are 4 m apart, as those of a fast drive: the crossing lies between them."""
    lines = ([(-22.0, 0.0), (18.0, 0.0)], [(0.0, -22.0), (0.0, 18.0)])
    topomap = map_of_walks(*(walk_along(line, 4.0) for line in lines), d_thresh=1.0)
    (one,) = describe_junctions(topomap)
    assert np.linalg.norm(one["position"][:2]) < 0.5


@pytest.mark.parametrize(
    ("start", "end", "metres"),
    [
        ((3.0, 0.0), (3.0, 12.0), 18.0),  # by the west side
        ((6.0, 6.0), (12.0, 6.0), 18.0),
        ((6.0, 3.0), (0.0, 1.0), 10.0),
        ((11.0, 0.0), (11.0, 12.0), 14.0),
    ],
)
def test_routes_are_as_short_as_the_walks(
    start: tuple[float, float], end: tuple[float, float], metres: float
):
    graph = graph_of(map_of_walks(walk_along(SQUARE), walk_along(MIDDLE)))
    ends = [graph.nearest_node(np.array([*place, 1.4])) for place in (start, end)]
    route = graph.find_route(ends[0], ends[1])
    assert [route.nodes[0], route.nodes[-1]] == ends
    # Nodes are up to D_thresh from either end, and a route cuts corners by less than D_thresh.
    assert 0.9 * metres - 2 * D_THRESH <= route.metres[-1] <= 1.1 * metres + 2 * D_THRESH
    assert route.metres == sorted(route.metres)
    steps = np.linalg.norm(np.diff(graph.nodes[route.nodes], axis=0), axis=1)
    assert steps.max() < 3 * D_THRESH


def test_a_route_leads_from_a_map_to_another_one():
    first = map_of_walks(walk_along([(0.0, 0.0), (8.0, 0.0)]))
    second = map_of_walks(walk_along([(-4.0, 0.0), (4.0, 0.0)]))  # 12 m further in its own world
    moved = Rigid3(np.eye(3), np.array([12.0, 0.1, 0.0]))
    graph = WalkGraph.from_maps([(first, Rigid3.identity()), (second, moved)])
    route = graph.find_route(0, len(graph.nodes) - 1)
    assert len(graph.nodes) == len(first.summaries) + len(second.summaries)
    assert abs(route.metres[-1] - 16.0) < 0.5


def test_unconnected_nodes_have_no_route():
    graph = graph_of(
        map_of_walks(walk_along([(0.0, 0.0), (4.0, 0.0)]), walk_along([(0.0, 3.0), (4.0, 3.0)]))
    )
    with pytest.raises(MapError, match="topoloc update"):
        graph.find_route(0, len(graph.nodes) - 1)
    assert graph.find_route(2, 2).metres[-1] == 0.0


def test_a_map_without_nodes_has_no_graph():
    with pytest.raises(MapError, match="no nodes"):
        WalkGraph.from_maps([])
