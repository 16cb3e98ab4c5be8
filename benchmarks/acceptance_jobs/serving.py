"""Run `topoloc serve` and load it: requests, clients in Python, slow and silent clients."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .answers import compare_answers
from .atlases import ORIGIN
from .figures import Figure, rounded
from .workplace import JobError, Workplace, environment, last_line, need_module

CLIENTS = """
import asyncio, json, sys, topoloc
url, names = sys.argv[1], sys.argv[2:]
found = []
with topoloc.Client(url) as client:
    for name in names:
        result = client.localize("zed", name, camera="map")
        found.append(list(result.world_from_cam.translation) if result.localized else None)
async def all_of_them():
    async with topoloc.AsyncClient(url) as client:
        asked = [client.localize("zed", name, camera="map") for name in names]
        return await asyncio.gather(*asked)
for result in asyncio.run(all_of_them()):
    found.append(list(result.world_from_cam.translation) if result.localized else None)
print(json.dumps(found))
"""


@dataclass(frozen=True)
class Service:
    """A service that runs on this machine."""

    port: int
    pid: int

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def memory_mb(self) -> float:
        """Return the memory that the process holds now."""
        text = Path(f"/proc/{self.pid}/status").read_text()
        return int(next(line for line in text.splitlines() if "VmRSS" in line).split()[1]) / 1e3

    def is_well(self) -> bool:
        """Return whether /healthz answers within 2 s."""
        with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 2) as one:
            one.settimeout(2)
            one.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
            return b" 200 " in one.recv(100)
        return False


@contextmanager
def running(work: Workplace, folder: Path) -> Iterator[Service]:
    """Serve a folder of maps on a free port."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    log = work.folder / "serve.log"
    words = [sys.executable, "-m", "topoloc", "serve", folder, "--port", port, "--workers", 2]
    with log.open("w") as file:
        process = subprocess.Popen([str(word) for word in words], stderr=file, env=environment())
    service = Service(port, process.pid)
    try:
        for _ in range(300):
            if service.is_well():
                break
            if process.poll() is not None:
                raise JobError(last_line(log.read_text()))
            time.sleep(0.1)
        else:
            raise JobError("the service does not answer within 30 s")
        yield service
    finally:
        process.terminate()
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()


def serve(work: Workplace) -> Iterator[Figure]:
    """Compare answers over HTTP with those of the command line, and load the service."""
    need_module("fastapi", "uvicorn", "httpx", "websockets")
    maps = work.folder / "maps"
    maps.mkdir()
    path = Path(shutil.copy(work.map("zed"), maps / "zed.topo"))
    work.topoloc("georeference", path, *ORIGIN)
    images = _images(work)
    expected = work.answer("localize", path, *images, "--camera", "map")
    with running(work, maps) as service:
        yield from _requests(service, images, expected)
        yield from _clients(work, service, images[:40], expected[:40])
        yield from _geopose(service, images[0], expected[0])
        yield from _web_socket(service, work)
        yield from _hostile(service)


def _requests(service: Service, images: list[Path], expected: list[Any]) -> Iterator[Figure]:
    import httpx

    def ask(number: int) -> dict[str, Any]:
        path = images[number % len(images)]
        with path.open("rb") as file:
            answer = httpx.post(
                f"{service.url}/v1/maps/zed/localize",
                files={"image": file},
                data={"camera": "map", "name": expected[number % len(images)]["query"]},
                timeout=120,
            )
        answer.raise_for_status()
        return answer.json()

    with ThreadPoolExecutor(4) as pool:
        early = list(pool.map(ask, range(50)))
        before = service.memory_mb()
        late = list(pool.map(ask, range(50, 200)))
    found = compare_answers([*expected, *expected], [*early, *late])
    refused = sum(not answer["localized"] for answer in expected) / len(expected)
    yield Figure("requests of 200 with another answer", found.different, "at most")
    yield Figure("share of refusals", round(refused, 2))
    grown = service.memory_mb() / before
    yield Figure("memory after 200 requests over that after 50", rounded(grown, 3), "median")


def _clients(
    work: Workplace, service: Service, images: list[Path], expected: list[Any]
) -> Iterator[Figure]:
    script = work.folder / "clients.py"
    script.write_text(CLIENTS)
    found = json.loads(work.python(script, service.url, *images))
    wanted = [
        answer["world_from_cam"]["translation"] if answer["localized"] else None
        for answer in (*expected, *expected)
    ]
    other = sum(one != two for one, two in zip(found, wanted, strict=True))
    yield Figure(f"Client, AsyncClient: other answers of {len(wanted)}", other, "at most")


