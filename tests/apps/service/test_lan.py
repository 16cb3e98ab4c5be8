"""Test `topoloc serve --lan`: the link, its code, its token and its certificate."""

from __future__ import annotations

import os
import re
import ssl
import stat
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import httpx
import numpy as np
import pytest
from running_service import TOKEN, Running, running
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from topoloc.apps.service import lan

pytest.importorskip("cryptography", reason="the extra lan is not installed")


def _link(service: Running) -> tuple[str, str]:
    """Return the address of the first link, and its token."""
    for _ in range(100):
        for line in service.log:
            if found := re.match(r"(https://\S+)/#token=(\S+)", line):
                return found[1], found[2]
        time.sleep(0.1)
    raise AssertionError("".join(service.log))


def test_the_certificate_is_of_the_address_of_the_link(
    room_map: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    with running(room_map, "--lan") as service:
        address, token = _link(service)
        [folder] = tmp_path.glob("topoloc-lan-*")
        assert {stat.S_IMODE(one.stat().st_mode) for one in folder.iterdir()} == {0o600}
        known = ssl.create_default_context(cafile=str(folder / "cert.pem"))
        with httpx.Client(base_url=address, verify=known) as client:
            assert client.get("/v1/maps").status_code == 401
            bearer = {"authorization": f"Bearer {token}"}
            assert client.get("/v1/maps", headers=bearer).json() == {"maps": [room_map.stem]}
        assert len(token) >= 20
        assert not urlsplit(address).hostname.startswith("127.")  # pyright: ignore[reportOptionalMemberAccess]
        assert service.end() == 0
        assert list(tmp_path.glob("topoloc-lan-*")) == []


def test_a_websocket_over_tls_ends_without_a_word(room_map: Path, tmp_path: Path):
    config = tmp_path / "limits.toml"
    config.write_text("[serve]\nupload_s = 1.0\n")
    with running(room_map, "--lan", "--config", config) as service:
        address, token = _link(service)
        trusting = ssl.create_default_context()
        trusting.check_hostname, trusting.verify_mode = False, ssl.CERT_NONE
        where = f"{address.replace('https', 'wss')}/v1/maps/{room_map.stem}/sessions"
        protocols = [Subprotocol("topoloc"), Subprotocol(f"bearer.{token}")]
        with connect(where, ssl=trusting, subprotocols=protocols) as stream:
            assert stream.subprotocol == "topoloc"
        time.sleep(2.0)
        assert service.end() == 0
        assert [line for line in service.log if '"level": "error"' in line] == []


def test_a_token_that_is_given_is_that_of_the_link(room_map: Path, tmp_path: Path):
    (tmp_path / "token").write_text(TOKEN)
    with running(
        room_map, "--lan", "--host", "127.0.0.2", "--token-file", tmp_path / "token"
    ) as service:
        assert _link(service) == (service.url, TOKEN)


def test_the_code_holds_the_link():
    link = "https://192.168.178.123:8571/#token=aaaaaaaaaaaaaaaaaaaaaaaa"
    lines = re.sub(r"\033\[[0-9;]*m", "", lan.qr_text(link)).split("\n")
    halves = np.array([[" ▄▀█".index(letter) for letter in line] for line in lines])
    light = np.stack([halves >= 2, halves % 2 == 1], axis=1).reshape(-1, halves.shape[1])
    picture = np.kron(light, np.full((6, 6), 255)).astype(np.uint8)
    assert cv2.QRCodeDetector().detectAndDecode(picture)[0] == link


def test_contradicting_options_are_an_error(complaint: Callable[..., str], room_map: Path):
    assert "--behind-proxy" in complaint("serve", room_map, "--lan", "--behind-proxy", status=2)
    assert "--tls-key" in complaint("serve", room_map, "--lan", "--tls-cert", "c.pem", status=2)


def test_without_a_network_a_host_is_required(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(lan.socket, "socket", _raise)
    monkeypatch.setattr(lan.socket, "gethostbyname_ex", lambda _: ("", [], ["127.0.1.1"]))
    with pytest.raises(lan.TopolocError, match="--host"):
        lan.find_lan_addresses("0.0.0.0")


def _raise(*_: object) -> None:
    raise OSError(os.strerror(101))
