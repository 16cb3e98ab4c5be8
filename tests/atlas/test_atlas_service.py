"""Test the service of an atlas: tiles are maps under their ids, and queries may address
the whole atlas."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from topoloc.apps.service.application import create_application
from topoloc.apps.service.config import ServiceConfig
from topoloc.atlas.editing import add_tiles, new_tiles, remove_tiles
from topoloc.atlas.map_cache import MapCache
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.mapping.topomap import TopoMetricMap


@pytest.fixture
def client(own_atlas: Path) -> Iterator[TestClient]:
    application = create_application(
        MapCache([str(own_atlas)], Localizer, 100_000_000), ServiceConfig(workers=1)
    )
    with TestClient(application, base_url="http://127.0.0.1") as client:
        yield client


def _asked(client: TestClient, path: str, queries: Path) -> dict[str, object]:
    camera = (queries / "camera.json").read_text()
    answer = client.post(
        path, files={"image": (queries / "view02.png").open("rb")}, data={"camera": camera}
    )
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_tiles_are_maps_and_the_atlas_finds_the_right_one(client: TestClient, queries: Path):
    assert client.get("/v1/maps").json() == {"maps": ["other", "room"]}
    answer = _asked(client, "/v1/localize", queries)
    assert (answer["localized"], answer["map"]) == (True, "room")
    (only,) = answer["answers"]  # pyright: ignore
    assert (only["map"], only["result"]["tile"]) == ("room", "room")
    alone = _asked(client, "/v1/maps/room/localize", queries)
    assert alone["world_from_cam"] == only["result"]["world_from_cam"]
    assert client.get("/v1/maps/other").json()["num_nodes"] == 4


def test_an_atlas_that_is_written_again_is_read_again(
    client: TestClient, own_atlas: Path, room_map: Path, queries: Path
):
    assert _asked(client, "/v1/localize", queries)["map"] == "room"
    remove_tiles(str(own_atlas), ["room"])
    assert _asked(client, "/v1/localize", queries)["localized"] is False
    add_tiles(str(own_atlas), new_tiles([str(room_map)], "hall"))
    assert client.get("/v1/maps").json() == {"maps": ["hall", "other"]}
    assert _asked(client, "/v1/localize", queries)["map"] == "hall"
    assert client.post("/v1/maps/room/localize", files={"image": b"x"}).status_code == 404


def test_a_prior_is_of_one_map(client: TestClient, queries: Path):
    prior = '{"translation": [0.2, 0.0, 1.4], "quat_wxyz": [1, 0, 0, 0]}'
    answer = client.post(
        "/v1/localize", files={"image": (queries / "view02.png").open("rb")}, data={"prior": prior}
    )
    assert answer.status_code == 422
    assert "one map's world" in answer.json()["error"]


def _geopose(client: TestClient, queries: Path, *readings: dict[str, float]) -> Any:
    camera = json.loads((queries / "camera.json").read_text())
    params = {
        "model": "PINHOLE",
        "modelParams": [camera["fx"], camera["fy"], camera["cx"] + 0.5, camera["cy"] + 0.5],
    }
    picture = {
        "imageBytes": base64.b64encode((queries / "view02.png").read_bytes()).decode(),
        "params": params,
    }
    said = {"cameraReadings": [picture], "geolocationReadings": list(readings)}
    return client.post("/localize/geopose", json={"id": "1", "sensorReadings": said})


def test_geopose_searches_only_tiles_near_the_device(
    client: TestClient, own_atlas: Path, room_map: Path, queries: Path
):
    assert _geopose(client, queries).status_code == 409
    with TopoMetricMap.load(room_map) as topomap:
        turned = Rigid3(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.zeros(3))
        placed = replace(
            topomap, georeference=Georeference(GeoPoint(50.87, 4.70, 30.0), turned, "origin")
        )
        placed.save(own_atlas.parent / "room.topo")
    add_tiles(str(own_atlas), new_tiles([str(own_atlas.parent / "room.topo")]), replaces=True)
    native = _asked(client, "/v1/maps/room/localize", queries)
    near, away = ({"latitude": lat, "longitude": 4.70, "accuracy": 10.0} for lat in (50.8701, 50.9))
    unknown = {"latitude": 0.0, "longitude": 0.0, "accuracy": 0.0}
    for readings in ([], [near], [unknown], [{}]):
        answer = _geopose(client, queries, *readings)
        assert answer.status_code == 200, answer.text
        for part in ("position", "quaternion"):
            assert answer.json()["geopose"][part] == pytest.approx(
                native["geopose"][part], abs=1e-9
            )  # pyright: ignore
    refused = _geopose(client, queries, away)
    assert (refused.status_code, refused.json()["reason"]) == (404, "not_in_map")
    assert "no tile lies within 130 m of 50.9" in refused.json()["ERROR"]
    answer = client.post(
        "/v1/localize",
        files={"image": (queries / "view02.png").open("rb")},
        data={"near": "50.9,4.7,10"},
    )
    assert answer.json()["localized"] is False
    found = client.get("/.well-known/spatialdds/search", params={"geohash": "u15"}).json()
    (service,) = (one["service"] for one in found["results"])
    assert service["service_id"] == own_atlas.name, "the atlas, and none of its tiles"
    assert service["hints"][0]["value"] == "http://127.0.0.1/localize/geopose"


@pytest.mark.parametrize("near", ["here", "50,4", "100,0,5", "50,4,0"])
def test_near_must_be_a_place(client: TestClient, queries: Path, near: str):
    answer = client.post(
        "/v1/localize", files={"image": (queries / "view02.png").open("rb")}, data={"near": near}
    )
    assert answer.status_code == 422
    assert answer.json()["error"].startswith("near: ")
