"""Test access to the service and its shutdown."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from running_service import TOKEN, running
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect


def test_elsewhere_only_with_a_token_and_tls_or_a_proxy(
    complaint: Callable[..., str], maps: Path, tmp_path: Path
):
    token = tmp_path / "token"
    token.write_text(TOKEN)
    assert "--token-file" in complaint("serve", maps, "--host", "0.0.0.0", status=2)
    assert "--token-file" in complaint("serve", maps, "--behind-proxy", status=2)
    assert "--tls-cert" in complaint(
        "serve", maps, "--host", "0.0.0.0", "--token-file", token, status=2
    )
    assert "--tls-key" in complaint("serve", maps, "--tls-cert", token, status=2)
    assert "at least one map" in complaint("serve", status=2)
    assert "no such map" in complaint("serve", tmp_path / "nothing.topo")
    token.write_text("short")
    assert "at least 16" in complaint("serve", maps, "--token-file", token)


def test_a_port_in_use_is_one_line(complaint: Callable[..., str], maps: Path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "cannot listen" in complaint("serve", maps, "--port", taken.getsockname()[1])


def test_a_folder_without_maps_is_served_with_a_warning(tmp_path: Path):
    with running(tmp_path) as service:
        assert any("no map yet; copy a .topo file there" in line for line in service.log)


def test_only_requests_with_the_token_are_answered(maps: Path, view: Path, tmp_path: Path):
    (tmp_path / "token").write_text(TOKEN + "\n")
    with (
        running(maps / "room.topo", "--token-file", tmp_path / "token") as service,
        service.client() as client,
    ):
        for shown in (
            {},
            {"authorization": "Bearer"},
            {"authorization": f"Bearer {TOKEN}x"},
            {"authorization": f"Basic {TOKEN}"},
        ):
            answer = client.get("/v1/maps", headers=shown)
            assert answer.status_code == 401
            assert answer.headers["www-authenticate"] == "Bearer"
            assert (
                client.post(
                    "/v1/maps/room/localize", files={"image": view.open("rb")}, headers=shown
                ).status_code
                == 401
            )
        assert client.get("/v1/maps", headers={"authorization": f"Bearer {TOKEN}"}).json() == {
            "maps": ["room"]
        }
        assert client.get("/healthz").status_code == 200
        address = service.url.replace("http", "ws") + "/v1/maps/room/sessions"
        with pytest.raises(InvalidStatus) as refused, connect(address):
            pass
        assert refused.value.response.status_code == 401
        with connect(address, subprotocols=["topoloc", f"bearer.{TOKEN}"]) as stream:  # pyright: ignore[reportArgumentType]
            assert stream.subprotocol == "topoloc"
        assert TOKEN not in "".join(service.log)


def test_requests_in_progress_are_finished_at_shutdown(maps: Path, queries: Path, camera: str):
    """Sixteen requests wait when the signal arrives. Each gets its answer, and the
    process exits with 0."""
    asked = {"files": {"image": (queries / "view02.png").read_bytes()}, "data": {"camera": camera}}
    statuses, together, until = list[int](), threading.Barrier(16), time.monotonic() + 60.0
    with (
        running(maps / "room.topo", "--workers", 1, "--max-queue", 100) as service,
        service.client() as client,
        ExitStack() as stack,
    ):
        client.post("/v1/maps/room/localize", **asked)
        clients = [stack.enter_context(service.client()) for _ in range(16)]

        def ask(one: httpx.Client) -> None:
            one.get("/healthz")  # making a connection takes longer than an answer
            together.wait()
            statuses.append(one.post("/v1/maps/room/localize", **asked).status_code)

        threads = [threading.Thread(target=ask, args=(one,)) for one in clients]
        for thread in threads:
            thread.start()
        while client.get("/healthz").json()["jobs"] < 8:
            assert time.monotonic() < until, "never do eight wait at once"
        assert service.end() == 0
        for thread in threads:
            thread.join()
        assert statuses.count(200) >= 8
        assert json.loads(service.log[-1])["event"] == "ended"


def test_an_idle_connection_is_closed(service: object, client: httpx.Client):
    address = urlsplit(str(client.base_url))
    assert address.hostname
    with socket.create_connection((address.hostname, address.port or 80), 30.0) as silent:
        silent.sendall(b"GET /healthz HT")
        assert silent.recv(100) == b""
