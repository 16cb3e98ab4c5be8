"""Attack `topoloc serve` while honest clients ask it, and count what they meet.

    python benchmarks/service_attack.py MAP QUERIES [--requests 100000] [--clients 4]
        [--hostile 1250] [--width 336] [--images 0.9]

A tenth of the honest requests is garbage, `--images` are images, the others ask for facts. During
the middle third, hostile connections from five other addresses are held, and replaced when the
service closes them. They say nothing, do not read answers, or send a request byte by byte.
Meanwhile another client asks for `/healthz` twice a second, each time over a new connection.

Prints for each third the counts by status, the slowest `/healthz` and the memory of the service,
whose workers are threads. The exit status is 1 if an honest client got another answer than 200 or
4xx, `/healthz` took more than 2 s, or the service held more than 500 MB or grew after the first
third by more than 10 %.
"""

from __future__ import annotations

import argparse
import http.client
import random
import resource
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

import cv2

from topoloc import open_sequence
from topoloc.recordings.stored_images import encode_jpeg

sys.path.insert(0, str(Path(__file__).parent))
from service import Service, garbage, load, service

HONEST, WATCHER = "127.0.0.2", "127.0.0.3"
HOSTILE = [f"127.0.1.{number}" for number in range(1, 6)]
MAX_HEALTH_S, MAX_MB, MAX_GROWTH = 2.0, 500.0, 1.1


@dataclass
class Third:
    """Hold the counts of honest clients during a third of the requests."""

    statuses: Counter[str] = field(default_factory=Counter)
    health_s: list[float] = field(default_factory=list)
    health_faults: int = 0
    memory_mb: list[float] = field(default_factory=list)
    seconds: float = 0.0
    num_hostile: int = 0

    def __str__(self) -> str:
        statuses = ", ".join(f"{number} x {name}" for name, number in sorted(self.statuses.items()))
        memory = f"{self.memory_mb[0]:.0f} to {self.memory_mb[-1]:.0f} MB"
        return (
            f"{statuses} in {self.seconds:.0f} s; /healthz {len(self.health_s)} times, at most"
            f" {max(self.health_s, default=0.0):.2f} s, {self.health_faults} faults; memory"
            f" {memory}, at most {max(self.memory_mb):.0f}; {self.num_hostile} hostile connections"
        )


@contextmanager
def watching(of: Service, third: Third) -> Iterator[None]:
    """Request `/healthz` and measure memory twice a second."""
    stop = threading.Event()

    def watch() -> None:
        while not stop.wait(0.5):
            begun = time.perf_counter()
            connection = http.client.HTTPConnection(
                of.host, of.port, timeout=30, source_address=(WATCHER, 0)
            )
            try:
                connection.request("GET", "/healthz")
                third.health_faults += connection.getresponse().status != 200
            except (OSError, http.client.HTTPException):
                third.health_faults += 1
            connection.close()
            third.health_s.append(time.perf_counter() - begun)
            third.memory_mb.append(of.rss_mb())

    third.memory_mb.append(of.rss_mb())
    watcher, begun = threading.Thread(target=watch), time.perf_counter()
    watcher.start()
    try:
        yield
    finally:
        third.seconds = time.perf_counter() - begun
        stop.set()
        watcher.join()


@contextmanager
def attacking(of: Service, number: int, third: Third) -> Iterator[None]:
    """Hold so many hostile connections, a third of each kind."""
    stop, kinds = threading.Event(), count()
    held: list[tuple[socket.socket, bool]] = []

    def attack() -> None:
        while not stop.is_set():
            held[:] = [one for one in held if _is_open(*one)]
            while len(held) < number and not stop.is_set():
                try:
                    held.append(_open_hostile(of, next(kinds)))
                except OSError:
                    break
            third.num_hostile = max(third.num_hostile, len(held))
            stop.wait(1.0)

    attacker = threading.Thread(target=attack)
    attacker.start()
    try:
        yield
    finally:
        stop.set()
        attacker.join()
        for one, _ in held:
            one.close()


