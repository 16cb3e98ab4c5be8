"""An atlas behind the service: tiles are maps under their ids, and every map is asked through the atlas."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from topoloc.atlas.editing import add_tiles, new_tiles, remove_tiles
from topoloc.atlas.open_maps import Maps
from topoloc.localization.localizer import Localizer
from topoloc.service.application import Access, make_application
from topoloc.service.config import ServiceConfig


@pytest.fixture
def client(own_atlas: Path) -> Iterator[TestClient]:
    application = make_application(Maps([own_atlas], Localizer, 100_000_000), ServiceConfig(workers=1), Access())
    with TestClient(application, base_url="http://127.0.0.1") as client:
        yield client


def _asked(client: TestClient, path: str, queries: Path) -> dict[str, object]:
    camera = (queries / "camera.json").read_text()
    answer = client.post(path, files={"image": (queries / "view02.png").open("rb")}, data={"camera": camera})
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


def test_an_atlas_that_is_written_again_is_read_again(client: TestClient, own_atlas: Path, room_map: Path, queries: Path):
    assert _asked(client, "/v1/localize", queries)["map"] == "room"
    remove_tiles(str(own_atlas), ["room"])
    assert _asked(client, "/v1/localize", queries)["localized"] is False
    add_tiles(str(own_atlas), new_tiles([str(room_map)], "hall"))
    assert client.get("/v1/maps").json() == {"maps": ["hall", "other"]}
    assert _asked(client, "/v1/localize", queries)["map"] == "hall"
    assert client.post("/v1/maps/room/localize", files={"image": b"x"}).status_code == 404


def test_a_prior_is_of_one_map(client: TestClient, queries: Path):
    prior = '{"translation": [0.2, 0.0, 1.4], "quat_wxyz": [1, 0, 0, 0]}'
    answer = client.post("/v1/localize", files={"image": (queries / "view02.png").open("rb")}, data={"prior": prior})
    assert answer.status_code == 422
    assert "one map's world" in answer.json()["error"]
