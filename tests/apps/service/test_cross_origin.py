"""Test requests of pages from other origins. As browsers do, send a preflight first. Browsers hide
an answer without the header that allows the origin."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from urllib.parse import quote

import httpx
import pytest
from running_service import PAGE, SIGNED_TOKEN, TOKEN, Running, running
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from topoloc.apps.service.cross_origin import parse_origin

OTHER = "https://elsewhere.example"
ALLOWS = "access-control-allow-origin"
SESSIONS = "/v1/maps/earth/sessions"


def _preflight(client: httpx.Client, path: str, method: str, **headers: str) -> httpx.Response:
    asked = {"origin": PAGE, "access-control-request-method": method}
    return client.options(path, headers=asked | headers)


def test_a_page_of_an_allowed_origin_uses_the_geopose_protocol(
    asked: httpx.Client, view: Path, camera: str
):
    allowed = _preflight(
        asked, "/localize/geopose", "POST", **{"access-control-request-headers": "content-type"}
    )
    assert (allowed.status_code, allowed.headers[ALLOWS]) == (204, PAGE)
    assert "content-type" in allowed.headers["access-control-allow-headers"].lower()
    known = json.loads(camera)
    params = [known["fx"], known["fy"], known["cx"] + 0.5, known["cy"] + 0.5]
    reading = {
        "timestamp": 1,
        "sensorId": "0",
        "imageFormat": "JPG",
        "imageBytes": base64.b64encode(view.read_bytes()).decode(),
        "params": {"model": "PINHOLE", "modelParams": params},
    }
    request = {
        "id": "1",
        "timestamp": 1,
        "sensors": [{"id": "0", "type": "camera"}],
        "sensorReadings": {"cameraReadings": [reading]},
    }
    answer = asked.post("/localize/geopose", json=request, headers={"origin": PAGE})
    assert (answer.status_code, answer.headers[ALLOWS]) == (200, PAGE)
    assert answer.headers["vary"] == "Origin"
    assert set(answer.json()["geopose"]) == {"position", "quaternion"}


def test_a_preflight_needs_no_token_and_allows_every_method_of_the_service(
    open_service: Running, asked: httpx.Client
):
    document = asked.get("/openapi.json").json()
    with open_service.client() as stranger:
        allowed = _preflight(stranger, "/v1/localize", "POST")
        methods = {method.upper() for one in document["paths"].values() for method in one}
        assert allowed.status_code == 204
        assert methods <= set(allowed.headers["access-control-allow-methods"].split(", "))
        names = allowed.headers["access-control-allow-headers"].lower().split(", ")
        assert {"authorization", "content-type", "accept"} <= set(names)
        private = {"access-control-request-private-network": "true"}
        shown = _preflight(stranger, "/v1/maps", "GET", **private).headers
        assert shown["access-control-allow-private-network"] == "true"


@pytest.mark.parametrize(
    ("path", "shown", "status"),
    [
        ("/v1/maps", {"authorization": "Bearer wrong"}, 401),
        ("/v1/elsewhere", {}, 404),
        ("/v1/maps/nowhere", {}, 404),
        ("/v1/maps", {"host": "elsewhere.example"}, 421),
    ],
)
def test_the_page_can_read_why_it_is_refused(
    asked: httpx.Client, path: str, shown: dict[str, str], status: int
):
    refused = asked.get(path, headers={"origin": PAGE} | shown)
    assert (refused.status_code, refused.headers[ALLOWS]) == (status, PAGE)
    assert refused.headers["x-request-id"] == refused.json()["request_id"]
    assert "X-Request-Id" in refused.headers["access-control-expose-headers"]


def test_other_origins_are_refused_in_a_sentence_that_names_the_option(asked: httpx.Client):
    for refused in (
        asked.get("/v1/maps", headers={"origin": OTHER}),
        asked.get("/v1/maps", headers={"origin": "null"}),
        asked.get("/v1/maps", headers={"origin": PAGE + ".evil.example"}),
        asked.get("/v1/maps", headers={"origin": PAGE.replace("https", "http")}),
        _preflight(asked, "/v1/maps", "GET", origin=OTHER),
    ):
        assert refused.status_code == 403
        assert "--allow-origin" in refused.json()["error"]
        assert ALLOWS not in refused.headers
        assert refused.headers["vary"] == "Origin"


def test_websockets_of_allowed_pages_are_accepted(open_service: Running):
    address = open_service.url.replace("http", "ws") + SESSIONS
    spoken = ["topoloc", f"bearer.{quote(SIGNED_TOKEN, safe='')}"]
    with connect(address, subprotocols=spoken, origin="http://localhost:3000") as stream:  # pyright: ignore[reportArgumentType]
        assert stream.subprotocol == "topoloc"
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(address, subprotocols=spoken, origin=OTHER),  # pyright: ignore[reportArgumentType]
    ):
        pass
    assert refused.value.response.status_code == 403
    assert "--allow-origin" in json.loads(refused.value.response.body)["error"]


def test_by_default_no_origin_is_allowed(client: httpx.Client):
    refused = _preflight(client, "/v1/maps", "GET")
    assert refused.status_code == 403
    assert "vary" not in client.get("/v1/maps").headers
    own = str(client.base_url).rstrip("/")
    assert ALLOWS not in client.get("/v1/maps", headers={"origin": own}).headers


def test_any_origin_needs_a_token(complaint: Callable[..., str], maps: Path, tmp_path: Path):
    assert "--token-file" in complaint("serve", maps, "--allow-origin", "*", status=2)
    token = tmp_path / "token"
    token.write_text(TOKEN)
    with (
        running(maps, "--token-file", token, "--allow-origin", "*") as service,
        service.client(headers={"authorization": f"Bearer {TOKEN}"}) as client,
    ):
        assert client.get("/v1/maps", headers={"origin": OTHER}).headers[ALLOWS] == OTHER
        assert client.get("/v1/maps", headers={"origin": "null"}).status_code == 200


@pytest.mark.parametrize(
    "text",
    ["", "app.example", "null", "https://app.example/page", "https://app.example/", "https://",
     "https://*.example", "https://me@app.example", "https://app.example:x", "https://a.b?c"],
)  # fmt: skip
def test_an_invalid_origin_is_one_line(complaint: Callable[..., str], maps: Path, text: str):
    said = complaint("serve", maps, "--allow-origin", text, status=2)
    assert "https://app.example, without a path" in said


def test_origins_are_read_as_browsers_write_them():
    assert parse_origin("HTTPS://App.Example:443") == "https://app.example"
    assert parse_origin("http://localhost:80") == "http://localhost"
    assert parse_origin("http://[::1]:3000") == "http://[::1]:3000"
    assert parse_origin("https://app.example:8443") == "https://app.example:8443"
    assert parse_origin("capacitor://localhost") == "capacitor://localhost"
