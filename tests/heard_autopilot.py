"""Listen as an autopilot does, and make poses of a drone."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import numpy as np


@contextmanager
def receiver() -> Iterator[socket.socket]:
    """Yield a socket of UDP with a port of its own."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        one.settimeout(10.0)
        yield one


def received(receiver: socket.socket) -> list[tuple[int, np.ndarray, int]]:
    """Return time (microseconds), position (forward, right, down) and reset counter of each
    received message."""
    receiver.settimeout(0.3)
    found = []
    with suppress(TimeoutError):
        while True:
            frame = receiver.recv(300)
            if frame[7:10] != (331).to_bytes(3, "little"):
                continue  # HEARTBEAT
            payload = frame[10:-2].ljust(233, b"\0")
            fields = struct.unpack("<Q55f4Bb", payload)
            found.append((fields[0], np.array(fields[1:4]), fields[-3]))
    return found
