"""Test the display and export of an atlas's tiles that share a world, each at its
place in the atlas."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import pytest

from built_room import built_room
from topoloc.apps.cli import main
from topoloc.apps.viewer.document import ResultSet, create_document
from topoloc.apps.viewer.worlds import create_world_document, create_world_scene, transform_answers
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import NewTile, add_joins, create_atlas
from topoloc.atlas.joint_worlds import Join
from topoloc.atlas.place import SharedWorld
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence

HALL_FROM_ROOM = Rigid3(exp_so3(np.array([0.0, 0.0, 0.5])), np.array([10.0, -2.0, 1.0]))
"""Join of `hall` and `room`, which are copies of one map. `far` is a third copy without a join."""


@pytest.fixture(scope="module")
def campus(room_map: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("tiles") / "campus"
    names = ("hall", "room", "far")
    create_atlas(str(where), [NewTile(name, room_map, name) for name in names])
    tiles = Atlas.open(str(where)).manifest.by_id
    add_joins(str(where), [Join("hall", "room", HALL_FROM_ROOM, 1e-6 * np.eye(6), 5)], tiles)
    return where


def _points(document: dict) -> np.ndarray:
    return np.frombuffer(base64.b64decode(document["points"]["world"]), "<f4").reshape(-1, 3)


def test_each_tile_stands_where_it_lies(campus: Path, tiny_recording: Path):
    atlas = Atlas.open(str(campus))
    world, alone = SharedWorld.group(atlas.manifest)
    assert ([placed.tile.tile_id for placed in world.tiles], alone.tiles[0].tile.tile_id) == (
        ["hall", "room"],
        "far",
    )
    document = create_world_document(atlas, world, "campus")
    room = create_document(built_room(tiny_recording), "room")
    assert document["map"]["num_nodes"] == 2 * room["map"]["num_nodes"]
    assert document["map"]["tiles"] == ["hall", "room"]
    assert len({session["id"] for session in document["map"]["sessions"]}) == 2
    pairs = [(node["tile"], node["id"]) for node in document["nodes"]]
    assert len(set(pairs)) == len(pairs)
    poses = {
        pair: node["world_from_cam"]["translation"]
        for pair, node in zip(pairs, document["nodes"], strict=True)
    }
    for node in room["nodes"]:
        moved = HALL_FROM_ROOM.apply(np.array([node["world_from_cam"]["translation"]]))[0]
        np.testing.assert_allclose(poses["room", node["id"]], moved, atol=1e-5)
        np.testing.assert_allclose(
            poses["hall", node["id"]], node["world_from_cam"]["translation"], atol=1e-5
        )
    shown = _points(document)
    np.testing.assert_allclose(
        shown[len(shown) // 2 :],
        HALL_FROM_ROOM.apply(shown[: len(shown) // 2].astype(float)),
        atol=1e-4,
    )
    np.testing.assert_allclose(np.linalg.norm(document["up"]), 1.0, atol=1e-5)
    low, high = map(np.array, document["focus"])
    assert np.mean(((shown >= low) & (shown <= high)).all(axis=1)) > 0.7
    json.dumps(document, allow_nan=False)


def test_answers_stand_where_their_tile_lies(campus: Path, tiny_recording: Path, room_map: Path):
    atlas = Atlas.open(str(campus))
    world = SharedWorld.group(atlas.manifest)[0]
    frame = open_sequence(str(tiny_recording))[3]
    with TopoMetricMap.load(room_map) as topomap:
        result = Localizer(topomap).localize(frame.image, frame.camera)
    assert isinstance(result, Localization)
    answer = result.to_json("3") | {"tile": "room"}
    (moved,) = transform_answers(world, [answer, answer | {"tile": "far"}])
    pose = HALL_FROM_ROOM @ result.world_from_cam
    np.testing.assert_allclose(moved["world_from_cam"]["translation"], pose.translation, atol=1e-9)
    covariance = HALL_FROM_ROOM.adjoint() @ result.covariance @ HALL_FROM_ROOM.adjoint().T
    np.testing.assert_allclose(moved["covariance"], covariance, atol=1e-12)
    refused = {"query": "4", "localized": False, "reason": "ambiguous", "tile": "hall"}
    poses = [
        {"world_from_cam": answer["world_from_cam"], "probability": 0.4, "node": 0, "tile": name}
        for name in ("hall", "room", "far")
    ]
    (shown,) = transform_answers(world, [refused | {"alternatives": poses}])
    assert [one["tile"] for one in shown["alternatives"]] == ["hall", "room"]
    document = create_world_document(
        atlas, world, "campus", [ResultSet("walk", [answer, answer | {"tile": "far"}])]
    )
    assert document["results"][0]["num_answers"] == 1


def test_an_export_holds_all_of_them(campus: Path):
    atlas = Atlas.open(str(campus))
    world = SharedWorld.group(atlas.manifest)[0]
    both, one = (
        create_world_scene(atlas, world, "campus"),
        create_world_scene(atlas, SharedWorld.of_tile(atlas.manifest, atlas.tile("room")), "room"),
    )
    half = len(one.views)
    assert (len(both.views), len(both.points.world)) == (2 * half, 2 * len(one.points.world))
    view, same = both.views[half], one.views[0]
    assert view.name == f"room/{same.name}"
    np.testing.assert_allclose(
        view.world_from_cam.translation,
        (HALL_FROM_ROOM @ same.world_from_cam).translation,
        atol=1e-6,
    )
    seen = view.point_rows >= 0
    np.testing.assert_allclose(
        both.points.world[view.point_rows[seen]],
        HALL_FROM_ROOM.apply(one.points.world[same.point_rows[same.point_rows >= 0]]),
        atol=1e-6,
    )


def test_the_commands_show_the_largest_world_and_list_other_tiles(
    campus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    page = tmp_path / "campus.html"
    assert main(["view", str(campus), "--out", str(page)]) == 0
    said = capsys.readouterr()
    assert "2 tiles" in said.out
    assert "tiles of other worlds are left out (far)" in said.err
    assert "campus" in page.read_text()
    assert main(["export", str(campus), str(tmp_path / "far.ply"), "--tile", "far"]) == 0
    assert capsys.readouterr().err == ""


def test_a_rotten_tile_is_left_out(
    campus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    import shutil

    own = Path(shutil.copytree(campus, tmp_path / "own"))
    atlas = Atlas.open(str(own))
    room, hall = atlas.tile("room"), atlas.tile("hall")
    assert room.map.name != hall.map.name
    atlas.map_path(room).write_bytes(b"rotten")
    assert main(["export", str(own), str(tmp_path / "own.ply")]) == 0
    assert "tile room is left out" in capsys.readouterr().err
    atlas.map_path(hall).write_bytes(b"rotten")
    assert main(["export", str(own), str(tmp_path / "own.ply")]) == 1