def _geopose(service: Service, image: Path, expected: dict[str, Any]) -> Iterator[Figure]:
    import base64

    import httpx

    picture = {
        "timestamp": 1.7e12,
        "sensorId": "camera",
        "privacy": {"dataRetention": [], "dataAcceptableUse": [], "dataSanitizationApplied": [],
                    "dataSanitizationRequested": []},
        "imageFormat": "JPG",
        "size": [672, 376],
        "imageBytes": base64.b64encode(image.read_bytes()).decode(),
    }  # fmt: skip
    request = {
        "id": "d9fbf438-b7c6-419a-a75b-1cf79275e58d",
        "timestamp": 1.7e12,
        "type": "geopose",
        "sensors": [{"id": "camera", "type": "camera"}],
        "sensorReadings": {"cameraReadings": [picture]},
    }
    accept = {"accept": "application/vnd.oscp+json; version=2.0;"}
    answer = httpx.post(f"{service.url}/localize/geopose", json=request, headers=accept, timeout=60)
    yield Figure("GeoPose: status", answer.status_code)
    place, known = answer.json()["geopose"]["position"], expected["geopose"]["position"]
    # The request has no calibration: the focal length is found with the pose.
    near = all(abs(place[key] - known[key]) < 1e-6 for key in ("lat", "lon"))
    yield Figure("GeoPose: latitude and longitude within 1e-6 deg", int(near), "at least")


def _web_socket(service: Service, work: Workplace) -> Iterator[Figure]:
    from websockets.sync.client import connect

    folder = Path(work.data("zed_lab/session2")) / "image_0"
    localized = 0
    address = f"ws://127.0.0.1:{service.port}/v1/maps/zed/sessions?camera=map"
    with connect(address, subprotocols=["topoloc"]) as stream:  # pyright: ignore
        for number, path in enumerate(sorted(folder.iterdir())[:20]):
            stream.send(json.dumps({"t_ns": 50_000_000 * (number + 1)}))
            stream.send(path.read_bytes())
            localized += json.loads(stream.recv(60))["localized"]
    yield Figure("WebSocket: frames with a pose of 20", localized, "at least")


def _hostile(service: Service) -> Iterator[Figure]:
    """Send 100 heads that never end, and 20 clients that do not read."""
    before = service.memory_mb()
    head = b"POST /v1/maps/zed/localize HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow: "
    slow = [_connected(service, head) for _ in range(100)]
    start, ended, well, asked = time.monotonic(), set[int](), 0, 0
    while time.monotonic() - start < 30 and len(ended) < len(slow):
        ended |= {k for k, one in enumerate(slow) if k not in ended and _has_ended(one)}
        well, asked = well + service.is_well(), asked + 1
        time.sleep(1)
    yield Figure("slow heads of 100 that end within 30 s", len(ended), "at least")
    yield Figure("/healthz without an answer meanwhile", asked - well, "at most")
    request = b"GET /v1/maps/zed/scene HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    deaf = [_connected(service, request * 20) for _ in range(20)]
    waits = []
    for _ in range(5):
        begun = time.monotonic()
        waits.append(time.monotonic() - begun if service.is_well() else 2.0)
        time.sleep(1)
    yield Figure("/healthz beside 20 clients that do not read: in time of 5",
                 sum(wait < 2 for wait in waits), "at least")  # fmt: skip
    for one in (*slow, *deaf):
        one.close()
    time.sleep(3)
    grown = service.memory_mb() - before
    yield Figure("memory below 200 MB more afterwards", int(grown < 200), "at least")


def _connected(service: Service, data: bytes) -> socket.socket:
    one = socket.create_connection(("127.0.0.1", service.port), 5)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    one.sendall(data)
    one.setblocking(False)
    return one


def _has_ended(one: socket.socket) -> bool:
    """Return whether a connection was answered with 408 or closed."""
    try:
        data = one.recv(1000)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return not data or b" 408 " in data


def _images(work: Workplace) -> list[Path]:
    """Return 70 images of the map and 30 of another place, all of one size."""
    import cv2

    zed = sorted((Path(work.data("zed_lab/session2")) / "image_0").iterdir())[:70]
    tower = sorted(Path(work.data("ie_tower")).rglob("*.jpg"))[::26][:30]
    folder = work.folder / "images"
    folder.mkdir()
    copies = []
    for k in range(100):
        group, place = divmod(k, 10)
        copies.append(folder / f"{k:03d}.jpg")
        if place < 7:
            shutil.copy(zed[7 * group + place], copies[-1])
        else:
            image = cv2.imread(str(tower[3 * group + place - 7]), cv2.IMREAD_GRAYSCALE)
            cv2.imwrite(str(copies[-1]), cv2.resize(image, (672, 376)))
    return copies
