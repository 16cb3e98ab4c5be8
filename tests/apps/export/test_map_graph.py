"""Test a map's graph as GraphML and GeoJSON: other programs read it, and it matches the map."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from topoloc import TopoMetricMap
from topoloc.apps.cli import main
from topoloc.apps.cli.maps.info import build_graph

NS = {"g": "http://graphml.graphdrawing.org/xmlns"}


def test_the_graph_is_that_of_the_map(room_map: Path):
    with TopoMetricMap.load(room_map) as topomap:
        graph = build_graph(topomap)
        assert list(graph.nodes) == [summary.node_id for summary in topomap.summaries]
        assert set(graph.edges) == {(edge.source_id, edge.target_id) for edge in topomap.edges}
        at = {summary.node_id: summary.world_from_cam for summary in topomap.summaries}
        for (source, target), facts in graph.edges.items():
            way = at[source].inverse() @ at[target]
            np.testing.assert_allclose(
                [facts["x"], facts["y"], facts["z"]], way.translation, atol=1e-12
            )
            assert (
                abs(
                    facts["metres"]
                    - np.linalg.norm(at[source].translation - at[target].translation)
                )
                < 1e-12
            )
            assert facts["times"] >= 1
        junctions = {one["node"] for one in topomap.junctions}
    assert {node for node, facts in graph.nodes.items() if facts["is_junction"]} == junctions


def test_graphml_declares_what_it_holds(room_map: Path, tmp_path: Path):
    target = tmp_path / "room.graphml"
    assert main(["info", str(room_map), "--graph", str(target)]) == 0
    root = ElementTree.parse(target).getroot()
    keys = {(key.get("id"), key.get("for")) for key in root.findall("g:key", NS)}
    nodes, edges = root.findall("g:graph/g:node", NS), root.findall("g:graph/g:edge", NS)
    with TopoMetricMap.load(room_map) as topomap:
        assert len(nodes) == len(topomap.summaries)
        assert len(edges) == len(topomap.edges)
        first = {data.get("key"): data.text for data in nodes[0].findall("g:data", NS)}
        assert float(first["node_x"] or "nan") == topomap.summaries[0].world_from_cam.translation[0]
    names = {node.get("id") for node in nodes}
    for kind, elements in (("node", nodes), ("edge", edges)):
        for element in elements:
            assert {(data.get("key"), kind) for data in element.findall("g:data", NS)} <= keys
    assert all({edge.get("source"), edge.get("target")} <= names for edge in edges)


def test_geojson_needs_a_place_on_earth(
    room_map: Path, tmp_path: Path, complaint: Callable[..., str]
):
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    assert "topoloc georeference" in complaint("info", path, "--graph", tmp_path / "room.geojson")
    assert "graphml or .geojson" in complaint("info", path, "--graph", tmp_path / "room.txt")
    assert main(["georeference", str(path), "--origin", "48.2,16.37,170,90"]) == 0
    assert main(["info", str(path), "--graph", str(tmp_path / "room.geojson")]) == 0
    features = json.loads((tmp_path / "room.geojson").read_text())["features"]
    points = [feature for feature in features if feature["geometry"]["type"] == "Point"]
    edges = [feature for feature in features if feature["geometry"]["type"] == "LineString"]
    with TopoMetricMap.load(path) as topomap:
        assert (len(points), len(edges)) == (len(topomap.summaries), len(topomap.edges))
    lon, lat, h = points[0]["geometry"]["coordinates"]
    assert abs(lon - 16.37) < 1e-6
    assert abs(lat - 48.2) < 1e-6
    assert abs(h - 170.0) < 0.01
