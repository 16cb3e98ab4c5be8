"""Damage bytes, and values of JSON, by seeded random numbers."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

Rng = np.random.Generator
WORDS = (
    b"nan",
    b"1e999999999999",
    b"-1e308",
    b"9" * 5000,
    b"/etc/passwd",
    b"../../etc/passwd",
    b"[" * 100_000,
    b"\0",
    b'"',
    b"{",
    b"0",
    b"-1",
    b"\xff\xfe",
    b"\x1b]0;owned\x07\n",
)
VALUES: tuple[Any, ...] = (
    None,
    True,
    0,
    -1,
    1e308,
    float("nan"),
    float("inf"),
    2**63,
    -(2**64),
    10**400,
    "",
    "x" * 5000,
    "../../etc/passwd",
    "\0\n\x1b[31m",
    "\ud800",
    "NaN",
    [],
    {},
    [[]],
    [0] * 10_000,
    {"a": {"b": []}},
    0.5,
    1e-320,
)


def damage_bytes(data: bytes, rng: Rng) -> bytes:
    """Return bytes with some cut off, removed, repeated, zero, changed or inverted, or with a
    hostile word in place of a number."""
    way, changed, size = rng.integers(7), bytearray(data), len(data)
    if way == 0:
        return data[: rng.integers(size + 1)]
    if way == 1:
        numbers = list(_numbers(data))
        first, end = numbers[rng.integers(len(numbers))] if numbers else (0, 0)
        return data[:first] + WORDS[rng.integers(len(WORDS))] + data[end:]
    first, end = sorted(rng.integers(0, size + 1, 2))
    if way == 2:
        part = data[first:end][:500_000]
        return data[:end] + part * int(rng.integers(1, 20)) + data[end:]
    if way == 3:
        del changed[first : first + rng.integers(1, 5000)]
    elif way == 4:
        changed[first : first + 4096] = bytes(len(changed[first : first + 4096]))
    else:
        # half of the changes meet the first 200 bytes, where headers are
        reach = min(size, 200) if rng.random() < 0.5 else size
        for at in rng.integers(0, max(reach, 1), rng.integers(1, 12)):
            if size:
                changed[at] = rng.integers(256) if way == 5 else changed[at] ^ 1 << rng.integers(8)
    return bytes(changed)


def _numbers(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield start and end of runs of digits, in a text also of words."""
    start = None
    for at, byte in enumerate(data[:20_000]):
        is_inside = bytes([byte]).isalnum() or byte in b".-"
        if is_inside and start is None:
            start = at
        if not is_inside and start is not None:
            yield start, at
            start = None


def damage_json(text: str, rng: Rng, sealed: Callable[[Any], Any] = lambda data: data) -> str:
    """Return JSON with up to three other, missing, repeated or scaled values. `sealed` may write
    checksums afterwards."""
    data = json.loads(text)
    for _ in range(rng.integers(1, 4)):
        places = list(_places(data))
        if not places:
            break
        parent, key = places[rng.integers(len(places))]
        _damage_value(parent, key, rng)
    return json.dumps(sealed(data))


def _damage_value(parent: Any, key: Any, rng: Rng) -> None:
    way, value = rng.integers(4), parent[key]
    if way == 0:
        del parent[key]
    elif way == 1 and isinstance(value, int | float) and abs(value) < 1e300:
        parent[key] = value * float(rng.choice([-1.0, 1.0 + 1e-9, 1e3, 1e300, 0.0]))
    elif way == 2 and isinstance(parent, list):
        parent.extend([value] * int(rng.integers(1, 50)))
    elif way == 2:
        parent[f"{key}2"] = value
    else:
        parent[key] = deepcopy(VALUES[rng.integers(len(VALUES))])


def _places(data: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each container with each of its keys."""
    keys = list(data) if isinstance(data, dict) else range(len(data))
    for key in keys:
        yield data, key
        if isinstance(data[key], dict | list):
            yield from _places(data[key])


def damage_file(path: Path, rng: Rng) -> None:
    """Damage the bytes of a file. JSON is damaged by its values in half of the cases."""
    data = path.read_bytes()
    if path.suffix == ".json" and rng.random() < 0.5:
        path.write_text(damage_json(data.decode(), rng))
    else:
        path.write_bytes(damage_bytes(data, rng))
