"""Run `topoloc serve` in its own process on 127.0.0.1 and query it over HTTP, as users do."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx

ROOT = Path(__file__).parents[3]
TOKEN = "a-token-of-some-length"
SIGNED_TOKEN = "a/token+of=(some)length"
"""With signs that base64 has and no subprotocol may have."""
PAGE = "https://client.example"
LIMITS = (
    "[serve]\nmax_upload_mb = 3.0\nmax_megapixels = 4.0\nupload_s = 4.0\nmax_sessions ="
    " 4\nmax_sessions_per_address = 3\nsession_idle_s = 4.0\n"
)


@dataclass
class Running:
    """Hold a running service. `log` grows as the service writes."""

    url: str
    process: subprocess.Popen[str]
    log: list[str] = field(default_factory=list)

    def client(self, **options: object) -> httpx.Client:
        return httpx.Client(base_url=self.url, timeout=60.0, **options)  # pyright: ignore[reportArgumentType]

    def end(self) -> int:
        """Stop the service with a signal and return its exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(30)


@contextmanager
def running(*args: object) -> Iterator[Running]:
    """Run `topoloc serve` with these arguments on a free port."""
    command = [sys.executable, "-m", "topoloc", "serve", *map(str, args), "--port", "0"]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src"), "PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
    assert process.stderr is not None
    log = list[str]()
    for line in process.stderr:
        log.append(line)
        if found := re.search(r"serves on (\S+)", line):
            break
    else:
        raise AssertionError("".join(log))
    reader = threading.Thread(target=lambda: log.extend(process.stderr or ()), daemon=True)
    reader.start()
    try:
        yield Running(found.group(1), process, log)
    finally:
        process.kill()
        process.wait()
        reader.join(5)
