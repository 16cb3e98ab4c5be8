"""Test notes at places of a map: the limit of their number, their file, and moves with the map."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pytest
from running_service import running

from topoloc.apps.cli import main
from topoloc.apps.service.notes import NoteFiles
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.topomap import TopoMetricMap

NOTE = {"text": "the switch", "position": [0.5, 1.0, 2.0]}


@pytest.fixture(scope="module")
def folder(maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("noted")
    for name in ("room", "earth"):
        shutil.copy(maps / f"{name}.topo", folder)
    return folder


@pytest.fixture(scope="module")
def noted(folder: Path) -> Iterator[httpx.Client]:
    """Return a client of a service that keeps three notes per map."""
    config = folder / "limits.toml"
    config.write_text("[serve]\nmax_notes = 3\n")
    with running(folder, "--config", config) as service, service.client() as client:
        yield client


def test_a_note_is_kept_beside_the_map_until_it_is_deleted(noted: httpx.Client, folder: Path):
    before = (folder / "room.topo").read_bytes()
    status = (folder / "room.topo").stat()
    revision = f"{status.st_mtime_ns:x}-{status.st_size:x}"
    none = {"map": "room", "revision": revision, "notes": []}
    assert noted.get("/v1/maps/room/notes").json() == none
    answer = noted.post("/v1/maps/room/notes", json=NOTE | {"text": "  the switch\n"})
    assert answer.status_code == 201
    [note] = noted.get("/v1/maps/room/notes").json()["notes"]
    assert note["id"] == answer.json()["id"]
    assert note["text"] == "the switch"
    np.testing.assert_allclose(note["position"], NOTE["position"], atol=1e-9)
    assert "geopose" not in note
    assert json.loads((folder / "room.notes.json").read_text())["format"] == "topoloc-notes"
    assert (folder / "room.topo").read_bytes() == before
    assert noted.delete(f"/v1/maps/room/notes/{note['id']}").status_code == 204
    assert noted.delete(f"/v1/maps/room/notes/{note['id']}").status_code == 404
    assert noted.get("/v1/maps/room/notes").json()["notes"] == []


def test_a_note_of_a_map_on_earth_has_a_geopose(noted: httpx.Client):
    noted.post("/v1/maps/earth/notes", json=NOTE)
    [note] = noted.get("/v1/maps/earth/notes").json()["notes"]
    # east-north-up of this map are x, z and -y, at 50.87, 4.70, 30 m
    place = note["geopose"]["position"]
    assert place["h"] == pytest.approx(29.0, abs=1e-3)
    assert (place["lat"] - 50.87) * 111_250 == pytest.approx(2.0, abs=0.01)
    assert (place["lon"] - 4.70) * 70_400 == pytest.approx(0.5, abs=0.01)
    assert note["geopose"]["quaternion"] == {"x": 0, "y": 0, "z": 0, "w": 1}


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"text": " "}, "text"),
        ({"text": "a" * 501}, "500"),
        ({"position": [0, 0]}, "position"),
        ({"position": [0, 0, 1e300]}, "position"),
        ({"position": [0, 0, 5000]}, "1000 m"),
        ({"position": ["x", 0, 0]}, "position"),
    ],
)
def test_a_note_that_cannot_be_is_refused(noted: httpx.Client, wrong: dict, said: str):
    answer = noted.post("/v1/maps/room/notes", json=NOTE | wrong)
    assert answer.status_code == 422
    assert said in answer.json()["error"]


def test_no_more_than_the_limit_are_kept(noted: httpx.Client):
    statuses = [noted.post("/v1/maps/room/notes", json=NOTE).status_code for _ in range(4)]
    assert statuses == [201, 201, 201, 409]
    for note in noted.get("/v1/maps/room/notes").json()["notes"]:
        noted.delete(f"/v1/maps/room/notes/{note['id']}")
    assert noted.post("/v1/maps/nothing/notes", json=NOTE).status_code == 404


@pytest.mark.parametrize(
    ("content", "status", "said"),
    [
        ('{"map": "another", "notes": []}', 200, ""),
        ("{", 503, "room.notes.json"),
        ('{"map": "x", "notes": [{"id": 1}]}', 503, "room.notes.json"),
    ],
)
def test_a_damaged_file_is_named(
    noted: httpx.Client, folder: Path, content: str, status: int, said: str
):
    (folder / "room.notes.json").write_text(content)
    answer = noted.get("/v1/maps/room/notes")
    assert answer.status_code == status
    assert said in answer.text
    (folder / "room.notes.json").unlink()


def test_notes_of_another_map_are_left_alone(noted: httpx.Client, folder: Path):
    noted.post("/v1/maps/room/notes", json=NOTE)
    kept = (folder / "room.notes.json").read_text()
    [identity] = {json.loads(kept)["map"]}
    (folder / "room.notes.json").write_text(kept.replace(identity, "another"))
    assert noted.get("/v1/maps/room/notes").json()["notes"] == []
    answer = noted.post("/v1/maps/room/notes", json=NOTE)
    assert answer.status_code == 409
    assert "another map" in answer.json()["error"]
    (folder / "room.notes.json").unlink()


def test_a_note_moves_with_its_node(room_map: Path, tmp_path: Path):
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    notes = NoteFiles(10)
    turn = Rigid3(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.full(3, 5.0))
    with TopoMetricMap.load(path) as topomap:
        notes.add(path, topomap, "here", [0.5, 1.0, 2.0])
        summaries = [
            replace(one, world_from_cam=turn @ one.world_from_cam) for one in topomap.summaries
        ]
        [note] = notes.list_notes(path, replace(topomap, summaries=summaries))
        np.testing.assert_allclose(note["position"], [4.0, 5.5, 7.0], atol=1e-9)
        [note] = notes.list_notes(path, replace(topomap, summaries=summaries[1:2]))
        np.testing.assert_allclose(note["position"], [0.5, 1.0, 2.0], err_msg="its node is gone")


def test_tiles_keep_none(maps: Path, tmp_path: Path):
    atlas = tmp_path / "campus"
    assert main(["atlas", "create", str(atlas), str(maps / "room.topo")]) == 0
    with running(atlas) as service, service.client() as client:
        [name] = client.get("/v1/maps").json()["maps"]
        answer = client.post(f"/v1/maps/{name}/notes", json=NOTE)
        assert answer.status_code == 409
        assert "tiles" in answer.json()["error"]
