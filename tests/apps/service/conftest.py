"""Provide maps, and a service of them that all tests query."""

from __future__ import annotations

import shutil
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import numpy as np
import pytest
from running_service import LIMITS, PAGE, ROOT, SIGNED_TOKEN, Running, running

from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.topomap import TopoMetricMap


@pytest.fixture(scope="session")
def maps(room_map: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of maps: `room`, `earth` with a place on earth, and `damaged` with
    unreadable nodes."""
    folder = tmp_path_factory.mktemp("maps")
    shutil.copy(room_map, folder / "room.topo")
    shutil.copy(room_map, folder / "damaged.topo")
    with closing(sqlite3.connect(folder / "damaged.topo")) as database:
        database.execute("UPDATE node_points SET checksum = zeroblob(8) WHERE node_id > 0")
        database.commit()
    with TopoMetricMap.load(room_map) as topomap:
        turned = Rigid3(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.zeros(3))
        replace(
            topomap, georeference=Georeference(GeoPoint(50.87, 4.70, 30.0), turned, "origin")
        ).save(folder / "earth.topo")
    return folder


@pytest.fixture(scope="session")
def service(maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """Run one service of these maps with tight limits for all tests."""
    config = tmp_path_factory.mktemp("config") / "limits.toml"
    config.write_text(LIMITS)
    with running(maps, "--workers", 2, "--config", config) as service:
        yield service


@pytest.fixture(scope="session")
def client(service: Running) -> Iterator[httpx.Client]:
    with service.client() as client:
        yield client


@pytest.fixture(scope="session")
def open_service(maps: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """Run a service of the map `earth` with a token, which also accepts pages of two
    other origins."""
    token = tmp_path_factory.mktemp("token") / "token"
    token.write_text(SIGNED_TOKEN)
    origins = ("--allow-origin", PAGE, "--allow-origin", "http://localhost:3000")
    with running(maps / "earth.topo", "--token-file", token, *origins) as service:
        yield service


@pytest.fixture(scope="session")
def asked(open_service: Running) -> Iterator[httpx.Client]:
    """Return a client of that service which sends the token."""
    with open_service.client(headers={"authorization": f"Bearer {SIGNED_TOKEN}"}) as client:
        yield client


@pytest.fixture(scope="session")
def view(queries: Path) -> Path:
    """Return the path of an image of the room."""
    return queries / "view02.png"


@pytest.fixture(scope="session")
def camera(queries: Path) -> str:
    """Return the calibration of the image as the form's field takes it."""
    return (queries / "camera.json").read_text()


class _Files(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


@pytest.fixture(scope="session")
def site() -> Iterator[str]:
    """Serve the repository as `python -m http.server` does."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Files, directory=ROOT)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