def _open_hostile(of: Service, number: int) -> tuple[socket.socket, bool]:
    """Return a new hostile connection, and whether it sends a request byte by byte."""
    opened = socket.socket()
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    opened.settimeout(5.0)
    opened.bind((HOSTILE[number % len(HOSTILE)], 0))
    opened.connect((of.host, of.port))
    opened.setblocking(False)
    kind = number // len(HOSTILE) % 3
    with suppress(OSError):
        if kind == 1:
            opened.send(b"GET /static/three.js HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 20)
        if kind == 2:
            opened.send(
                b"POST /v1/localize HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9999\r\n"
            )
    return opened, kind == 2


def _is_open(connection: socket.socket, is_slow: bool) -> bool:
    """Return whether the service still holds the connection, after another byte of a slow one."""
    try:
        if is_slow:
            connection.send(b"x")
        is_open = connection.recv(1, socket.MSG_PEEK) != b""
    except BlockingIOError:
        return True
    except OSError:
        is_open = False
    if not is_open:
        connection.close()
    return is_open


def make_requests(
    number: int, share: float, images: Sequence[bytes], name: str
) -> Iterator[bytes | str]:
    """Yield images, garbage instead of images, and paths of facts."""
    rng, facts = random.Random(0), ("/v1/maps", f"/v1/maps/{name}", "/capabilities", "/metrics")
    for i in range(number):
        if i % 10 == 3:
            yield garbage(rng, images[0])
        else:
            yield images[i % len(images)] if rng.random() < share / 0.9 else rng.choice(facts)


def find_faults(thirds: Sequence[Third]) -> list[str]:
    """Return the violations of the requirements."""
    faults = list[str]()
    for number, third in enumerate(thirds, start=1):
        wrong = {key: k for key, k in third.statuses.items() if key[:1] not in "24"}
        faults += [f"third {number}: honest clients got {wrong}"] if wrong else []
        if third.health_faults or max(third.health_s, default=0.0) > MAX_HEALTH_S:
            faults.append(f"third {number}: /healthz failed or took more than {MAX_HEALTH_S:g} s")
        if max(third.memory_mb) > MAX_MB:
            faults.append(f"third {number}: more than {MAX_MB:g} MB")
    if thirds[-1].memory_mb[-1] > MAX_GROWTH * thirds[0].memory_mb[-1]:
        faults.append("the memory grew")
    return faults


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("queries")
    parser.add_argument("--requests", type=int, default=100_000)
    parser.add_argument("--clients", type=int, default=4)
    parser.add_argument("--hostile", type=int, default=1250)
    parser.add_argument("--images", type=float, default=0.9, help="share of the requests")
    parser.add_argument("--width", type=int, default=336, help="of the images, pixels")
    args = parser.parse_args()
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    frames = open_sequence(args.queries)
    camera, images = frames[0].camera, [frames[i].image for i in range(min(len(frames), 24))]
    assert camera is not None
    height = round(camera.height * args.width / camera.width)
    camera = camera.rescaled(args.width, height)
    clear = [encode_jpeg(cv2.resize(one, (args.width, height)), 90) for one in images]
    thirds, name = [Third() for _ in range(3)], args.map.stem
    requests = list(make_requests(args.requests, args.images, clear, name))
    size = -(-args.requests // 3)
    with service(args.map) as of:
        for number, third in enumerate(thirds):
            part = requests[number * size : (number + 1) * size]
            num_hostile = args.hostile if number == 1 else 0
            with watching(of, third), attacking(of, num_hostile, third):
                statuses = load(of, name, camera, part, args.clients, address=HONEST)[2]
                third.statuses.update({str(status): k for status, k in statuses.items()})
            print(f"third {number + 1}: {third}", flush=True)
    faults = find_faults(thirds)
    print("; ".join(faults) or "no fault")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
