"""Test streams over the network: one request per image, or a WebSocket."""

from __future__ import annotations

import asyncio
import json
import threading
from pathlib import Path

import httpx
import numpy as np
import pytest
import uvicorn
from running_service import Running
from websockets.asyncio.client import connect as connect_async
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from tiny_world import CAMERA
from topoloc import Localizer, MapCache, Tracker
from topoloc.apps.service.application import create_application
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.connections import protocols
from topoloc.localization.query import Deadline

SESSIONS = "/v1/maps/room/sessions"


def _pictures(recording: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted((recording / "image_0").iterdir())][:4]


def _socket_address(service: Running, **params: str) -> str:
    return str(httpx.URL(service.url.replace("http", "ws") + SESSIONS, params=params))


def test_a_stream_by_requests(client: httpx.Client, tiny_recording: Path):
    begun = client.post(SESSIONS, params={"camera": "map"})
    assert begun.status_code == 201
    address = f"{SESSIONS}/{begun.json()['session']}"
    states = list[str]()
    for number, picture in enumerate(_pictures(tiny_recording)):
        params = {"t_ns": str(100_000_000 * number), "name": str(number)}
        answer = client.post(
            f"{address}/pictures",
            params=params,
            content=picture,
            headers={"content-type": "image/png"},
        ).json()
        states.append(answer["state"])
        assert answer["t_ns"] == 100_000_000 * number
    assert states[0] == "localized"
    assert set(states) <= {"localized", "tracked"}
    backwards = client.post(
        f"{address}/pictures?t_ns=5",
        content=_pictures(tiny_recording)[0],
        headers={"content-type": "image/png"},
    )
    assert backwards.status_code == 422
    assert client.delete(address).status_code == 204
    assert client.delete(address).status_code == 404


def test_a_stream_over_a_websocket_survives_a_bad_picture(service: Running, tiny_recording: Path):
    with connect(_socket_address(service, camera="map"), subprotocols=["topoloc"]) as socket:  # pyright: ignore[reportArgumentType]
        positions = []
        for number, picture in enumerate(_pictures(tiny_recording)):
            socket.send(json.dumps({"t_ns": 100_000_000 * (number + 1)}))
            socket.send(picture)
            answer = json.loads(socket.recv(30))
            positions.append(answer["smoothed"]["translation"])
            if number == 1:
                socket.send(b"no picture")
                assert "not a picture" in json.loads(socket.recv(30))["error"]
        assert np.ptp(positions, axis=0).max() > 0.05


def test_messages_that_make_no_sense_end_the_stream(service: Running):
    for text in ("[]", "{", '{"fly": 1}', '{"t_ns": -1}'):
        with connect(_socket_address(service, camera="map")) as socket:
            socket.send(text)
            with pytest.raises(ConnectionClosed) as closed:
                socket.recv(10)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1008
            assert closed.value.rcvd.reason


def test_a_websocket_is_refused_with_a_status(service: Running):
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(_socket_address(service).replace("room", "nowhere")),
    ):
        pass
    assert refused.value.response.status_code == 404
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(_socket_address(service), origin="https://elsewhere.example"),
    ):  # pyright: ignore[reportArgumentType]
        pass
    assert refused.value.response.status_code == 403


def test_streams_end_when_nobody_uses_them_and_there_are_not_too_many(
    service: Running, client: httpx.Client
):
    sockets = [connect(_socket_address(service)) for _ in range(3)]
    try:
        refused = client.post(SESSIONS)
        assert (refused.status_code, refused.headers["retry-after"]) == (429, "10")
        assert "3 streams of this address are open" in refused.json()["error"]
        other = httpx.HTTPTransport(local_address="127.0.0.2")
        with service.client(transport=other) as neighbour:
            assert neighbour.post(SESSIONS).status_code == 201
            refused = neighbour.post(SESSIONS)
            assert refused.status_code == 429
            assert "4 streams are open" in refused.json()["error"]
        for socket in sockets:
            with pytest.raises(ConnectionClosed) as closed:
                socket.recv(10)
            assert closed.value.rcvd is not None
            assert "no image" in closed.value.rcvd.reason
    finally:
        for socket in sockets:
            socket.close()
    assert client.post(SESSIONS).status_code == 201


def test_a_camera_may_be_unknown(client: httpx.Client, tiny_recording: Path):
    session = client.post(SESSIONS).json()["session"]
    answer = client.post(
        f"{SESSIONS}/{session}/pictures",
        content=_pictures(tiny_recording)[0],
        headers={"content-type": "image/png"},
    )
    assert answer.status_code == 200
    assert answer.json()["state"] == "localized"
    assert answer.json()["focal_length_px"] == pytest.approx(CAMERA.fx, rel=0.1)
    client.delete(f"{SESSIONS}/{session}")


async def _close_during_a_job(port: int, is_socket: bool, picture: bytes, begun: threading.Event):
    """Send an image of a stream, and close the connection when its job runs."""
    address = f"127.0.0.1:{port}{SESSIONS}"
    if is_socket:
        async with connect_async(f"ws://{address}?camera=map") as stream:
            await stream.send(picture)
            assert await asyncio.to_thread(begun.wait, 20.0)
        return
    async with httpx.AsyncClient() as client:
        session = (await client.post(f"http://{address}?camera=map")).json()["session"]
        url = f"http://{address}/{session}/pictures"
        headers = {"content-type": "image/png"}
        post = asyncio.create_task(client.post(url, content=picture, headers=headers))
        assert await asyncio.to_thread(begun.wait, 20.0)
        post.cancel()


@pytest.mark.parametrize("is_socket", [False, True])
def test_the_search_of_a_disconnected_client_is_stopped(
    room_map: Path, view: Path, monkeypatch: pytest.MonkeyPatch, is_socket: bool
):
    begun, ended, process = threading.Event(), threading.Event(), Tracker.process

    def process_when_stopped(*args: object, **options: object) -> object:
        deadline = args[-1]
        assert isinstance(deadline, Deadline)
        assert not deadline.is_past
        begun.set()
        assert deadline.stop.wait(20.0)
        answer = process(*args, **options)  # pyright: ignore[reportArgumentType]
        ended.set()
        return answer

    monkeypatch.setattr(Tracker, "process", process_when_stopped)

    async def serve() -> None:
        limits = ServiceConfig(workers=1)
        maps = MapCache([str(room_map)], Localizer, 100_000_000)
        app = create_application(maps, limits)
        options = protocols(limits, 100, behind_proxy=False)
        config = uvicorn.Config(app, log_config=None, lifespan="on", port=0, **options)
        server = uvicorn.Server(config)
        serving = asyncio.create_task(server.serve())
        while not server.started:
            await asyncio.sleep(0.05)
        port = server.servers[0].sockets[0].getsockname()[1]
        await _close_during_a_job(port, is_socket, view.read_bytes(), begun)
        assert await asyncio.to_thread(ended.wait, 10.0)
        server.should_exit = True
        await serving

    asyncio.run(serve())
