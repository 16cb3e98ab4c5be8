"""`topoloc serve` under load, beside the same localizer called in this process, on the same
pictures in the same run.

    python benchmarks/service.py MAP QUERIES [--requests 2000] [--clients 4] [--maps 20]
        [--speed] [--json FILE]

Prints one line a question: pictures a second by one thread and by as many threads as there are
processors here, then by the service; times of answers at 80 % of that; with 30 % pictures of
elsewhere; memory and statuses over many requests of which a tenth is garbage; memory with many maps
under a budget, and whether their answers are those of this process to the byte.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote, urlsplit

import cv2
import numpy as np

from topoloc import Localizer, TopoMetricMap, open_sequence, set_num_threads
from topoloc.geometry.camera import Camera
from topoloc.recordings.image_io import EncodedImage, read_image
from topoloc.recordings.stored_images import encode_jpeg


@dataclass
class Service:
    """A service in a process of its own."""

    host: str
    port: int
    pid: int

    def rss_mb(self, what: str = "VmRSS") -> float:
        text = Path(f"/proc/{self.pid}/status").read_text()
        return int(re.search(rf"{what}:\s+(\d+)", text)[1]) / 1e3  # pyright: ignore[reportOptionalSubscript]


@contextmanager
def service(*args: object) -> Iterator[Service]:
    command = [sys.executable, "-m", "topoloc", "serve", *map(str, args), "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        url = next(
            found[1] for line in process.stderr if (found := re.search(r"serves on (\S+)", line))
        )
        threading.Thread(target=process.stderr.read, daemon=True).start()
        address = urlsplit(url)
        try:
            yield Service(address.hostname or "", address.port or 0, process.pid)
        finally:
            process.terminate()


class Client:
    """One connection that is kept, from an address of this machine."""

    def __init__(self, of: Service, camera: Camera, address: str = "127.0.0.1") -> None:
        self._http = http.client.HTTPConnection(
            of.host, of.port, timeout=120, source_address=(address, 0)
        )
        self._camera = quote(json.dumps(camera.to_json()))

    def ask(self, name: str, body: bytes | str) -> tuple[int | str, bytes]:
        """Status and content of the answer for an image, or at a path; instead of the status the
        name of the error that ended the connection."""
        try:
            if isinstance(body, str):
                self._http.request("GET", body)
            else:
                path = f"/v1/maps/{name}/localize?camera={self._camera}&name=q"
                self._http.request("POST", path, body, {"Content-Type": "image/jpeg"})
            response = self._http.getresponse()
            return response.status, response.read()
        except (OSError, http.client.HTTPException) as error:
            self._http.close()  # the next request opens another one
            return type(error).__name__, b""


def load(
    of: Service,
    name: str,
    camera: Camera,
    pictures: Sequence[bytes | str],
    num_clients: int,
    rate: float | None = None,
    address: str = "127.0.0.1",
) -> tuple[float, list[float], Counter]:
    """Return images a second, seconds of each answer, and counts by status. With a rate (1/s)
    requests start at fixed times."""
    seconds, statuses, lock, start = list[float](), Counter(), threading.Lock(), time.perf_counter()
    waiting = iter(enumerate(pictures))

    def ask() -> None:
        client = Client(of, camera, address)
        while True:
            with lock:
                number, picture = next(waiting, (-1, b""))
            if number < 0:
                return
            due = start + number / rate if rate else time.perf_counter()
            time.sleep(max(0.0, due - time.perf_counter()))
            status, _ = client.ask(name, picture)
            with lock:
                seconds.append(time.perf_counter() - due)
                statuses[status] += 1

    with ThreadPoolExecutor(num_clients) as pool:
        for done in [pool.submit(ask) for _ in range(num_clients)]:
            done.result()
    return len(pictures) / (time.perf_counter() - start), seconds, statuses


def in_process(
    localizer: Localizer, camera: Camera, pictures: Sequence[bytes], num_threads: int
) -> float:
    """Pictures a second, decoded and localized by threads of this process."""

    def ask(jpeg: bytes) -> None:
        localizer.localize(read_image(EncodedImage("q", jpeg)), camera)

    start = time.perf_counter()
    with ThreadPoolExecutor(num_threads) as pool:
        list(pool.map(ask, pictures))
    return len(pictures) / (time.perf_counter() - start)


def garbage(rng: random.Random, picture: bytes) -> bytes:
    """Return a damaged input instead of an image."""
    kinds = (
        b"",
        picture[: rng.randrange(1, len(picture))],
        rng.randbytes(2000),
        b"%PDF-1.7\n",
        b"<svg/>",
        b"\x89PNG\r\n\x1a\n" + rng.randbytes(500),
    )
    return rng.choice(kinds)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("queries")
    parser.add_argument("--requests", type=int, default=2000)
    parser.add_argument("--clients", type=int, default=4)
    parser.add_argument("--maps", type=int, default=20)
    parser.add_argument("--speed", action="store_true", help="the rates and times alone")
    parser.add_argument("--json", type=Path, help="write rates and times to this file")
    args = parser.parse_args()
    frames = open_sequence(args.queries)
    camera = frames[0].camera
    assert camera is not None
    clear = [encode_jpeg(frames[i].image, 90) for i in range(min(len(frames), 24))]
    set_num_threads(1)
    with TopoMetricMap.load(args.map) as topomap:
        figures = speed(args, Localizer(topomap), camera, clear)
        if args.json:
            args.json.write_text(json.dumps(figures, indent=1))
        if args.speed:
            return
        under_garbage(args, camera, clear)
        many_maps(args, Localizer(topomap), camera, clear)


def speed(
    args: argparse.Namespace, localizer: Localizer, camera: Camera, clear: list[bytes]
) -> dict[str, float]:
    """Print the rates and times, and return them: of this process, then of the service."""
    name, num = args.map.stem, max(len(clear), args.requests // 10)
    many = [clear[i % len(clear)] for i in range(num)]
    in_process(localizer, camera, clear, 1)
    threads = os.cpu_count() or 1
    alone, together = (in_process(localizer, camera, many, number) for number in (1, threads))
    print(f"in process: {alone:.1f}/s by 1 thread, {together:.1f}/s by {threads}", flush=True)
    with service(args.map) as of:
        load(of, name, camera, clear, args.clients)
        rate, _, _ = load(of, name, camera, many, args.clients)
        print(f"service: {rate:.1f}/s, {args.clients} clients")
        _, seconds, statuses = load(of, name, camera, many, 16, 0.8 * rate)
        median, p99 = 1e3 * np.percentile(seconds, [50, 99])
        print(
            f"at 80 %: median {median:.0f} ms, p99 {p99:.0f} ms = {p99 / median:.1f} x;"
            f" {dict(statuses)}"
        )
        elsewhere = encode_jpeg(
            cv2.GaussianBlur(
                np.random.default_rng(0).integers(0, 255, (camera.height, camera.width), np.uint8),
                (0, 0),
                2.5,
            ),
            90,
        )
        mixed = [elsewhere if i % 10 < 3 else picture for i, picture in enumerate(many)]
        print(f"30 % of elsewhere: {load(of, name, camera, mixed, args.clients)[0]:.1f}/s")
    again = in_process(localizer, camera, many, threads)
    print(f"in process again: {again:.1f}/s by {threads}")
    return {
        "in_process_per_s": max(together, again),
        "service_per_s": rate,
        "median_ms": median,
        "p99_ms": p99,
        "not_answered": len(many) - statuses[200],
    }


def under_garbage(args: argparse.Namespace, camera: Camera, clear: list[bytes]) -> None:
    rng, name = random.Random(0), args.map.stem
    requests = [
        garbage(rng, clear[0]) if i % 10 == 3 else clear[i % len(clear)]
        for i in range(args.requests)
    ]
    with service(args.map) as of:
        _, _, before = load(
            of, name, camera, requests[: min(1000, args.requests // 2)], args.clients
        )
        early = of.rss_mb()
        _, _, after = load(
            of, name, camera, requests[min(1000, args.requests // 2) :], args.clients
        )
        print(
            f"{args.requests} requests, a tenth garbage: {dict(before + after)}; {early:.0f} MB,"
            f" then {of.rss_mb():.0f} MB"
        )


def many_maps(
    args: argparse.Namespace, localizer: Localizer, camera: Camera, clear: list[bytes]
) -> None:
    own = [
        localizer.localize(read_image(EncodedImage("q", jpeg)), camera).to_json("q")
        for jpeg in clear[:6]
    ]
    with tempfile.TemporaryDirectory() as folder:
        for number in range(args.maps):
            shutil.copy(args.map, Path(folder) / f"m{number}.topo")
        with service(folder, "--memory-mb", 512) as of:
            client, same = Client(of, camera), 0
            for _ in range(2):
                for number in range(args.maps):
                    answers = [json.loads(client.ask(f"m{number}", jpeg)[1]) for jpeg in clear[:6]]
                    same += sum(
                        _timeless(a) == _timeless(b) for a, b in zip(answers, own, strict=True)
                    )
            print(
                f"{args.maps} maps under 512 MB: {of.rss_mb('VmHWM'):.0f} MB at most; {same} of"
                f" {12 * args.maps} answers are the same bytes"
            )


def _timeless(result: dict) -> str:
    return json.dumps({key: value for key, value in result.items() if key != "times_ms"})


if __name__ == "__main__":
    main()
