"""Test the document of a scene: it matches the map, is finite and keeps its budget."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from built_room import built_room
from topoloc.apps.viewer.document import ResultSet, SceneBudget, create_document, to_script_json
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3, exp_so3


def _points(document: dict) -> np.ndarray:
    return np.frombuffer(base64.b64decode(document["points"]["world"]), "<f4").reshape(-1, 3)


def test_points_and_nodes_stand_where_the_map_has_them(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    document = create_document(topomap, "room")
    node = topomap.nodes[0]
    of_node = node.summary.world_from_cam.apply(node.points_cam.astype(np.float64))
    shown = _points(document)
    assert len(shown) == document["map"]["num_points_shown"] > 100
    away = np.linalg.norm(of_node[:, None] - shown[None, : len(of_node)], axis=2).min(axis=1)
    assert np.mean(away < 1e-4) > 0.5, "its well-known points are the first ones shown"
    assert [one["id"] for one in document["nodes"]] == [
        summary.node_id for summary in topomap.summaries
    ]
    first = document["nodes"][0]
    np.testing.assert_allclose(
        first["world_from_cam"]["translation"], node.summary.world_from_cam.translation, atol=1e-6
    )
    assert first["camera"]["width"] == node.camera.width
    assert (
        cv2.imdecode(np.frombuffer(base64.b64decode(first["picture"]), np.uint8), cv2.IMREAD_COLOR)
        is not None
    )
    colours = np.frombuffer(base64.b64decode(document["points"]["rgb"]), np.uint8).reshape(-1, 3)
    assert len(colours) == len(shown)
    assert colours.std() > 5
    (low, high) = map(np.array, document["focus"])
    assert (low <= high).all()
    assert np.mean(((shown >= low) & (shown <= high)).all(axis=1)) > 0.7


def test_a_budget_is_kept(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    small = create_document(
        topomap, "room", budget=SceneBudget(max_points=100, max_image_bytes=20_000)
    )
    assert 50 < len(_points(small)) <= 100
    pictures = [node["picture"] for node in small["nodes"] if node["picture"]]
    assert 0 < sum(map(len, pictures)) <= 20_000
    assert small["map"]["num_points"] == create_document(topomap, "room")["map"]["num_points"]


@pytest.mark.parametrize(
    "turn", [np.zeros(3), np.array([np.pi / 2, 0.0, 0.0])], ids=["y down", "turned"]
)
def test_up_is_where_the_cameras_have_it(tiny_recording: Path, turn: np.ndarray):
    topomap = built_room(tiny_recording)
    moved = Rigid3(exp_so3(turn), np.zeros(3))
    summaries = [
        replace(summary, world_from_cam=moved @ summary.world_from_cam)
        for summary in topomap.summaries
    ]
    nodes = [
        replace(node, summary=summary)
        for node, summary in zip(topomap.nodes, summaries, strict=True)
    ]
    before = np.array(create_document(topomap, "room")["up"])
    np.testing.assert_allclose(
        create_document(
            replace(topomap.with_first_layer(nodes=nodes), summaries=summaries), "room"
        )["up"],
        moved.rotation @ before,
        atol=0.1,
    )


def test_up_is_up_on_earth_where_that_is_known(tiny_recording: Path):
    enu_from_world = Rigid3(exp_so3(np.array([0.3, 0.2, 0.1])), np.zeros(3))
    earth = replace(
        built_room(tiny_recording),
        georeference=Georeference(GeoPoint(50.0, 4.0, 0.0), enu_from_world, "origin"),
    )
    np.testing.assert_allclose(
        enu_from_world.rotation @ create_document(earth, "room")["up"], [0.0, 0.0, 1.0], atol=1e-5
    )


def test_a_path_breaks_where_it_jumps(tiny_recording: Path):
    positions = [np.array([x, 0.0, 0.0]) for x in (0.0, 1.0, 2.0, 30.0, 31.0)]
    walk = ResultSet("walk", path=[Rigid3(np.eye(3), position) for position in positions])
    path = create_document(built_room(tiny_recording), "room", [walk])["paths"][-1]
    assert path["name"] == "walk"
    assert [len(line) for line in path["lines"]] == [3, 2]


def test_text_within_a_page_cannot_end_its_script(tiny_recording: Path):
    document = create_document(
        built_room(tiny_recording),
        "</script><b>&",
        [ResultSet("a", [{"query": "x", "localized": False, "ms": float("nan")}])],
    )
    text = to_script_json(document)
    assert not set("<>&") & set(text)
    assert json.loads(text)["name"] == "</script><b>&"
    assert json.loads(text)["results"][0]["answers"][0]["ms"] is None
