"""Check that one address cannot take all connections, and that unread answers are not stored."""

from __future__ import annotations

import asyncio
import io
import json
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
import uvicorn
from PIL import Image
from running_service import Running, running
from starlette.requests import Request
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from topoloc import Localizer, MapCache
from topoloc.apps.service import query_handler
from topoloc.apps.service.application import create_application
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.connections import Connections, protocols, while_connected
from topoloc.apps.service.map_routes import build_scene
from topoloc.apps.service.query_handler import ImageDecoder
from topoloc.apps.service.request_errors import RequestError
from topoloc.apps.service.state import Service, Workers
from topoloc.recordings.image_io import EncodedImage


def _open(service: Running, *requests: str, source: str = "127.0.0.1") -> socket.socket:
    address = urlsplit(service.url)
    opened = socket.socket()
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    opened.settimeout(20.0)
    opened.bind((source, 0))
    opened.connect((address.hostname, address.port))
    heads = (f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" for path in requests)
    opened.sendall("".join(heads).encode())
    return opened


def _receive(opened: socket.socket) -> int:
    """Return the number of received bytes, or 0 at the end."""
    with suppress(ConnectionResetError):
        return len(opened.recv(1_000_000))
    return 0


def _memory_mb(service: Running, name: str) -> float:
    status = Path(f"/proc/{service.process.pid}/status")
    if not status.is_file():
        pytest.skip("the memory of a process is read from /proc")
    (line,) = [one for one in status.read_text().splitlines() if one.startswith(name)]
    return int(line.split()[1]) / 1000.0


def test_clients_that_do_not_read_shut_nobody_out(service: Running):
    before = _memory_mb(service, "VmRSS")
    held = [_open(service, *["/static/three.js"] * 20) for _ in range(300)]
    silent = [_open(service) for _ in range(20)]
    try:
        assert _memory_mb(service, "VmRSS") - before < 250
        for source in ("127.0.0.1", "127.0.0.2"):
            begun = time.monotonic()
            with _open(service, "/healthz", source=source) as other:
                assert other.recv(12) == b"HTTP/1.1 200"
            assert time.monotonic() - begun < 10.0
        time.sleep(6.0)  # upload_s is 4
        for one in held[-100:]:
            assert sum(iter(lambda one=one: _receive(one), 0)) < 1_000_000, "one answer at most"
    finally:
        for one in (*held, *silent):
            one.close()


def test_an_answer_that_is_not_taken_in_time_ends_its_connection():
    async def app(scope: Any, receive: Any, send: Any) -> None:
        head = [(b"content-length", b"40000000")]
        await send({"type": "http.response.start", "status": 200, "headers": head})
        await send({"type": "http.response.body", "body": bytes(40_000_000)})

    async def ask() -> None:
        options = protocols(ServiceConfig(upload_s=0.5), 100, behind_proxy=False)
        server = uvicorn.Server(uvicorn.Config(app, log_config=None, lifespan="off", **options))
        listener = socket.create_server(("127.0.0.1", 0))
        serving = asyncio.create_task(server.serve([listener]))
        reader, writer = await asyncio.open_connection(*listener.getsockname())
        writer.write(b"GET / HTTP/1.1\r\nHost: a\r\n\r\n")
        assert await reader.read(12) == b"HTTP/1.1 200"
        (connection,) = server.server_state.connections
        accepted: socket.socket = connection.transport.get_extra_info("socket")  # pyright: ignore
        is_sent_at_once = accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert is_sent_at_once, "the body would wait for the acknowledgement of the head"
        begun = time.monotonic()
        while server.server_state.connections:
            assert time.monotonic() - begun < 10.0, "the connection is held"
            await asyncio.sleep(0.05)
        assert time.monotonic() - begun > 0.3
        writer.close()
        server.should_exit = True
        await serving

    asyncio.run(ask())


def test_a_busy_connection_is_kept_and_the_one_that_waits_longest_ends():
    def connection(address: str, is_waiting: bool = True) -> Any:
        transport = SimpleNamespace(abort=lambda: ended.append(name))
        name = f"{address} {len(made)}"
        made.append(name)
        return _Connection(address=address, is_waiting=is_waiting, transport=transport)

    class _Connection(SimpleNamespace):
        __hash__ = object.__hash__  # pyright: ignore[reportAssignmentType]

    made, ended = list[str](), list[str]()
    opened = Connections(max_number=6, max_share=3)
    busy, first, second = connection("a", False), connection("a"), connection("a")
    for one in (busy, first, second, first):  # `first` has sent another request meanwhile
        opened.add(one)
    opened.add(connection("a"))
    assert ended == ["a 2"]
    for _ in range(3):
        opened.add(connection("b"))
    assert ended == ["a 2"]
    opened.add(connection("c"))
    assert ended == ["a 2", "a 1"]


def test_a_message_that_is_too_large_is_refused_with_a_close_frame(service: Running):
    address = service.url.replace("http", "ws") + "/v1/maps/room/sessions"
    with connect(address) as stream:
        with suppress(ConnectionClosed):
            stream.send(np.random.default_rng(0).bytes(20_000_000))
        with pytest.raises(ConnectionClosed) as closed:
            stream.recv(10)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1009


def test_messages_that_nobody_reads_the_answers_of_leave_no_memory(service: Running):
    address, noise = service.url.replace("http", "ws"), np.random.default_rng(0).bytes(2_900_000)
    before, end = _memory_mb(service, "VmRSS"), time.monotonic() + 2.5

    def send() -> None:
        url = f"{address}/v1/maps/room/sessions?camera=map"
        with connect(url, max_queue=1, close_timeout=1.0) as stream:
            while time.monotonic() < end:
                stream.send(noise)

    with ThreadPoolExecutor() as pool:
        for done in [pool.submit(send) for _ in range(3)]:
            done.exception()
    assert _memory_mb(service, "VmRSS") - before < 60
    until = time.monotonic() + 10.0
    while _memory_mb(service, "VmRSS") - before > 25 and time.monotonic() < until:
        time.sleep(0.5)
    assert _memory_mb(service, "VmRSS") - before < 25


@pytest.mark.parametrize("is_gone", [False, True])
def test_an_abandoned_job_gives_its_place_to_the_next(is_gone: bool):
    release = threading.Event()

    async def receive() -> dict[str, str]:
        await asyncio.sleep(0.05 if is_gone else 60.0)
        return {"type": "http.disconnect"}

    async def ask() -> None:
        workers = Workers(1, 5)
        request = Request({"type": "http"}, receive)
        expected = RequestError if is_gone else TimeoutError
        with pytest.raises(expected):
            await while_connected(request, workers.run(release.wait, 5.0 if is_gone else 0.1))
        assert workers.num_jobs == 0
        assert await workers.run(lambda: "answer", 5.0) == "answer"
        release.set()
        await asyncio.to_thread(workers.close)

    asyncio.run(ask())


def _service_of(paths: list[str], config: ServiceConfig) -> Service:
    maps = MapCache(paths, Localizer, 100_000_000)
    return create_application(maps, config)._app.state.service  # pyright: ignore


@pytest.mark.parametrize("is_gone", [False, True])
def test_a_search_that_nobody_waits_for_is_stopped(is_gone: bool):
    async def receive() -> dict[str, str]:
        await asyncio.sleep(0.05 if is_gone else 60.0)
        return {"type": "http.disconnect"}

    async def ask() -> None:
        config = ServiceConfig(workers=1, answer_s=5.0 if is_gone else 0.1)
        service = _service_of([], config)
        stop, ended = threading.Event(), threading.Event()

        def search() -> None:
            assert stop.wait(20.0)
            ended.set()

        with pytest.raises(RequestError) as raised:
            await service.run_job(Request({"type": "http"}, receive), search, stop)
        assert raised.value.status == (499 if is_gone else 503)
        assert await asyncio.to_thread(ended.wait, 20.0)
        await service.close()

    asyncio.run(ask())


def test_an_abandoned_scene_is_not_made(room_map: Path):
    stop = threading.Event()
    service = _service_of([str(room_map)], ServiceConfig())
    with closing(service.maps):
        scene = build_scene(service, room_map.stem, stop)
        assert json.loads(scene)["format"] == "topoloc-scene"
        service.scenes.clear()
        stop.set()
        with pytest.raises(RequestError, match="the client has gone"):
            build_scene(service, room_map.stem, stop)
        assert service.scenes == {}


def test_all_workers_share_one_budget_of_pixels(monkeypatch: pytest.MonkeyPatch):
    running_now, most, lock = [0], [0], threading.Lock()

    def read(*_: object, **__: object) -> np.ndarray:
        with lock:
            running_now[0] += 1
            most[0] = max(most[0], running_now[0])
        time.sleep(0.05)
        with lock:
            running_now[0] -= 1
        return np.zeros((2, 2), np.uint8)

    monkeypatch.setattr(query_handler, "read_image", read)
    decoder = ImageDecoder(1000)
    with ThreadPoolExecutor(8) as pool:
        for size, together in (((25, 20), 2), ((50, 20), 1), ((10, 10), 8)):
            monkeypatch.setattr(query_handler, "image_size", lambda _, size=size: size)
            most[0] = 0
            done = list(pool.map(lambda _: decoder.decode(EncodedImage("a", b"")), range(8)))
            assert [one[1] for one in done] == [size] * 8
            assert 1 <= most[0] <= together
    monkeypatch.setattr(query_handler, "image_size", lambda _: (50, 21))
    with pytest.raises(RequestError, match="50x21 is more than"):
        decoder.decode(EncodedImage("a", b""))


def test_images_of_50_megapixels_take_the_memory_that_the_docs_name(
    maps: Path,
):
    """Two such images at once took 2.4 GB in two workers."""
    file = io.BytesIO()
    Image.new("RGB", (7070, 7070)).save(file, "WEBP")
    long = io.BytesIO()
    Image.new("L", (50_000_000, 1)).save(long, "PNG")
    with (
        running(maps / "room.topo", "--workers", 2) as service,
        service.client() as client,
        ThreadPoolExecutor(2) as pool,
    ):
        url = "/v1/maps/room/localize"
        small = io.BytesIO()
        Image.new("RGB", (320, 240)).save(small, "WEBP")
        assert client.post(url, content=small.getvalue()).status_code == 200
        before = _memory_mb(service, "VmRSS")

        def post(_: int) -> httpx.Response:
            return client.post(url, content=file.getvalue())

        assert {one.status_code for one in pool.map(post, range(4))} == {200}
        assert client.post(url, content=long.getvalue()).status_code == 400
        assert _memory_mb(service, "VmHWM") - before < 400 + 2 * 100
